"""``.bin`` files of other than four columns are noticed, in whatever order their rows are."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.clouds.files import read_cloud
from coview_stream.clouds.npy_bin import likely_columns
from coview_stream.errors import CloudError

COLUMNS = range(3, 9)


def scan(shuffled):
    """Points of a spinning scanner between two walls, (N, 3)."""
    rng = np.random.default_rng(3)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.4)), np.radians(np.arange(-15, 16, 2)))
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    wall = 12.0 / np.maximum(np.abs(direction[:, 1]), 0.15)
    ground = np.where(direction[:, 2] < 0, -1.7 / np.minimum(direction[:, 2], -1e-6), np.inf)
    points = direction * np.minimum(wall, ground)[:, None] + rng.normal(0, 0.02, direction.shape)
    return rng.permutation(points) if shuffled else points


def rows(points, columns, intensity):
    rng = np.random.default_rng(4)
    values = {
        "unit": rng.uniform(0, 1, len(points)),
        "zero": np.zeros(len(points)),
        "byte": rng.integers(0, 256, len(points)),
    }
    more = [values[intensity], rng.integers(0, 16, len(points)), rng.uniform(0, 0.1, len(points))]
    more += [rng.normal(0, 3, len(points)) for _ in range(2)]
    return np.column_stack([points, *more[: columns - 3]]).astype("<f4")


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("intensity", ["unit", "zero", "byte"])
@pytest.mark.parametrize("columns", COLUMNS)
def test_columns_are_told_from_the_numbers(columns, intensity, shuffled):
    assert likely_columns(rows(scan(shuffled), columns, intensity).ravel(), 4) == columns


@pytest.mark.parametrize("columns", [3, 5, 6, 8])
def test_file_of_other_rows_is_refused_with_their_length(tmp_path, columns):
    path = tmp_path / "scan.bin"
    rows(scan(False)[: 840 * 12], columns, "unit").tofile(path)
    with pytest.raises(CloudError, match=f"rows of {columns} float32"):
        read_cloud(path)


def test_rows_of_nuscenes_are_read_by_their_name(tmp_path):
    points = scan(False)[:10_000]
    rows(points, 5, "byte").tofile(tmp_path / "n015__LIDAR_TOP__1.pcd.bin")
    np.testing.assert_allclose(read_cloud(tmp_path / "n015__LIDAR_TOP__1.pcd.bin").points, points, atol=1e-5)
    rows(points, 4, "unit").tofile(tmp_path / "other.pcd.bin")
    with pytest.raises(CloudError, match="rows of 4 float32"):
        read_cloud(tmp_path / "other.pcd.bin")


def test_small_and_flat_files_are_taken_as_they_are_named(tmp_path):
    flat = np.zeros((5000, 4), "<f4")
    flat[:, :2] = np.random.default_rng(1).uniform(-50, 50, (5000, 2))
    assert likely_columns(flat.ravel(), 4) == 4
    assert likely_columns(np.random.default_rng(2).normal(size=900).astype("<f4"), 4) == 4
    noise = np.random.default_rng(2).normal(size=84_000).astype("<f4")
    assert likely_columns(noise, 4) == 4
