"""Filters: outliers, voxels, normals; and machines without Open3D or its system libraries."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coview_stream.clouds import filters
from coview_stream.clouds.filters import estimate_normals, remove_outliers, voxel_grid
from coview_stream.errors import ConfigError, DependencyError

RNG = np.random.default_rng(4)


def test_outliers_are_removed_and_plane_is_kept() -> None:
    plane = np.column_stack([RNG.uniform(0, 20, (4000, 2)), RNG.normal(0, 0.02, 4000)])
    stray = RNG.uniform([0, 0, 10], [20, 20, 60], (20, 3))
    points = np.concatenate([plane, stray]).astype(np.float32)
    kept, mask = remove_outliers(points)
    np.testing.assert_array_equal(kept, points[mask])
    assert kept.dtype == np.float32
    assert not mask[4000:].any()
    assert mask[:4000].mean() > 0.99


@pytest.mark.parametrize("count", [0, 1, 20])
def test_too_few_points_for_outliers_are_kept(count: int) -> None:
    kept, mask = remove_outliers(np.zeros((count, 3), np.float32))
    assert len(kept) == count
    assert mask.all()


@given(st.integers(0, 2**31), st.floats(0.05, 5.0), st.integers(1, 300))
def test_voxel_centroids_match_numpy_grouping(seed: int, voxel: float, count: int) -> None:
    points = np.random.default_rng(seed).normal(0, 10, (count, 3)).astype(np.float32)
    groups: dict[tuple[int, ...], list[np.ndarray]] = {}
    for point in points.astype(np.float64):
        groups.setdefault(tuple(np.floor(point / voxel).astype(int)), []).append(point)
    expected = [np.mean(groups[key], axis=0) for key in sorted(groups)]
    np.testing.assert_allclose(voxel_grid(points, voxel), expected, atol=1e-5)


def test_voxel_grid_of_no_points_and_of_too_many_cells() -> None:
    assert voxel_grid(np.zeros((0, 3), np.float32), 0.5).shape == (0, 3)
    with pytest.raises(ConfigError, match="too small"):
        voxel_grid(np.array([[0, 0, 0], [1e7, 1e7, 1e7]], np.float32), 1e-3)


def test_normals_of_a_tilted_plane_point_up() -> None:
    xy = RNG.uniform(0, 10, (2000, 2))
    points = np.column_stack([xy, 0.5 * xy[:, 0]]).astype(np.float32)
    expected = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    for radius in (None, 1.5):
        normals, planarity = estimate_normals(points, radius=radius)
        assert normals.dtype == planarity.dtype == np.float32
        np.testing.assert_allclose(normals, np.tile(expected, (2000, 1)), atol=1e-3)
        assert planarity.min() > 0.999


def test_planarity_tells_a_surface_from_a_crown() -> None:
    crown = RNG.normal(0, 1, (4000, 3)).astype(np.float32)
    rough = np.column_stack([RNG.uniform(0, 20, (8000, 2)), RNG.normal(0, 0.03, 8000)]).astype(np.float32)
    inside = np.linalg.norm(crown, axis=1) < 1.0
    scattered, flat = (estimate_normals(points, radius=1.0)[1] for points in (crown, rough))
    assert np.median(scattered[inside]) < 0.5
    assert np.median(flat) > 0.95


def test_isolated_points_have_a_vertical_normal() -> None:
    normals, planarity = estimate_normals(np.array([[0, 0, 0], [50, 0, 0]], np.float32), radius=1.0)
    np.testing.assert_array_equal(normals, [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(planarity, [0, 0])
    normals, planarity = estimate_normals(np.zeros((0, 3), np.float32))
    assert (normals.shape, planarity.shape) == ((0, 3), (0,))


@pytest.fixture
def broken_open3d(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """Return the file of an ``open3d`` that is imported instead of the real one."""
    for name in [name for name in sys.modules if name == "open3d" or name.startswith("open3d.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    filters.open3d.cache_clear()
    yield tmp_path / "open3d.py"
    filters.open3d.cache_clear()
    sys.modules.pop("open3d", None)


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        ("ImportError('libusb-1.0.so.0: cannot open shared object file')", "libusb-1.0-0.*libusb-package"),
        ("OSError('libGL.so.1: cannot open shared object file')", "apt-get install libgl1"),
        ("ImportError('libgomp.so.1: cannot open shared object file')", "apt-get install libgomp1"),
        ("ModuleNotFoundError('none', name='open3d')", "pip install 'coview-stream\\[build\\]'"),
        ("ImportError('undefined symbol: xyz')", "undefined symbol: xyz.*reinstall"),
    ],
)
def test_missing_open3d_library_is_named_with_remedy(broken_open3d: Path, error: str, remedy: str) -> None:
    broken_open3d.write_text(f"raise {error}")
    with pytest.raises(DependencyError, match=remedy):
        filters.open3d()


@pytest.mark.skipif(sys.platform != "linux", reason="libusb is preloaded on Linux only")
def test_libusb_is_preloaded_and_open3d_import_retried(broken_open3d: Path) -> None:
    broken_open3d.write_text(
        "from pathlib import Path\nfrom unittest import mock\nutility = mock.Mock()\n"
        "if not Path(__file__).with_name('tried').exists():\n    Path(__file__).with_name('tried').touch()\n"
        "    raise ImportError('libusb-1.0.so.0: cannot open shared object file')\n"
    )
    assert filters.open3d().__file__ == str(broken_open3d)
