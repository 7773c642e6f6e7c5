"""Shortcuts through Taichi's front end: the same source is found, and errors still say where."""

from __future__ import annotations

import ast
import importlib
import inspect
import sys
import textwrap
from types import FunctionType, SimpleNamespace

import pytest
from kernel_cases import ROOT, run_python

from coview_kernels import backend, front_end, runtime

needs_taichi = pytest.mark.skipif(backend() != "taichi", reason="of Taichi only")
MODULES = sorted(p.stem.removeprefix("_ti_") for p in (ROOT / "kernels/coview_kernels").glob("_ti_*.py"))


def functions(name):
    """Functions of a kernel module, as they are written."""
    module = runtime.submit(runtime.kernels, name)
    found = [getattr(getattr(value, "func", None), "func", None) or getattr(value, "__wrapped__", None)
             for value in vars(module).values()]  # fmt: skip
    return [f for f in found if isinstance(f, FunctionType) and f.__module__ == module.__name__]


@needs_taichi
@pytest.mark.parametrize("name", MODULES)
def test_source_lines_are_those_of_inspect(name):
    known = functions(name)
    assert known
    for function in known:
        assert front_end.source_lines(function) == inspect.getsourcelines(function)


def test_source_of_a_function_within_a_function_is_found():
    def inner():
        """Be found."""

    assert front_end.source_lines(inner) == inspect.getsourcelines(inner)


@pytest.mark.parametrize("line", ["", "  ", "\n", "    x = 1  \n", "\ta = 2\n", '    """Text  with   blanks."""\n'])
def test_filled_line_is_that_of_textwrap(line):
    options = {"tabsize": 4, "width": 9999}
    assert front_end._filled(line, **options) == textwrap.fill(line, **options)


@needs_taichi
def test_what_the_shortcuts_replace_is_there_and_replaced():
    """Without it kernels take twice as long to load, and no result differs."""
    kernel = importlib.import_module("taichi.lang.kernel_impl")
    assert kernel in front_end._replaced
    for name in ("getsourcelines", "getsourcefile"):
        assert getattr(kernel, name).__module__ == front_end.__name__


def test_place_of_a_node_names_file_line_and_function():
    context = SimpleNamespace(
        file="k.py", lineno_offset=9, func=SimpleNamespace(func=test_filled_line_is_that_of_textwrap)
    )
    node = ast.parse("\nx = 1").body[0]
    assert front_end._place(context, node) == 'File "k.py", line 11, in test_filled_line_is_that_of_textwrap:\n'


def test_unknown_version_is_left_alone(monkeypatch):
    monkeypatch.setattr(importlib, "import_module", lambda name: pytest.fail(name))
    front_end.shorten(SimpleNamespace(__name__="taichi", __version__=(9, 9, 9)))
    front_end.shorten(SimpleNamespace(__name__="quadrants", __version__=(1, 7, 4)))


def test_lean_import_leaves_no_stand_in_of_a_library_behind(monkeypatch):
    monkeypatch.delitem(sys.modules, "taichi", raising=False)
    monkeypatch.delitem(sys.modules, "dill", raising=False)
    monkeypatch.setitem(sys.modules, "taichi._version_check", None)
    with front_end.lean_import("taichi"):
        stand_in = importlib.import_module("dill")
        check = importlib.import_module("taichi._version_check")
    assert "dill" not in sys.modules
    assert check.start_version_check_thread() is None
    assert not hasattr(stand_in, "__path__")


@pytest.mark.slow
@needs_taichi
def test_kernels_of_the_host_still_compile_and_report_errors():
    """They are read as ever: also one without a file, which the shortcuts could not read."""
    code = (
        "import numpy as np, coview_kernels as ck\n"
        "ck.polar_bin(np.ones((5, 3), dtype=np.float32), (0, 0, 0), 4, 8, 10.0)\n"
        "ck.shutdown()\nimport linecache, taichi as ti\nti.init(arch=ti.cpu)\n"
        "lines = '@ti.kernel\\ndef one() -> ti.i32:\\n    return 1\\n\\n@ti.kernel\\ndef bad():\\n    x = nowhere\\n'\n"
        "linecache.cache['<host>'] = len(lines), None, lines.splitlines(True), '<host>'\n"
        "exec(compile(lines, '<host>', 'exec'), globals())\n"
        "assert one() == 1\n"
        "try:\n    bad()\nexcept ti.TaichiNameError as error:\n    assert 'x = nowhere' in str(error)\n"
        "    print('fine')\n"
    )
    done = run_python(code)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("fine\n")
