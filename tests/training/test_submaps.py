"""A drive's frames, put together, are the submap that was always drawn; and Ctrl-C ends the writing of a data set."""

from __future__ import annotations

from concurrent.futures import Future

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coview_stream.clouds.filters import voxel_grid
from coview_stream.geometry.transforms import transform
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.sensors import Caster
from coview_stream.training.drives import RADIUS, VOXEL, _headings, _moments, _poses
from coview_stream.training.recipe import Recipe
from coview_stream.training.sensors import trained_sensor
from coview_stream.training.worlds import draw_world, drives, submaps, write_dataset

TINY = Recipe(
    built=0.0, size=(80.0, 80.0), slope=(0.0, 5.0), stems=(150.0, 200.0), rays=6000, pulses=(3.0, 3.0),
    travel=(3.0, 5.0), understory=(0.0, 0.0), submaps=6,
)  # fmt: skip
SEED = 19_512


def in_one_go(rng, recipe, caster, ground, path, sensor, porosity):
    """Drive, scan and add up frame by frame, in the order in which random numbers have always been drawn."""
    along, frames = _moments(rng, recipe, path, sensor)
    T = _poses(rng, recipe, path[along], _headings(path, rng)[along], ground)
    lidar = trained_sensor(sensor, lambda beams: int(np.ceil(beams * len(along) / recipe.rays)))
    noise = recipe.draw(rng, "ground_noise")
    config = OdometryConfig(
        yaw_walk=np.radians(recipe.draw(rng, "yaw_walk")),
        scale_error=recipe.draw(rng, "scale_error"),
        tilt_noise=np.radians(0.3 * recipe.gravity_error[1]),
        offset=0.0,
    )
    odometry, parts = drifting_odometry(T, config, rng), []
    for frame, true, told in zip(frames, T, odometry, strict=True):
        points = lidar.scan(caster, true, int(frame), rng, porosity=porosity, noise=noise)
        points = transform(told, points) - odometry[-1, :3, 3].astype(np.float32)
        parts.append(points[(points[:, :2] ** 2).sum(axis=1) < RADIUS**2])
    leaning = np.radians(recipe.draw(rng, "gravity_error")) * rng.normal(size=2)
    cloud = np.concatenate(parts) @ Rotation.from_rotvec([*leaning, 0.0]).as_matrix().T.astype(np.float32)
    yaw = Rotation.from_matrix(T[-1, :3, :3] @ odometry[-1, :3, :3].T).as_euler("ZYX")[0]
    return voxel_grid(cloud, VOXEL), np.array([*T[-1, :2, 3], yaw])


def test_submaps_from_frames_equal_submaps_cast_at_once() -> None:
    world = draw_world(SEED, TINY)
    rng = np.random.default_rng([SEED, 2])
    caster = Caster(world.now, threads=1, leaf_depth=TINY.draw(rng, "leaf_depth"))
    porosity = TINY.draw(rng, "ground_porosity")
    for k, (sensor, submap) in enumerate(submaps(world, SEED, TINY)):
        assert sensor == TINY.sensors[k % len(TINY.sensors)]
        short = rng.random() < TINY.standing
        length = rng.uniform(0, min(3.0, TINY.travel[1])) if short else TINY.draw(rng, "travel")
        length = 0.0 if short and rng.random() < 0.5 else length
        path = world.path(rng, world.size / 2 - RADIUS, length)
        points, pose = in_one_go(rng, TINY, caster, world.ground, path, sensor, porosity)
        np.testing.assert_array_equal(submap.points, points)
        np.testing.assert_array_equal(submap.pose, pose)


def test_frames_lie_on_each_other_at_their_true_poses() -> None:
    world = draw_world(SEED, TINY)
    for sensor, frames in drives(world, SEED, TINY):
        assert sensor in TINY.sensors
        assert len(frames.truth) == len(frames.odometry) == len(frames.clouds)
        assert frames.lean.shape == (2,)
        for T, cloud in zip(frames.truth, frames.clouds, strict=True):
            x, y, z = transform(T, cloud.astype(np.float64)).T
            assert np.abs(np.quantile(z - world.ground(x, y), 0.02)) < 0.3


class Pool:
    """Stands for a pool whose first job meets Ctrl-C."""

    def __init__(self) -> None:
        self.shut: list[dict] = []

    def __call__(self, workers, mp_context):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        return False

    def submit(self, work, seed):
        job: Future = Future()
        job.set_exception(KeyboardInterrupt())
        return job

    def shutdown(self, **how):
        self.shut.append(how)


def test_interrupt_ends_dataset_writing(tmp_path, monkeypatch) -> None:
    pool = Pool()
    monkeypatch.setattr("coview_stream.training.worlds.ProcessPoolExecutor", pool)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path, range(5), TINY, workers=2)
    assert pool.shut == [{"wait": False, "cancel_futures": True}]
