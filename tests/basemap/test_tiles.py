"""Tiles: a crop is what a search of all points would find."""

import numpy as np
import pytest

from coview_stream.basemap.tiles import crop, scaled_normals, sort_by_tile, unit_normals

TILE = 5.0


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(7)
    points = rng.uniform([-30, -20, 0], [30, 20, 8], (5000, 3)).astype(np.float32)
    normals = rng.normal(size=(5000, 3))
    return points, (normals / np.linalg.norm(normals, axis=1)[:, None]).astype(np.float32)


@pytest.fixture(scope="module")
def tiled(cloud):
    return sort_by_tile(*cloud, TILE)


def rows(points):
    return sorted(map(tuple, points.tolist()))


def test_sorting_keeps_every_point_with_its_normal(cloud, tiled):
    points, packed, _ = tiled
    assert rows(points) == rows(cloud[0])
    order, before = np.lexsort(points.T), np.lexsort(cloud[0].T)
    away = np.einsum("ij,ij->i", packed[order] / 127.0, cloud[1][before])
    assert np.degrees(np.arccos(np.clip(away / np.linalg.norm(packed[order] / 127.0, axis=1), -1, 1))).max() < 0.5


def test_kept_normals_are_as_long_as_the_planarity_and_keep_their_direction(cloud):
    rng = np.random.default_rng(1)
    planarity = rng.choice([0.0, 0.2, 0.7, 1.0], len(cloud[1])).astype(np.float32)
    positive = cloud[0] + np.float32(100.0)  # one tile: as they came
    packed = sort_by_tile(positive, scaled_normals(cloud[1], planarity), 1e6)[1]
    assert np.abs(np.linalg.norm(packed / 127.0, axis=1) - np.maximum(planarity, 0.0625)).max() < 0.01
    along = np.einsum("ij,ij->i", unit_normals(packed), cloud[1])
    assert np.degrees(np.arccos(np.clip(along, -1.0, 1.0))).max() < 7.0
    np.testing.assert_array_equal(unit_normals(np.zeros((1, 3), np.int8)), [[0, 0, 0]])


def test_tile_index_covers_cloud_without_gap_or_overlap(tiled):
    points, _, index = tiled
    assert index[0, 2] == 0
    assert index[-1, 3] == len(points)
    np.testing.assert_array_equal(index[1:, 2], index[:-1, 3])
    assert len({(c, r) for c, r, *_ in index.tolist()}) == len(index)
    for column, row, begin, end in index:
        inside = points[begin:end, :2] / TILE
        assert (np.floor(inside) == [column, row]).all()


@pytest.mark.parametrize("centre", [(0, 0), (5, 5), (-29.9, 19.9), (12.3, -7.7), (35, 0), (900, 0)])
@pytest.mark.parametrize("radius", [0.5, 5.0, 17.0, 200.0])
def test_crop_holds_exactly_the_points_within_radius(cloud, tiled, centre, radius):
    found, normals = crop(*tiled, TILE, np.array([*centre, 0.0]), radius)
    near = np.hypot(*(cloud[0][:, :2] - np.array(centre, np.float32)).T) < radius
    assert rows(found) == rows(cloud[0][near])
    assert normals.shape == found.shape
    assert normals.dtype == found.dtype == np.float32
    if len(found):
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.01)
