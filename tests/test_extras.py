"""A missing library is named with what installs it; one that is there but broken, with what is wrong with it."""

from __future__ import annotations

import math

import pytest

from coview_stream.errors import DependencyError
from coview_stream.extras import extra


def test_what_is_there_is_imported():
    assert extra("math", "calculus", "sums") is math


@pytest.mark.parametrize("module", ["fast_sums", "fast_sums.quick"])
def test_what_is_missing_is_named_with_its_extra(module):
    with pytest.raises(DependencyError) as caught:
        extra(module, "calculus", "sums")
    assert str(caught.value) == "sums: fast-sums is not installed; pip install 'coview-stream[calculus]'"


def test_what_cannot_be_loaded_says_why(tmp_path, monkeypatch):
    (tmp_path / "broken_sums.py").write_text("raise ImportError('libsums.so.3: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match=r"broken-sums cannot be loaded \(libsums.so.3: no such file\)"):
        extra("broken_sums", "calculus", "sums")
