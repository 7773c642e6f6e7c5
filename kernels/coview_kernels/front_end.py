"""Shortcuts through the front end of Taichi, which reads every kernel again where only its compiled form is wanted.

A kernel of the cache is found by what its source says, so each process parses and walks the source of every kernel
that it uses. Half of that time, and a third of the import's, goes into what is of no use here: tokens of the whole
file for each function, pictures of the source for error messages, a question over the network whether there is a newer
version, and a library that finds source in interactive shells. Error messages still say file, line and function.

The replaced names are not public: only in the versions that the tests cover, and elsewhere nothing is changed.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import sys
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

TESTED_VERSIONS = {"taichi": (1, 7)}
"""Libraries of which the front end, and the launch context, are known."""


def tested(library: Any) -> bool:
    """Tell whether this version's internals are those that the shortcuts know."""
    return TESTED_VERSIONS.get(library.__name__) == tuple(library.__version__[:2])


@contextlib.contextmanager
def lean_import(name: str) -> Iterator[None]:
    """Import the library ``name`` inside without what it does not need here: 50 of 160 ms."""
    if name != "taichi" or name in sys.modules:
        yield
        return
    version_check = ModuleType("taichi._version_check")
    vars(version_check)["start_version_check_thread"] = lambda: None  # else a question over the network, once a day
    sys.modules[version_check.__name__] = version_check
    late = None if "dill" in sys.modules else _Late("dill")
    if late is not None:
        sys.modules["dill"] = late
    try:
        yield
    finally:
        if late is not None and sys.modules.get("dill") is late:
            del sys.modules["dill"]


class _Late(ModuleType):
    """A module that is imported when something of it is asked for."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # the import system looks at those
            raise AttributeError(name)
        return getattr(importlib.import_module(self.__name__), name)


def shorten(library: Any) -> None:
    """Replace the slow parts of the front end of ``library``, for our kernels and its own functions; idempotent."""
    if not tested(library):
        return
    kernel: Any = importlib.import_module(f"{library.__name__}.lang.kernel_impl")
    notes: Any = importlib.import_module(f"{library.__name__}.lang.ast.ast_transformer_utils")
    if kernel in _replaced:
        return
    _replaced.append(kernel)
    folders = tuple(str(Path(file).parent) for file in (__file__, library.__file__))
    lines, file, place = kernel.getsourcelines, kernel.getsourcefile, notes.ASTTransformerContext.get_pos_info

    def known(path: str) -> bool:
        return path.startswith(folders)  # a host's kernels may come from a shell

    kernel.getsourcelines = lambda fn: source_lines(fn) if known(fn.__code__.co_filename) else lines(fn)
    kernel.getsourcefile = lambda fn: fn.__code__.co_filename if known(fn.__code__.co_filename) else file(fn)
    notes.ASTTransformerContext.get_pos_info = lambda self, node: (
        _place(self, node) if known(self.file) else place(self, node)
    )
    kernel.textwrap = SimpleNamespace(fill=_filled, dedent=textwrap.dedent)


_replaced: list[ModuleType] = []


def source_lines(function: FunctionType) -> tuple[list[str], int]:
    """Return a function's lines, with its decorators, and the number of the first, as :func:`inspect.getsourcelines`.

    That one takes the tokens of the function's file anew every time.
    """
    lines, ends = _functions(function.__code__.co_filename)
    first = function.__code__.co_firstlineno
    return (lines[first - 1 : ends[first]], first) if first in ends else inspect.getsourcelines(function)


@cache
def _functions(path: str) -> tuple[list[str], dict[int, int]]:
    """Return a file's lines, and the last line of its functions by their first; not of functions within functions."""
    text = Path(path).read_text(encoding="utf-8")
    ends, nodes = {}, list[ast.stmt](ast.parse(text).body)
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            nodes += node.body
        elif isinstance(node, ast.FunctionDef) and node.end_lineno is not None:
            ends[min([node.lineno, *(d.lineno for d in node.decorator_list)])] = node.end_lineno
    return text.splitlines(keepends=True), ends


def _filled(line: str, **options: Any) -> str:
    """Return what ``textwrap.fill`` does; nothing is to be wrapped."""
    return line.expandtabs(4).rstrip() if options == {"tabsize": 4, "width": 9999} else textwrap.fill(line, **options)


def _place(context: Any, node: ast.expr | ast.stmt) -> str:
    """Return where in the source a node is, for error messages."""
    line = node.lineno + context.lineno_offset
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n'
