"""Drives through training worlds: a path, the frames along it, and their submap by drifting odometry."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coview_stream.clouds.filters import voxel_grid
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, transform
from coview_stream.sim.layout import Layout, arc_lengths, directions
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.sensors import FRAME_PERIOD, Caster
from coview_stream.training.recipe import Recipe
from coview_stream.training.sensors import DriveDirt, trained_sensor

CLEARANCE = 0.6
"""Metres between the robot's centre and a stem."""

STEP = 0.1
"""Metres between the points of a path."""

_CANDIDATES = 150  # random paths, of which the longest free one is used
_COARSE = 5  # steps between tested points
_LANE = 0.7  # metres to either side of a street's middle


def between_trees(rng: np.random.Generator, obstacles: Floats, extent: float, length: float) -> Floats:
    """Draw a path (N, 2) of ``length`` metres, or shorter if trees block it, that ends within +-``extent`` metres.

    ``obstacles`` (K, 3) are x, y and radius, metres.
    """
    count = int(length / STEP) + 1
    at = np.arange(count) * STEP
    end = rng.uniform(-extent, extent, (_CANDIDATES, 2))
    heading = rng.uniform(0, 2 * np.pi, (_CANDIDATES, 1))
    # curvature changes along the path: at most 90 degrees in 8 m
    bend = rng.normal(0, 0.06, (_CANDIDATES, 1)) + rng.normal(0, 0.1, (_CANDIDATES, 1)) * np.sin(
        2 * np.pi * at / rng.uniform(8, 25, (_CANDIDATES, 1)) + rng.uniform(0, 6, (_CANDIDATES, 1))
    )
    heading = heading + np.cumsum(np.clip(bend, -0.2, 0.2), axis=1) * STEP
    step = STEP * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    paths = end[:, None] + np.cumsum(step, axis=1) - step[:, :1]
    tested = paths[:, ::_COARSE]
    free = (np.abs(tested) < extent + 15).all(axis=2)
    thin = obstacles[:, 2] <= 0.5
    for trunks in (obstacles[thin], obstacles[~thin]):
        if len(trunks):
            far, nearest = cKDTree(trunks[:, :2]).query(tested, distance_upper_bound=8.0)
            free &= far > np.append(trunks[:, 2], 0.0)[nearest] + CLEARANCE
    reach = np.cumprod(free, axis=1).sum(axis=1)
    best = int(np.argmax(reach))  # the first of the longest
    kept = min(count, max(1, (int(reach[best]) - 1) * _COARSE + 1))
    return np.asarray(paths[best, :kept][::-1])


def along_streets(rng: np.random.Generator, layout: Layout, extent: float, length: float) -> Floats:
    """Draw a path (N, 2) of up to ``length`` metres along a street that ends within +-``extent`` metres."""
    streets = [line for line in (layout.route, *layout.streets) if (np.abs(line) < extent).all(axis=1).any()]
    line = streets[int(rng.integers(len(streets)))]
    line = line if rng.random() < 0.5 else line[::-1]
    arc = arc_lengths(line)
    inside = np.flatnonzero((np.abs(line) < extent).all(axis=1))
    newest = arc[int(rng.choice(inside))]
    at = newest - np.arange(int(length / STEP) + 1)[::-1] * STEP
    at = at[at >= 0] if newest > 0 else np.zeros(1)
    heading = np.interp(at, arc, np.unwrap(directions(line)))
    sideways = rng.uniform(-_LANE, _LANE) + 0.2 * np.sin(at / rng.uniform(4, 8) + rng.uniform(0, 6))
    x = np.interp(at, arc, line[:, 0]) - sideways * np.sin(heading)
    y = np.interp(at, arc, line[:, 1]) + sideways * np.cos(heading)
    return np.column_stack([x, y])


RADIUS = 30.0
"""Metres around the newest position within which points are kept."""

VOXEL = 0.25
"""Edge of a voxel, metres; one point per voxel is kept, as in the map."""

_SPEED = 1.2  # metres per second
_WHEELBASE = 1.0  # metres
_PAUSE = 3  # frames from one kept frame to the next while the robot stands
_STEP_SHARE = {"vlp16-inclined": 0.4}  # of the usual step, as each of its frames covers only a narrow band
_MIN_FRAMES = {"mid360": (5, 12), "vlp16-inclined": (8, 20)}  # range from which the number is drawn


class Submap(NamedTuple):
    """A query: a robot's local cloud and its true pose."""

    points: Points  # (N, 3) metres, odometry's axes, origin at the newest position of the sensor
    pose: Floats  # (3,) x, y and yaw: p_world = R(yaw) p + (x, y)
    travelled: float  # metres driven


class Frames(NamedTuple):
    """Frames along a drive, oldest first."""

    truth: Floats  # (F, 4, 4) map <- sensor
    odometry: Floats  # (F, 4, 4) odometry <- sensor, drifting
    clouds: tuple[Points, ...]  # (N, 3) of each frame, the sensor's axes, metres
    lean: Floats  # (2,) error of the odometry's gravity direction, roll and pitch, radians
    travelled: float  # metres driven


