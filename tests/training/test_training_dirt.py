"""Dirt of training drives: each kind does what it is for, and what has none is as it was."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coview_stream.sim.sensors import Caster
from coview_stream.training.sensors import TRAINED_DIRT, DriveDirt, trained_sensor
from coview_stream.training.train import SMOKE, train_session
from coview_stream.training.worlds import draw_world, submaps
from tests.training.test_submaps import TINY as FOREST

TINY = replace(FOREST, submaps=2, sensors=("os64",))
SEED = 19_513


def frame(kinds, seed=0):
    """A frame with dirt of these kinds, in the middle of a stand, and its dirt."""
    world = draw_world(SEED, TINY)
    T = np.eye(4)
    T[2, 3] = world.ground(np.zeros(1), np.zeros(1))[0] + 1.5
    dirt = DriveDirt.draw(kinds, np.random.default_rng(seed))
    lidar = trained_sensor("os64", lambda beams: 8)
    return dirt.scan(lidar, Caster(world.now, threads=1), world.ground, T, 0, 0.3, 0.0), dirt, world, T


def above(points, world, T):
    """Heights above the ground of the points whose beams went down."""
    down = points[points[:, 2] < -0.5] + T[:3, 3]
    return down[:, 2] - world.ground(down[:, 0], down[:, 1])


def test_a_leaning_sensor_turns_its_frames() -> None:
    _, dirt, *_ = frame(("mounting",))
    lean = np.degrees(np.arccos(dirt.T_body_sensor[2, 2]))
    assert 0.0 < lean < 4.0
    assert frame(())[1].T_body_sensor == pytest.approx(np.eye(4))


def test_grass_lifts_the_ground_and_nothing_falls_below_it() -> None:
    clean, grown = (above(points, world, T) for points, _, world, T in (frame(()), frame(("grass",), 2)))
    height = frame(("grass",), 2)[1].grass.height
    assert np.median(np.abs(clean)) < 0.03
    lifted = [((heights > 0.05) & (heights < height + 0.05)).mean() for heights in (clean, grown)]
    assert lifted[1] > lifted[0] + 0.05
    assert np.percentile(grown, 1) > -0.1


def test_drives_with_dirt_have_their_own_random_numbers() -> None:
    dirty = replace(TINY, dirt=TRAINED_DIRT)
    clean, spoilt = (list(submaps(draw_world(SEED, recipe), SEED, recipe)) for recipe in (TINY, dirty))
    assert len(spoilt) == len(clean)
    np.testing.assert_allclose(spoilt[0][1].pose, clean[0][1].pose)  # the same drive
    assert len(spoilt[0][1].points) > 0.5 * len(clean[0][1].points)


def test_a_training_with_dirt_writes_weights(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="training needs PyTorch: pip install '.[learn-train]'")
    plan = replace(SMOKE, worlds=1, most=2, training=replace(SMOKE.training, steps=1, pieces=1)).with_dirt()
    card = train_session(tmp_path, plan)
    assert tuple(card["plan"]["recipe"]["dirt"]) == TRAINED_DIRT
    assert any(tmp_path.glob("*.npz"))
