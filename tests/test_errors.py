"""A missing library is named with what installs it; one that is there but broken, with what is wrong with it."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from coview_stream.errors import DependencyError, require_library


def test_installed_library_is_imported():
    assert require_library("math", "fast-sums>=2.1", "sums") is math


@pytest.mark.parametrize("module", ["fast_sums", "fast_sums.quick"])
def test_missing_library_is_named_with_install_command(module):
    with pytest.raises(DependencyError) as caught:
        require_library(module, "fast-sums>=2.1", "sums")
    assert str(caught.value) == "sums: fast-sums is not installed; pip install 'fast-sums>=2.1'"


def test_broken_library_error_gives_the_reason(tmp_path, monkeypatch):
    (tmp_path / "broken_sums.py").write_text("raise ImportError('libsums.so.3: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match=r"broken-sums cannot be loaded \(libsums.so.3: no such file\)"):
        require_library("broken_sums", "broken-sums", "sums")


def test_library_raising_any_exception_is_reported(tmp_path, monkeypatch):
    (tmp_path / "odd_sums.py").write_text("raise AttributeError('_ARRAY_API not found')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match=r"odd-sums cannot be loaded \(_ARRAY_API not found\)"):
        require_library("odd_sums", "odd-sums", "sums")


def test_install_commands_match_pyproject_extras():
    root = Path(__file__).parents[1]
    sources = "".join(path.read_text() for path in (root / "coview_stream").rglob("*.py"))
    named = set(re.findall(r'require_library\(f?"[^"]+", "([^"]+)"', sources))
    libraries = {"kiss-icp", "small-gicp", "rerun-sdk", "onnxruntime", "onnx", "torch", "gtsam"}
    assert {re.split("[><=]", name)[0] for name in named} == libraries
    project = (root / "pyproject.toml").read_text()
    assert all(f'"{name}"' in project for name in named)
