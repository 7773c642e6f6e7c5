from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds, poses

from coview_kernels import (
    Distances,
    PointGrid,
    PointKind,
    Raster,
    Sight,
    match_points,
    match_rays,
    reference,
    sort_beams,
)

OTHER, HIGH, LOW = PointKind
DISTANCES = Distances(reach=0.5, search=2.0, off=0.3, rise=0.5)
SIGHT = Sight(beam=np.radians(2.0), least=1.0, farthest=35.0, slack=0.5, slope=0.03)


def finite(points):
    return points[(np.abs(points) < 1e6).all(axis=1)]


def raster(rng, kind):
    """Cells of 3 m over the middle of the clouds; half of them hold nothing, rows run along x or along y."""
    values = np.where(rng.random((20, 30)) < 0.5, 0, rng.uniform(1, 60, (20, 30))).astype(kind)
    return Raster(values if rng.random() < 0.5 else np.asfortranarray(values), np.array([-30.0, -45.0]), 3.0)


@given(clouds(), poses(), st.integers(0, 2**32 - 1))
def test_points_agree_with_numpy(cloud, T, seed):
    rng = np.random.default_rng(seed)
    cloud = finite(cloud)
    normals = rng.normal(size=cloud.shape).astype(np.float32)
    near = cloud + rng.normal(scale=0.3, size=cloud.shape).astype(np.float32)
    scan = ((np.concatenate([near, cloud[::-1] + np.float32(5.0)]) - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    kinds = rng.integers(0, 3, len(scan)).astype(np.uint8)
    grid, walls, survey = PointGrid(cloud), raster(rng, np.float32), raster(rng, np.uint8)
    found = match_points(grid, normals, scan, kinds, T, walls, survey, DISTANCES)
    assert found == reference.match_points(grid.tree, normals, scan, kinds, T, walls, survey, DISTANCES)


def test_each_kind_of_point_is_counted():
    """Two high points, one of them at the map's pole and one below its edge; two low ones, one 0.4 m off the plane."""
    grid = PointGrid(np.array([[0, 0, 5], [10, 0, 0], [20, 0, 0]], dtype=np.float32))
    up = np.tile(np.array([0, 0, 1], dtype=np.float32), (3, 1))
    scan = np.array([[0.3, 0, 5.3], [4, 0, 2], [10.9, 0, 0.2], [20, 0, 0.4], [4, 0, 9], [99, 0, 0]])
    kinds = [HIGH, HIGH, LOW, LOW, OTHER, HIGH]
    walls = Raster(np.full((1, 1), 3.0, dtype=np.float32), np.array([2.0, -2.0]), 4.0)
    survey = Raster(np.ones((1, 1), dtype=np.uint8), np.array([-50.0, -50.0]), 100.0)
    assert match_points(grid, up, scan, kinds, np.eye(4), walls, survey, DISTANCES) == (5, 2, 1, 2, 2, 1)


def rays(rng, count):
    """(N, 3) points in all directions but those within 1e-4 degrees of the edge between two cells."""
    directions = np.radians((rng.integers(0, [180, 90], (count, 2)) + rng.uniform(1e-4, 1 - 1e-4, (count, 2))) * 2.0)
    turn, rise = directions[:, 0] - np.pi, directions[:, 1] - np.pi / 2
    far = rng.uniform(0.5, 40.0, count)
    return (far * [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)]).T.astype(np.float32)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 5000])
@pytest.mark.parametrize("every", [1, 3])
def test_beams_and_rays_agree_with_numpy(count, every):
    rng = np.random.default_rng(count)
    cloud = rays(rng, count)
    seen, expected = sort_beams(cloud, SIGHT, every), reference.sort_beams(cloud[::every], SIGHT)
    for a, b in zip(seen, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    limits = np.where(seen.hits > 0, [seen.nearest, seen.farthest], -np.inf).astype(np.float32)
    T = np.eye(4)
    T[:3, 3] = 5.0, -3.0, 2.0
    points = (rays(rng, 4000) + T[:3, 3]).astype(np.float32)
    found = match_rays(limits, points, T, -1.0, SIGHT, every)
    # float32 in place of float64 may take a point to the next cell
    np.testing.assert_allclose(found, reference.match_rays(limits, points[::every], T, -1.0, SIGHT), atol=2)
    assert count < 5000 or found.met * found.passed > 0


@pytest.mark.parametrize(
    "direction", [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [-1, -0.0, 0]]
)
def test_directions_along_the_axes_have_a_cell(direction):
    beams = sort_beams(np.array([direction]) * 7.0, SIGHT)
    assert beams.hits.sum() == 1
    assert beams.farthest.max() == 7.0


def test_bad_arguments_are_named():
    grid, raster_ = PointGrid(np.zeros((1, 3))), Raster(np.zeros((1, 1), np.uint8), np.zeros(2), 1.0)
    walls = raster_._replace(values=np.zeros((1, 1), np.float32))
    with pytest.raises(ValueError, match="kinds"):
        match_points(grid, np.zeros((1, 3)), np.zeros((2, 3)), [1], np.eye(4), walls, raster_, DISTANCES)
    with pytest.raises(ValueError, match="every"):
        sort_beams(np.zeros((1, 3)), SIGHT, 0)
    with pytest.raises(ValueError, match="limits"):
        match_rays(np.zeros((2, 5)), np.zeros((1, 3)), np.eye(4), 0.0, SIGHT)
