"""A tile's cloud and stations in a few bytes a point: how far they come back from where they were."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.basemap.site.layers import (
    STEPS,
    cloud_layer,
    encode,
    read_cloud_layer,
    read_stations_layer,
    stations_layer,
)
from coview_stream.clouds.filters import voxel_grid
from coview_stream.errors import MapError

TILE, VOXEL = 320.0, 0.25
CORNER = np.array([-640.0, 320.0, 0.0])


def cloud(count=20_000):
    rng = np.random.default_rng(8)
    raw = rng.uniform([0.0, 0.0, -9.0], [TILE, TILE, 40.0], (count, 3)).astype(np.float32)
    points = voxel_grid(raw, VOXEL)
    normals = rng.normal(size=points.shape)
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return points, normals.astype(np.float32), rng.uniform(0.2, 1.0, len(points)).astype(np.float32)


def test_points_normals_and_planarity_come_back_within_their_steps():
    points, normals, planarity = cloud()
    layer = cloud_layer(points, normals, planarity, TILE, VOXEL)
    found, packed = read_cloud_layer(layer, CORNER, TILE, VOXEL)
    cells = np.floor(points / VOXEL)
    order = np.lexsort((cells[:, 2], cells[:, 0], cells[:, 1]))
    assert np.abs(found - CORNER - points[order]).max() <= 0.5 * VOXEL / STEPS + 1e-4
    length = np.linalg.norm(packed.astype(np.float64), axis=1)
    np.testing.assert_allclose(length / 127.0, planarity[order], atol=0.05)
    cosine = (packed * normals[order]).sum(axis=1) / length
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < 4.0


def test_bytes_a_point():
    """A flat street: the ground's points are next to each other, and their normals alike."""
    x, y = (each.ravel() for each in np.meshgrid(*(np.arange(0.125, 100.0, 0.25),) * 2))
    points = np.column_stack([x, y, 0.02 * np.random.default_rng(1).normal(size=x.size)]).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    layer = cloud_layer(points, normals, np.ones(len(points), np.float32), TILE, VOXEL)
    assert len(encode(layer)) < 2.0 * len(points)


@pytest.mark.parametrize("name", ["counts", "levels", "inside", "normals", "planarity"])
def test_arrays_that_do_not_fit_together_are_refused(name):
    layer = cloud_layer(*cloud(500), TILE, VOXEL)
    for wrong in (layer[name][:-1], layer[name].astype(np.float32), None):
        other = {k: v for k, v in layer.items() if k != name} | ({} if wrong is None else {name: wrong})
        with pytest.raises(MapError, match="tile's cloud"):
            read_cloud_layer(other, CORNER, TILE, VOXEL)


def test_stations_come_back_to_the_centimetre():
    rng = np.random.default_rng(2)
    cells = np.unique(rng.integers(-300, 300, (400, 2)), axis=0)
    stations = np.column_stack([(cells + 0.5) * 2.0, rng.uniform(-20.0, 90.0, len(cells))]).astype(np.float32)
    found = read_stations_layer(stations_layer(stations, 2.0), 2.0)
    order = np.lexsort((stations[:, 2], stations[:, 0], stations[:, 1]))
    np.testing.assert_array_equal(found[:, :2], stations[order, :2])
    assert np.abs(found[:, 2] - stations[order, 2]).max() <= 0.0051
    with pytest.raises(MapError, match="stations"):
        read_stations_layer({"steps": np.zeros((2, 5), dtype=np.int32)}, 2.0)
