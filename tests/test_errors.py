"""A missing library is named with what installs it; one that is there but broken, with what is wrong with it."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import pytest

from coview_stream import errors
from coview_stream.errors import DependencyError, naming_missing_libraries, require_library


def test_installed_library_is_imported():
    assert require_library("math", "fast-sums>=2.1", "sums") is math


@pytest.mark.parametrize("module", ["fast_sums", "fast_sums.quick"])
def test_missing_library_is_named_with_install_command(module):
    with pytest.raises(DependencyError) as caught:
        require_library(module, "fast-sums>=2.1", "sums")
    assert str(caught.value) == "sums: fast-sums is not installed; pip install 'fast-sums>=2.1'"


@pytest.mark.parametrize(("kind", "reason"), [("Import", "libsums.so.3: no such file"), ("Attribute", "not found")])
def test_broken_library_error_gives_the_reason(tmp_path, monkeypatch, kind, reason):
    module = f"broken_{kind}"
    (tmp_path / f"{module}.py").write_text(f"raise {kind}Error({reason!r})")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match=rf"broken-{kind} cannot be loaded \({reason}\)"):
        require_library(module, "broken-sums", "sums")


def test_missing_library_of_an_extra_is_named_with_the_extra(monkeypatch):
    monkeypatch.setitem(errors.EXTRA_OF, "fast_sums", "node")
    says = r"^sums: fast-sums is not installed; pip install 'coview-stream\[node\]'$"
    with pytest.raises(DependencyError, match=says):
        require_library("fast_sums.quick", "fast-sums>=2.1", "sums")
    with pytest.raises(DependencyError, match=says), naming_missing_libraries("sums"):
        import fast_sums  # noqa: F401


def test_bug_of_our_own_is_not_taken_for_a_missing_library():
    with pytest.raises(ModuleNotFoundError) as caught, naming_missing_libraries("sums"):
        import coview_stream.no_such_module  # noqa: F401
    assert not isinstance(caught.value, DependencyError)


def test_extras_that_messages_name_bring_the_library():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]

    def brought(extra):
        own = [name for name in extras[extra] if name.startswith("coview-stream[")]
        more = [part for name in own for part in name[len("coview-stream[") : -1].split(",")]
        rest = [re.split(r"[\[><=;]", name)[0].strip() for name in extras[extra] if name not in own]
        return {*rest, *(name for part in more for name in brought(part))}

    spelt = {"google": "protobuf", "CSF": "cloth-simulation-filter", "rerun": "rerun-sdk", "lazrs": "laspy"}
    spelt |= {"open3d": "open3d-cpu", "foxglove": "foxglove-sdk"}
    for module, extra in errors.EXTRA_OF.items():
        assert spelt.get(module, module.replace("_", "-")) in brought(extra), module


def test_install_commands_match_pyproject_extras():
    root = Path(__file__).parents[1]
    sources = "".join(path.read_text() for path in (root / "coview_stream").rglob("*.py"))
    named = set(re.findall(r'require_library\(f?"[^"]+", "([^"]+)"', sources))
    assert len(named) > 8
    project = (root / "pyproject.toml").read_text()
    assert all(f'"{name}' in project for name in named - {"lazrs>=0.6"})  # which laspy brings