def scanned(
    rng: np.random.Generator,
    recipe: Recipe,
    caster: Caster,
    ground: Callable[[Floats, Floats], Floats],
    path: Floats,
    sensor: str,
    porosity: float,
) -> Frames:
    """Return the frames of a drive along a path (N, 2) over the ``ground`` to its end."""
    along, frames = _moments(rng, recipe, path, sensor)
    heading = directions(path) if len(path) > 2 else np.full(len(path), rng.uniform(0, 2 * np.pi))
    T = _poses(rng, recipe, path[along], heading[along], ground)
    lidar = trained_sensor(sensor, lambda beams: int(np.ceil(beams * len(along) / recipe.rays)))
    noise = recipe.draw(rng, "ground_noise")
    config = OdometryConfig(
        yaw_walk=np.radians(recipe.draw(rng, "yaw_walk")),
        scale_error=recipe.draw(rng, "scale_error"),
        tilt_noise=np.radians(0.3 * recipe.gravity_error[1]),
        offset=0.0,
    )
    odometry = drifting_odometry(T, config, rng)
    if recipe.dirt:
        dirt = DriveDirt.draw(recipe.dirt, rng.spawn(1)[0])
        clouds = tuple(
            dirt.scan(lidar, caster, ground, true, int(frame), porosity, noise)
            for frame, true in zip(frames, T, strict=True)
        )
    else:
        clouds = tuple(
            lidar.scan(caster, true, int(frame), rng, porosity=porosity, noise=noise)
            for frame, true in zip(frames, T, strict=True)
        )
    lean = np.radians(recipe.draw(rng, "gravity_error")) * rng.normal(size=2)
    return Frames(T, odometry, clouds, lean, (len(path) - 1) * STEP)


def gathered(frames: Frames) -> Submap:
    """Return the submap of a drive's frames, joined by their odometry."""
    newest = frames.odometry[-1, :3, 3]
    parts = []
    for T_odom_sensor, cloud in zip(frames.odometry, frames.clouds, strict=True):
        points = transform(T_odom_sensor, cloud) - newest.astype(np.float32)
        parts.append(points[(points[:, :2] ** 2).sum(axis=1) < RADIUS**2])
    leaning = Rotation.from_rotvec([*frames.lean, 0.0]).as_matrix()
    cloud = np.concatenate(parts) @ leaning.T.astype(np.float32)
    last = frames.truth[-1]
    yaw = Rotation.from_matrix(last[:3, :3] @ frames.odometry[-1, :3, :3].T).as_euler("ZYX")[0]
    x, y = last[:2, 3]
    return Submap(voxel_grid(cloud, VOXEL), np.array([x, y, yaw]), frames.travelled)


def _moments(rng: np.random.Generator, recipe: Recipe, path: Floats, sensor: str) -> tuple[Ints, Ints]:
    """Draw the indices (K,) of the path's points with a frame, and the sensor's frame numbers (K,) there."""
    spacing = recipe.draw(rng, "frame_step") * _STEP_SHARE.get(sensor, 1.0)
    last = len(path) - 1
    along = last - (np.arange(0, last + 1, spacing / STEP)[::-1]).astype(np.int64)
    # a robot that has hardly moved has scanned longer
    stood = max(0, int(rng.integers(*_MIN_FRAMES.get(sensor, (2, 6)))) - len(along))
    frames = np.round((along - along[0]) * STEP / _SPEED / FRAME_PERIOD).astype(np.int64) + _PAUSE * stood
    along = np.concatenate([np.full(stood, along[0]), along])
    frames = np.concatenate([np.arange(stood) * _PAUSE, frames])
    return along, frames + int(rng.integers(0, 10_000))


def _poses(
    rng: np.random.Generator, recipe: Recipe, xy: Floats, heading: Floats, ground: Callable[[Floats, Floats], Floats]
) -> Floats:
    """Draw poses (K, 4, 4) of the sensor at (K, 2), tilted with the ground under the robot and swaying."""
    x, y = xy.T
    cx, cy = np.cos(heading) * _WHEELBASE / 2, np.sin(heading) * _WHEELBASE / 2
    ahead = ground(x + cx, y + cy) - ground(x - cx, y - cy)
    left = ground(x - cy, y + cx) - ground(x + cy, y - cx)
    lean = np.arctan2(np.column_stack([left, -ahead]), _WHEELBASE)
    lean += np.radians(recipe.draw(rng, "tilt")) * rng.normal(size=lean.shape)
    poses = np.tile(np.eye(4), (len(xy), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([heading, lean[:, 1], lean[:, 0]])).as_matrix()
    height = recipe.draw(rng, "sensor_height")
    poses[:, :3, 3] = np.column_stack([x, y, ground(x, y) + height])
    return poses
