"""Fixtures of the tests of base maps."""

import numpy as np
import pytest


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache for working files and mirrors."""
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def cut(map_points):
    """20 x 20 m of the small world."""
    return map_points[(np.abs(map_points[:, :2] + 5.0) < 10.0).all(axis=1)]
