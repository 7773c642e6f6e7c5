"""Scenes: free roads, things on the ground, and changes that leave the map alone."""

import numpy as np
import pytest

from coview_stream.errors import ConfigError
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.layout import arc_lengths
from coview_stream.sim.scenes import build_scene
from coview_stream.sim.sensors import Caster
from coview_stream.sim.simulate import SimulationConfig, base_map


@pytest.fixture(scope="module", params=sorted(KINDS))
def any_scene(request):
    return build_scene(request.param, 3, 140.0)


def test_route_is_a_smooth_loop_inside_the_map(any_scene):
    route = any_scene.route
    assert np.abs(route).max() < any_scene.size / 2
    assert np.hypot(*(route[0] - route[-1])) < 0.5
    assert arc_lengths(route)[-1] > 100.0
    assert np.hypot(*np.diff(route, axis=0).T).max() < 0.6


def test_buildings_stand_beside_the_roads_and_not_in_each_other(any_scene):
    places = np.array([[f.x, f.y] for f in any_scene.footprints])
    assert len(places) >= 2
    road = any_scene.site.road_distance(*places.T)
    halves = np.array([min(f.w, f.d) / 2 for f in any_scene.footprints])
    assert (road > any_scene.site.layout.half_width + halves - 0.75).all()
    gaps = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 1e3 * np.eye(len(places))
    assert (gaps.min(axis=1) > halves).all()


def test_nothing_solid_blocks_the_robot(any_scene):
    vertices = any_scene.mapped.solid.vertices
    x, y, z = vertices.T
    lift = z - any_scene.site.z(x, y)
    in_the_way = vertices[(lift > 0.3) & (lift < 1.8)]
    steps = any_scene.route[::8]
    nearest = min(np.hypot(*(in_the_way[:, :2] - step).T).min() for step in steps)
    assert nearest > 0.9


def test_robots_drive_through_the_hall_of_a_depot_and_the_map_has_its_inside():
    config = SimulationConfig("depot", seed=3, size=100.0, density=2.0)
    scene = build_scene("depot", 3, 100.0)
    hall = scene.passage
    inside = hall.holds(scene.route, -0.5)
    assert arc_lengths(scene.route)[-1] * inside.mean() == pytest.approx(21.0, abs=0.5)
    up = np.tile(np.float32([0, 0, 1]), (inside.sum(), 1))
    x, y = scene.route[inside].T
    eyes = np.column_stack([x, y, scene.site.z(x, y) + 1.5]).astype(np.float32)
    roof = Caster(scene.now).trace(eyes, up, np.random.default_rng(0), 0.0).distance
    assert ((roof > 2.5) & (roof < 6.5)).all()
    assert build_scene("industrial", 3, 100.0).passage is None
    base = base_map(scene, config)
    within = base[hall.holds(base[:, :2], -0.5)]
    lift = within[:, 2] - scene.site.z(*within[:, :2].T)
    assert (np.abs(lift) < 0.2).sum() > 5000  # its floor, which no aircraft sees
    assert ((lift > 0.5) & (lift < 4.0)).sum() > 5000


def test_scene_triangles_are_valid(any_scene):
    for mesh in (*any_scene.mapped.__dict__.values(), *any_scene.now.__dict__.values()):
        assert np.isfinite(mesh.vertices).all()
        assert mesh.triangles.min() >= 0
        assert mesh.triangles.max() < len(mesh.vertices)


@pytest.mark.slow
def test_scene_change_keeps_the_map_and_replaces_configured_share():
    before, after = build_scene("village", 3, 140.0), build_scene("village", 3, 140.0, changed=0.3)
    for name in ("solid", "foliage"):
        np.testing.assert_array_equal(getattr(before.mapped, name).vertices, getattr(after.mapped, name).vertices)
    old = {tuple(v) for v in np.round(after.mapped.foliage.vertices, 6)}
    new = {tuple(v) for v in np.round(after.now.foliage.vertices, 6)}
    kept = len(old & new) / len(old)
    assert 0.55 < kept < 0.95  # bushes stay, 30 % of the trees do not
    assert len(new - old) > 0.1 * len(old)
    assert before.now is before.mapped


def test_an_unknown_kind_names_the_known_ones():
    with pytest.raises(ConfigError, match=r"'moon'.*town"):
        build_scene("moon", 1)
