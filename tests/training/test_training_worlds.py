import json
from dataclasses import asdict, replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from coview_stream.descriptors.birds_eye_view import LAYERS
from coview_stream.errors import ConfigError, InputError
from coview_stream.sim.sensors import INCLINATION, SENSORS
from coview_stream.training.drives import CLEARANCE, between_trees
from coview_stream.training.recipe import Recipe
from coview_stream.training.sensors import trained_sensor
from coview_stream.training.stands import Stand, draw_stand
from coview_stream.training.trees import PATTERNS, draw_stems
from coview_stream.training.worlds import (
    QUERY_CELLS,
    WorldViews,
    draw_world,
    read_world,
    submaps,
    world_views,
    write_dataset,
    write_world,
)

SMALL = Recipe(built=0.0, size=(100.0, 100.0), submaps=4, pulses=(8.0, 8.0), rays=40_000, standing=0.0)
BARE = replace(
    SMALL,
    stems=(250.0, 250.0),
    tree_height=(12.0, 20.0),
    crown_base=(0.6, 0.7),
    stem_radius=(0.15, 0.3),
    mortality=(0.0, 0.0),
    dead=(0.0, 0.0),
    understory=(0.0, 0.0),
    slope=(5.0, 5.0),
    roughness=(0.0, 0.0),
    gravity_error=(0.0, 0.0),
    scale_error=(0.0, 0.0),
    yaw_walk=(0.0, 0.0),
)


@lru_cache
def small_views() -> WorldViews:
    return world_views(3, SMALL)


@lru_cache
def stand(mortality: float) -> Stand:
    recipe = replace(BARE, mortality=(mortality, mortality), leaf_off=0.0, wind=(0.0, 0.0))
    return draw_stand(np.random.default_rng(5), recipe, 50.0)


