"""How the robot drives: along the route at a steady speed, swaying on the ground it drives over."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.sim.layout import arc_lengths, directions
from coview_stream.sim.mesh import Floats
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD

_SWAY = float(np.radians(0.6))  # roll and pitch jitter, one sigma
_SWAY_MEMORY = 0.8  # of the frame before; a body on wheels swings at about 1 Hz
_WANDER = 0.25  # metres; the robot does not keep to the middle of its lane
_WHEELBASE = 1.0  # metres over which the ground tilts the robot


def drive(scene: Scene, length: float, speed: float, height: float, rng: np.random.Generator) -> Floats:
    """Poses (N, 4, 4) of the sensor in the scene, one every 0.1 s over ``length`` metres.

    The start lies anywhere on the route, which is driven round again if need be; either direction. The sensor
    is ``height`` metres above the ground, and pitches and rolls with it.
    """
    route = scene.route if rng.random() < 0.5 else scene.route[::-1]
    arc = arc_lengths(route)
    count = int(length / (speed * FRAME_PERIOD)) + 1
    at = (rng.uniform(0, arc[-1]) + np.arange(count) * speed * FRAME_PERIOD) % arc[-1]
    heading = np.interp(at, arc, np.unwrap(directions(route)))
    sideways = _WANDER * np.sin(2 * np.pi * at / rng.uniform(25, 45) + rng.uniform(0, 2 * np.pi))
    x = np.interp(at, arc, route[:, 0]) - sideways * np.sin(heading)
    y = np.interp(at, arc, route[:, 1]) + sideways * np.cos(heading)
    tilts = _slopes(scene, x, y, heading) + _sway(rng, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    angles = np.column_stack([heading, tilts[:, 1], tilts[:, 0]])
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    poses[:, :3, 3] = np.column_stack([x, y, scene.site.z(x, y) + height])
    return poses


def _slopes(scene: Scene, x: Floats, y: Floats, heading: Floats) -> Floats:
    """(N, 2) roll and pitch of the ground under the wheels, radians."""
    cx, cy = np.cos(heading) * _WHEELBASE / 2, np.sin(heading) * _WHEELBASE / 2
    site = scene.site
    rise_ahead = site.z(x + cx, y + cy) - site.z(x - cx, y - cy)
    rise_left = site.z(x - cy, y + cx) - site.z(x + cy, y - cx)
    return np.arctan2(np.column_stack([rise_left, -rise_ahead]), _WHEELBASE)


def _sway(rng: np.random.Generator, count: int) -> Floats:
    fresh = rng.normal(size=(count, 2)) * _SWAY * np.sqrt(1 - _SWAY_MEMORY**2)
    sway = np.zeros((count, 2))
    for k in range(1, count):
        sway[k] = _SWAY_MEMORY * sway[k - 1] + fresh[k]
    return sway
