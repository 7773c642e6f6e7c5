"""Traffic, changes since the survey, snow and grass, and faults of the survey."""

import numpy as np
import pytest
from yard import scanned, standing, yard

from coview_stream.sim.airborne import POROSITY, airborne_scan
from coview_stream.sim.dirt import Dirt
from coview_stream.sim.dirt.scan import Surfaces, seasonal_caster
from coview_stream.sim.dirt.scene import Cover, Grass, Movers, Seasons, Snow, Traffic, Years, aged, drawn_parts, person
from coview_stream.sim.dirt.survey import Density, Strips, Thinning, disagreement, spoilt_strips
from coview_stream.sim.scenes import build_scene
from coview_stream.sim.sensors import Caster
from coview_stream.sim.simulate import SimulationConfig, base_map

RNG = np.random.default_rng


def centres(mesh, bodies):
    """Middle of each of so many equal meshes in one."""
    return mesh.vertices.reshape(bodies, -1, 3).mean(axis=1)


def test_companions_walk_behind_the_robot_wherever_it_is():
    movers = Movers(yard().site, Traffic(0.0, 0.0, companions=3), RNG(0))
    for x, seconds in ((0.0, 0.0), (20.0, 15.0)):
        T = standing()[0]
        T[0, 3] = x
        bodies = centres(movers.around(T, seconds), 3) - T[:3, 3]
        distance = np.hypot(*bodies[:, :2].T)
        assert (bodies[:, 0] < 0.0).all()
        assert ((distance > 1.0) & (distance < 4.0)).all()


def test_people_and_vehicles_move_from_frame_to_frame():
    for traffic, slow, fast in ((Traffic(0.0, 8.0, 0), 0.7, 1.8), (Traffic(6.0, 0.0, 0), 3.9, 12.1)):
        movers = Movers(yard().site, traffic, RNG(1))
        now, then = (movers.around(standing()[0], seconds).vertices for seconds in (10.0, 10.1))
        assert len(now) == len(then) > 0
        speed = np.linalg.norm(then - now, axis=1) / 0.1
        assert np.median(speed) > slow
        assert np.percentile(speed, 90) < fast


def test_traffic_is_seen_and_is_as_tall_as_people_are():
    assert person().vertices[:, 2].max() == pytest.approx(1.75)
    points = scanned(yard(), Dirt(traffic=Traffic(0.0, 0.0, companions=2)), 2)
    bodies = points[(points[:, 2] > -1.3) & (np.linalg.norm(points, axis=1) < 6.0)]
    assert len(bodies) > 200
    assert bodies[:, 2].max() < 0.35  # 1.75 m above the ground, the sensor at 1.5 m
    assert (bodies[:, 0] < 0.3).all()


def test_vehicles_leave_the_robot_alone():
    movers = Movers(yard().site, Traffic(30.0, 0.0, 0), RNG(2))
    for seconds in range(0, 60, 3):
        vertices = movers.around(standing()[0], float(seconds)).vertices
        assert np.hypot(*vertices[:, :2].T).min() > 0.5


@pytest.mark.parametrize("seed", range(6))
def test_strips_disagree_by_five_to_fifteen_centimetres_and_are_right_on_average(seed):
    grid = np.zeros((4, 3))
    strips = [(0.25 * k, grid.copy()) for k in range(1, 5)]
    moved = np.array([points[0] for _, points in spoilt_strips(iter(strips), Strips(), None, RNG(seed))])
    assert 0.05 <= disagreement(moved) <= 0.15
    np.testing.assert_allclose(moved.mean(axis=0), 0.0, atol=1e-12)
    exact = np.array([points[0] for _, points in spoilt_strips(iter(strips), Strips(0.1, 0.1), None, RNG(seed))])
    assert disagreement(exact) == pytest.approx(0.1)
    assert len({tuple(offset) for offset in exact}) == 4


@pytest.mark.slow
def test_two_strips_of_a_flat_yard_lie_on_two_levels():
    scene = yard()
    flown = list(airborne_scan(Caster(scene.mapped), 100.0, 2.0, RNG(0)))
    faults = spoilt_strips(iter(flown), Strips(0.15, 0.15), None, RNG(1))
    levels = [float(points[:, 2].mean()) for _, points in faults]
    assert max(abs(float(points[:, 2].mean())) for _, points in flown) < 0.002
    assert np.ptp(levels) > 0.005
    one = list(spoilt_strips(iter(flown[:1]), Strips(), None, RNG(1)))
    np.testing.assert_array_equal(one[0][1], flown[0][1])  # with nothing to disagree with


@pytest.mark.slow
def test_density_varies_from_thin_to_dense():
    scene = yard()
    config = SimulationConfig(scene="town", seed=1, size=100.0, density=20.0, dirt=Dirt(density=Density(1.0, 15.0)))
    base = base_map(scene, config)
    counts, _, _ = np.histogram2d(base[:, 0], base[:, 1], bins=20, range=[[-50, 50], [-50, 50]])
    density = counts / 25.0
    assert density.min() < 2.25
    assert density.max() > 8.75
    field = Thinning(Density(4.0, 60.0), RNG(3)).at(RNG(0).uniform(-500, 500, (20_000, 2)))
    assert 4.0 <= field.min() < 6.0
    assert 45.0 < field.max() <= 60.0


@pytest.fixture(scope="module")
def village():
    return build_scene("village", 4, 160.0)