@pytest.mark.slow
def test_every_sensor_sees_the_forest() -> None:
    views = small_views()
    assert sorted(views.sensor) == sorted(SMALL.sensors)
    assert views.queries.shape == (4, LAYERS, QUERY_CELLS, QUERY_CELLS)
    assert views.queries.dtype == views.aerial.dtype == np.uint8
    seen = (views.queries[:, -2] > 0).sum(axis=(1, 2))
    standing = (views.queries[:, :-3].max(axis=1) > 0).sum(axis=(1, 2))
    assert (seen > 200).all()
    assert (standing > 50).all()
    assert (np.abs(views.poses[:, :2]) <= 20.0 + 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize("sensor", BARE.sensors)
def test_label_pose_aligns_query_stems_with_map_trees(sensor: str) -> None:
    recipe, seed = replace(BARE, sensors=(sensor,), submaps=2), 11
    trees = draw_stand_of(seed, recipe).trees
    world = draw_world(seed, recipe)
    for _, submap in submaps(world, seed, recipe):
        x, y, yaw = submap.pose
        c, s = np.cos(yaw), np.sin(yaw)
        placed = submap.points[:, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
        # the query's zero is the sensor's height: what lies lowest over the world's ground is the ground
        over = submap.points[:, 2] - world.ground(*placed.T)
        up = over - np.quantile(over, 0.2)
        stems = placed[(up > 1.0) & (up < 3.0)]
        tree = cKDTree(trees.axis(np.full(len(trees.x), 2.0))[:, :2])
        assert len(stems) > 30
        assert (tree.query(stems)[0] < 0.6).mean() > 0.8
        assert (tree.query(stems + np.array([1.5, -1.0]))[0] < 0.6).mean() < 0.4


def draw_stand_of(seed: int, recipe: Recipe) -> Stand:
    """The stand that ``draw_world`` draws from this seed."""
    rng = np.random.default_rng([seed, 0])
    rng.uniform(*recipe.size)
    rng.random()
    return draw_stand(rng, recipe, recipe.size[0] / 2 + 8.0)


def test_tree_mortality_makes_epochs_differ() -> None:
    alike, different = stand(0.0), stand(0.3)
    np.testing.assert_array_equal(alike.mapped.solid.vertices, alike.now.solid.vertices)
    mapped, now = (len(epoch.foliage.triangles) for epoch in (different.mapped, different.now))
    assert mapped != now
    assert len(different.obstacles) < len(different.trees.x)
    stood = {tuple(row) for row in different.obstacles[:, :2]}
    gone = np.array([(x, y) not in stood for x, y in zip(different.trees.x, different.trees.y, strict=True)])
    assert 0.04 < gone.mean() < 0.2


@pytest.mark.parametrize("pattern", PATTERNS)
def test_stem_patterns_have_the_requested_density(pattern: str) -> None:
    counts = [len(draw_stems(np.random.default_rng(k), pattern, 500.0, 60.0)) for k in range(4)]
    assert 0.5 * 720 < np.mean(counts) < 1.1 * 720
    xy = draw_stems(np.random.default_rng(0), pattern, 500.0, 60.0)
    assert np.abs(xy).max() <= 60.0


def test_paths_keep_clearance_from_trees() -> None:
    rng = np.random.default_rng(0)
    obstacles = np.column_stack([rng.uniform(-60, 60, (500, 2)), rng.uniform(0.1, 1.5, 500)])
    for k in range(5):
        path = between_trees(np.random.default_rng(k), obstacles, 30.0, 15.0)
        assert np.abs(path[-1]).max() <= 30.0
        assert 1 < len(path) <= 151
        far = np.linalg.norm(path[:, None] - obstacles[None, :, :2], axis=2) - obstacles[:, 2]
        assert far.min() > CLEARANCE - 0.1
    assert len(between_trees(rng, np.zeros((0, 3)), 30.0, 15.0)) == 151


def test_inclined_sensor_rotates() -> None:
    sensor = trained_sensor("vlp16-inclined")
    first, half = sensor.beams(0), sensor.beams(10)  # half a turn later
    np.testing.assert_allclose(half, first * (-1, -1, 1), atol=1e-9)
    assert first[:, 2].max() > np.sin(INCLINATION)
    thinned = trained_sensor("vlp16-inclined", lambda beams: 3)
    assert len(thinned.beams(0)) == pytest.approx(len(first) / 3, rel=0.01)
    upright = trained_sensor("vlp16", lambda beams: 3)
    columns = [set(map(tuple, upright.beams(frame))) for frame in range(3)]
    assert not columns[0] & columns[1]
    assert set.union(*columns) == set(map(tuple, trained_sensor("vlp16").beams(0)))
    scanner = trained_sensor("blk360", lambda beams: 50)  # whole columns, and it stands while it scans
    assert len(np.unique(scanner.beams(0)[:, 2].round(6))) == len(
        np.unique(SENSORS["blk360"]().beams(0)[:, 2].round(6))
    )
    assert (scanner.stop, scanner.stand) == (5.0, 40.0)


@pytest.mark.slow
def test_world_files_round_trip(tmp_path) -> None:
    recipe = replace(SMALL, submaps=1)
    told = []
    paths = write_dataset(tmp_path / "views", [3], recipe, 1, lambda seed, seconds: told.append(seed))
    assert told == [3]
    assert [path.name for path in paths] == ["3.npz"]
    views = read_world(paths[0])
    np.testing.assert_array_equal(views.aerial, small_views().aerial)
    assert views.kind.startswith("forest")
    assert views.recipe["seed"] == 3
    assert views.recipe["recipe"] == json.loads(json.dumps(asdict(recipe)))
    write_dataset(tmp_path / "views", [3], recipe, 1, lambda seed, seconds: told.append(seed))
    assert told == [3]
    assert not list((tmp_path / "views").glob("*.part"))


@pytest.mark.slow
def test_urban_worlds_are_driven_along_streets(tmp_path) -> None:
    recipe = replace(SMALL, built=1.0, kinds=("village",), submaps=1)
    write_world(tmp_path / "village.npz", 1, recipe)
    views = read_world(tmp_path / "village.npz")
    assert views.kind == "village"
    assert (views.queries[0, :-3] > 0).any()


def test_files_of_other_kinds_are_refused(tmp_path) -> None:
    np.savez(tmp_path / "other.npz", aerial=np.zeros(3))
    for name in ("other.npz", "missing.npz"):
        with pytest.raises(InputError, match=name):
            read_world(tmp_path / name)


@pytest.mark.parametrize(
    "wrong",
    [
        {"built": 1.5},
        {"stems": (500.0, 100.0)},
        {"crown_base": (0.1, 2.0)},
        {"kinds": ("moon",)},
        {"sensors": ()},
        {"slope": (0.0, float("nan"))},
        {"submaps": 0},
        {"dirt": ("mud",)},
    ],
)
def test_invalid_recipes_are_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Recipe(**wrong)
