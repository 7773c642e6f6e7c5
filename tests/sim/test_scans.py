"""Scans: points lie on surfaces, the aircraft sees roofs, the robot sees facades."""

import numpy as np
import pytest
from surface_distance import distance_to_surfaces

from coview_stream.sim.mesh import EMPTY, Mesh, box, join, placed
from coview_stream.sim.scenes import SceneState
from coview_stream.sim.sensors import SENSORS, Caster

RNG = np.random.default_rng(0)


def around_buildings(scene, points):
    """Points within a metre of a footprint, and their height above the building's ground, as one array."""
    heights = []
    for f in scene.footprints:
        c, s = np.cos(f.yaw), np.sin(f.yaw)
        local = (points[:, :2] - (f.x, f.y)) @ np.array([[c, -s], [s, c]])
        near = (np.abs(local) < (f.w / 2 + 0.3, f.d / 2 + 0.3)).all(axis=1)
        heights.append(points[near, 2] - f.ground)
    return np.concatenate(heights)


@pytest.mark.slow
def test_scan_points_lie_on_surfaces(scene, base, run):
    for points, noise in ((base, 0.025), (run[1], 0.02)):
        sample = points[RNG.choice(len(points), 1500, replace=False)]
        off = distance_to_surfaces(scene, sample)
        assert np.median(off) < 1.5 * noise
        assert (off < 5 * noise).mean() > 0.9  # the rest lies in foliage


@pytest.mark.slow
def test_base_map_covers_its_square_at_configured_density(base):
    assert np.abs(base[:, :2]).max() < 60.0
    assert len(base) / 120.0**2 == pytest.approx(6.0, rel=0.15)
    filled, _, _ = np.histogram2d(base[:, 0], base[:, 1], bins=24, range=[[-60, 60], [-60, 60]])
    assert (filled > 0).mean() > 0.99


@pytest.mark.slow
def test_aerial_scan_has_roofs_and_robot_scan_has_facades(scene, base, run):
    airborne, ground = around_buildings(scene, base), around_buildings(scene, run[1])
    assert len(airborne) > 500
    assert len(ground) > 500
    walls = lambda heights: np.mean((heights > 0.7) & (heights < 2.2))  # noqa: E731 - used twice, on one screen
    assert walls(ground) > 3 * walls(airborne)
    assert np.median(airborne) > 2.0


@pytest.mark.slow
def test_the_robot_stands_on_the_road(scene, run):
    truth, _ = run
    position = truth[:, :3, 3]
    assert scene.site.road_distance(*position.T[:2]).max() < 1.0
    assert position[:, 2] - scene.site.z(*position.T[:2]) == pytest.approx(1.5)
    heading, step = truth[:-1, :3, 0], np.diff(position, axis=0)
    assert np.einsum("ij,ij->i", heading, step / np.linalg.norm(step, axis=1)[:, None]).min() > 0.98


FIELDS = {  # lowest and highest beam, degrees, and rings, after the data sheets
    "vlp16": (-15, 15, 16), "vlp16-inclined": (-60, 60, None), "os64": (-22.5, 22.5, 64), "mid360": (-7, 52, None),
    "os64-2048": (-22.5, 22.5, 64), "bpearl": (2.3, 89.5, 32), "blk360": (-59.7, 89.7, 250),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_beam_directions_are_unit_vectors_and_repeat_as_specified(name):
    sensor = SENSORS[name]()
    first, second = sensor.beams(0), sensor.beams(1)
    assert np.linalg.norm(first, axis=1) == pytest.approx(1.0)
    assert np.array_equal(first, second) is (name not in ("mid360", "vlp16-inclined"))
    elevation = np.degrees(np.arcsin(first[:, 2]))
    low, high, rows = FIELDS[name]
    assert elevation.min() == pytest.approx(low, abs=0.1)
    assert elevation.max() == pytest.approx(high, abs=0.1)
    assert rows is None or len(np.unique(elevation.round(6))) == rows
    azimuth = np.degrees(np.arctan2(first[:, 1], first[:, 0])) % 360
    assert np.diff(np.sort(azimuth)).max() < 1.0  # all round


def cast_down(scene, porosity, count=4000):
    rays = np.tile(np.array([[0, 0, -1]], np.float32), (count, 1))
    origins = np.column_stack([RNG.uniform(-3, 3, (count, 2)), np.full(count, 20.0)]).astype(np.float32)
    return Caster(scene).trace(origins, rays, np.random.default_rng(1), porosity)


def test_foliage_transmits_configured_share_of_rays():
    ground, leaves = box(20, 20, 1), placed(box(10, 10, 1), 0, 0, 8.0)
    upper = cast_down(SceneState(ground, leaves), 0.5).distance < 13
    assert upper.mean() == pytest.approx(0.75, abs=0.03)  # two surfaces, each stops half of what comes
    assert (cast_down(SceneState(ground, leaves), 0.0).distance < 13).all()
    solid = cast_down(SceneState(join([ground, leaves]), EMPTY), 0.5)
    np.testing.assert_allclose(solid.distance, 11.0, atol=1e-4)
    np.testing.assert_allclose(solid.incidence, 1.0, atol=1e-4)


def test_far_wall_at_grazing_angle_returns_fewer_points():
    corners = np.array([[10.0, -500, -50], [10, 500, -50], [10, 500, 50], [10, -500, 50]])
    wall = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    sensor = SENSORS["vlp16"]()
    points = sensor.scan(Caster(SceneState(wall, EMPTY)), np.eye(4), 0, np.random.default_rng(0))
    assert np.abs(points[:, 0] - 10.0).max() < 0.15
    returned = np.linalg.norm(points, axis=1)
    ahead = sensor.beams(0)[:, 0]
    expected = 10.0 / ahead[ahead > 0.05]
    assert returned.max() <= sensor.max_range + 0.2
    assert (returned < 30).sum() == pytest.approx(0.99 * (expected < 30).sum(), rel=0.02)
    far, grazed = (returned > 70).sum(), ((expected > 70) & (expected < 100)).sum()
    assert 0.2 * grazed < far < 0.8 * grazed
