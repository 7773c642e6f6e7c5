"""One small town, scanned once, and a tiny village on disk."""

import numpy as np
import pytest
from tiny_world import TINY

from coview_stream.sim.scenes import build_scene
from coview_stream.sim.simulate import SimulationConfig, base_map, frames, simulate, trajectories

CONFIG = SimulationConfig(scene="town", sensor="os64", seed=11, size=120.0, length=3.0, density=6.0)


@pytest.fixture(scope="session")
def scene():
    return build_scene(CONFIG.scene, CONFIG.seed, CONFIG.size)


@pytest.fixture(scope="session")
def base(scene):
    return base_map(scene, CONFIG)


@pytest.fixture(scope="session")
def run(scene):
    """(true poses, points of all frames in the scene frame)."""
    _, truth, _ = trajectories(scene, CONFIG)
    clouds = [points @ T[:3, :3].T + T[:3, 3] for T, points in zip(truth, frames(scene, CONFIG, truth), strict=True)]
    return truth, np.concatenate(clouds)


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """A directory with the world of TINY."""
    out = tmp_path_factory.mktemp("worlds") / "a"
    simulate(out, TINY)
    return out
