"""Fixtures of the tests of base maps."""

import pytest


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache for working files and mirrors."""
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"
