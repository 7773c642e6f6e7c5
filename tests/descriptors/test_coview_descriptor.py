"""Descriptors: bins where they belong, one zero for both sides, and equal scans described equally."""

import numpy as np
import pytest

from coview_stream.basemap.stations import aligned_corner, describe_stations, rasterise
from coview_stream.config import DescriptorConfig
from coview_stream.descriptors.coview import EYE, describe, ground_below

ALL = DescriptorConfig(radius=20.0, rings=10, sectors=12, channels=("scan_context", "coview", "paper"))


def polar(r, degrees, z):
    a = np.radians(degrees)
    return np.column_stack([r * np.cos(a), r * np.sin(a), np.full_like(a, z)]).astype(np.float32)


def lattice(rng, half=20, top=5):
    """One point per 0.5 m voxel column level, at cell centres around stations at odd metres."""
    axis = 1.0 + 0.5 * np.arange(-2 * half, 2 * half + 1)
    x, y = (v.ravel() for v in np.meshgrid(axis, axis))
    level = rng.integers(0, 2 * top, len(x)) * (rng.random(len(x)) < 0.2)
    points = [np.column_stack([x, y, np.full(len(x), 0.25)])]
    points += [np.column_stack([x, y, 0.25 + 0.5 * k * np.ones(len(x))])[level >= k] for k in range(1, 2 * top)]
    return np.concatenate(points).astype(np.float32)


@pytest.mark.parametrize(("degrees", "sector"), [(1.0, 0), (29.0, 0), (31.0, 1), (95.0, 3), (-1.0, 11), (181.0, 6)])
@pytest.mark.parametrize(("r", "ring"), [(0.5, 0), (1.9, 0), (2.1, 1), (19.9, 9)])
def test_point_falls_in_its_ring_and_sector(r, ring, degrees, sector):
    centre = np.array([100.0, -50.0, 7.0])
    points = (polar(r, np.array([degrees]), 3.0) + centre).astype(np.float32)
    found = describe(points, centre, ALL)["scan_context"]
    assert np.argwhere(found).tolist() == [[ring, sector]]
    assert found[ring, sector] == pytest.approx(3.0, abs=1e-5)


def test_bins_hold_max_height_above_centre_and_depressions_are_zero():
    points = np.concatenate(
        [polar(5.0, np.array([40.0, 41.0]), z) for z in (1.0, 4.0)] + [polar(9.0, np.array([40.0]), -2.0)]
    )
    found = describe(points, np.array([0, 0, -1.0]), ALL)["scan_context"]
    assert found[2, 1] == 5.0
    assert found[4, 1] == 0.0
    assert (found >= 0).all()


def test_scan_and_map_describe_the_same_cloud_alike_with_the_ground_as_zero():
    """A keyframe at sensor height and a station on the ground describe one cloud alike."""
    points = lattice(np.random.default_rng(5))
    points[:, 2] += 41.0
    sensor = np.array([1.0, 1.0, 41.25 + 1.9])
    ground = ground_below(points, sensor)
    # the lattice's ground is flat; nearly all 1 m cells hold some of it
    assert ground == pytest.approx(41.25, abs=1e-5)
    raster = rasterise(points, aligned_corner(points, 2.0, 0.5), 0.5, 0.5, margin=4, means=True)
    stations = describe_stations(raster, np.array([[1.0, 1.0, 41.25]], np.float32), ALL)
    local = describe(points, np.array([*sensor[:2], ground]), ALL)
    for name in ALL.channels:
        np.testing.assert_allclose(local[name], stations[name][0], rtol=1e-3, atol=2e-3, err_msg=name)
        assert np.count_nonzero(local[name]) > 10
    from_sensor = describe(points, sensor, ALL)["scan_context"]
    assert np.abs(from_sensor - stations["scan_context"][0]).mean() > 0.5


@pytest.mark.parametrize("slope", [-0.2, -0.05, 0.0, 0.1, 0.2])
def test_ground_below_on_a_slope(slope):
    xy = np.random.default_rng(2).uniform(-15, 15, (8000, 2))
    points = np.column_stack([xy, 12.0 + slope * xy[:, 0]]).astype(np.float32)
    # the lowest point of a 1 m cell lies half a cell downhill and more
    assert ground_below(points, np.array([0.0, 0.0, 14.0])) == pytest.approx(12.0, abs=0.05 + 0.7 * abs(slope))


def test_ground_below_with_clutter():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-8, 8, (6000, 2))
    z = rng.normal(0.0, 0.02, len(xy))
    z[(xy[:, 0] > 1.5) & (xy[:, 0] < 4.5)] = 1.4  # a row of parked cars hides the ground
    z[rng.choice(len(z), 20)] = -3.0  # echoes from below
    z[rng.choice(len(z), 500)] = 1.2
    points = np.column_stack([xy, z]).astype(np.float32)
    assert ground_below(points, np.array([0.0, 0.0, 1.8])) == pytest.approx(0.0, abs=0.1)


def test_ground_below_uses_points_near_the_robot_only():
    near = polar(4.0, np.arange(0.0, 360, 5), 0.0)
    far = polar(7.0, np.arange(0.0, 360, 1), -30.0)
    shift = np.array([300, -200, 50], np.float32)
    assert ground_below(np.concatenate([near, far]) + shift, np.array([300.0, -200.0, 52.0])) == pytest.approx(50.0)


def test_origin_of_a_body_may_lie_on_the_ground():
    """As a ``base_footprint`` does; a hemisphere that looks up sees only the feet of walls at its own height."""
    rings = np.concatenate([polar(r, np.arange(0.0, 360, 3), 0.05) for r in (6.5, 7.5, 9.0, 11.0, 14.0)])
    walls = np.concatenate([polar(12.5, np.arange(-40.0, 40, 2), z) for z in np.arange(0.1, 6.0, 0.4)])
    crowns = np.concatenate([rings + np.float32([0, 0, 4]), rings, walls])
    here = np.zeros(3)
    assert ground_below(np.concatenate([rings, walls]), here) == 0.0
    assert ground_below(crowns, here) == 0.0
    assert ground_below(np.concatenate([crowns, polar(2.0, np.arange(0.0, 360, 20), -0.1)]), here) == pytest.approx(
        -0.1
    )
    assert ground_below(walls, here) == -EYE


def test_without_ground_points_the_sensor_stands_at_the_usual_height():
    sensor = np.array([0.0, 0.0, 2.0])
    assert ground_below(np.empty((0, 3), np.float32), sensor) == 2.0 - EYE
    assert ground_below(polar(3.0, np.arange(0.0, 360, 5), 5.0), sensor) == 2.0 - EYE