def rises(state, footprints):
    origins = np.array([[f.x, f.y, f.ground + 80.0] for f in footprints], np.float32)
    down = np.tile(np.array([[0, 0, -1]], np.float32), (len(origins), 1))
    return 80.0 - Caster(state).trace(origins, down, RNG(0), 1.0).distance


@pytest.mark.slow
def test_years_take_and_bring_buildings(village):
    later, fate = aged(village, Years(20.0), RNG(0))
    assert len(fate.gone) == round((1 - 0.99**20) * len(village.footprints))
    assert min(len(fate.gone), len(fate.new), len(fate.rebuilt)) >= 1
    assert not set(fate.gone) & set(fate.new) | set(fate.gone) & set(fate.rebuilt)
    then, now = (rises(state, village.footprints) for state in (later.mapped, later.now))
    assert (then[fate.gone] > 2.0).all()
    assert (now[fate.gone] < 0.5).all()
    assert (then[fate.new] < 0.5).all()
    assert (now[fate.new] > 2.0).all()
    kept = np.setdiff1d(np.arange(len(then)), np.concatenate([fate.gone, fate.new, fate.rebuilt]))
    np.testing.assert_allclose(then[kept], now[kept], atol=1e-4)


def test_years_grow_trees_and_move_cars(village):
    before, after = drawn_parts(aged(village, Years(10.0), RNG(0))[0])
    old = {seed: height for height, seed in before.trees[:, [2, 7]]}
    grown = [height - old[seed] for height, seed in after.trees[:, [2, 7]] if seed in old]
    assert 0.6 * len(after.trees) < len(grown) < 0.95 * len(after.trees)
    assert np.median(grown) == pytest.approx(1.2)
    cars = [{tuple(row) for row in parts.cars} for parts in (before, after)]
    assert cars[0]
    assert not cars[0] & cars[1]
    _, fate = aged(village, Years(0.0), RNG(0))
    assert len(fate.gone) == len(fate.new) == len(fate.rebuilt) == 0


@pytest.mark.slow
def test_bare_trees_let_the_survey_through_and_conifers_do_not(village):
    parts = drawn_parts(village)[0]
    winter, summer = seasonal_caster(parts, village, Seasons(0.9)), Caster(village.mapped)

    def reached(caster, trees):
        """Share of pulses that come down to 2 m above the ground beside the trunks."""
        at = np.repeat(trees[:, :2] + 0.4 * trees[:, 3:4], 40, axis=0)
        at += RNG(1).uniform(-0.3, 0.3, at.shape)
        origins = np.column_stack([at, np.full(len(at), 100.0)]).astype(np.float32)
        down = np.tile(np.array([[0, 0, -1]], np.float32), (len(at), 1))
        hit = 100.0 - caster.trace(origins, down, RNG(2), POROSITY).distance
        return float((hit < village.site.z(*at.T) + 2.0).mean())

    conifers = parts.trees[:, 4] > 0.5
    assert reached(summer, parts.trees[~conifers]) < 0.5
    assert reached(winter, parts.trees[~conifers]) > reached(summer, parts.trees[~conifers]) + 0.3
    same = [reached(caster, parts.trees[conifers]) for caster in (winter, summer)]
    assert same[0] == pytest.approx(same[1], abs=0.15)


def lifts(snow, grass, y, slope=-1.0):
    """Heights above the ground of the returns of beams that come down at ``y`` metres beside the road's middle."""
    scene = yard()
    surfaces = Surfaces(scene, Cover(scene.site, snow, grass, RNG(1)), None, RNG(2))
    x = np.linspace(-40, 40, 3000)
    ray = np.array([np.sqrt(1 - slope**2), 0.0, slope])
    ends = np.column_stack([x, np.full(3000, y), np.zeros(3000)])
    origins = ends - 20.0 * ray
    echoes = surfaces.echoes(origins.astype(np.float32), np.tile(ray, (3000, 1)).astype(np.float32), RNG(3))
    return origins[:, 2] + echoes.distance * slope


@pytest.mark.parametrize("depth", [0.1, 0.4])
def test_snow_lifts_the_ground_by_its_depth_and_less_on_the_road(depth):
    np.testing.assert_allclose(lifts(None, None, 10.0), 0.0, atol=1e-3)
    snow = Snow(depth=depth, on_roads=0.5, drifts=0.1)
    assert lifts(snow, None, 10.0) == pytest.approx(depth, rel=0.11)
    assert lifts(snow, None, 0.0) == pytest.approx(0.5 * depth, rel=0.11)
    assert np.ptp(lifts(snow, None, 10.0)) > 0.01 * depth  # it drifts


def test_beams_end_within_the_grass_and_on_the_bare_road():
    grass = Grass(height=0.4, reach=0.3, tussocks=0.0)
    down, flat = lifts(None, grass, 12.0), lifts(None, grass, 12.0, slope=-0.2)
    for lift in (down, flat):
        assert lift.min() > -1e-3
        assert lift.max() < 0.4 + 1e-3
    assert 0.05 < (down < 1e-3).mean() < 0.95  # some come to the ground
    assert np.mean(flat) > np.mean(down) + 0.05  # flat beams end higher up
    np.testing.assert_allclose(lifts(None, grass, 0.0), 0.0, atol=1e-3)


def test_snow_buries_lower_grass():
    snow, grass = Snow(depth=0.5, drifts=0.0), Grass(height=0.3, tussocks=0.0)
    np.testing.assert_allclose(lifts(snow, grass, 12.0), 0.5, atol=2e-3)
