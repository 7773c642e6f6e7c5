"""Ground plane of one lidar frame, whichever way its axes point: what tells a lean from an axis that is wrong.

Planes through three points at a time are scored by the points on them, less those behind them: behind the ground there
is nothing. NumPy only: the doctor runs where nothing else is installed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points

# set by hand; metres
_VOXEL = 0.4
_NEAR, _FAR = 1.0, 25.0  # of the sensor: nearer is the robot itself
_THICK = 0.12  # half the thickness of a plane
_BEHIND = 0.4  # farther behind a plane than grass and kerbs
_MOST = 2500  # points
_TRIALS = 400
_LEAST = 30  # points on a plane
_HIGHEST = 8.0  # of a sensor above its ground; 1.8 m in feet are 6
_CONE = 0.8  # cosine of the angle of a plane's normal with an axis
_PENALTY = 2.0  # of a point behind the plane, in points on it: a wall has a street behind it in part only


AXES = np.array([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
"""Axes of a frame that may point up; the first one should."""


@dataclass(frozen=True)
class GroundPlane:
    """Plane below a sensor.

    Attributes:
        up: (3,) unit normal in the frame's axes, from the plane to the sensor.
        height: of the frame's origin above it, metres.
        score: points on it less those behind it, as a share of all.
    """

    up: Floats
    height: float
    score: float


def ground_planes(points: Points, seed: int = 0) -> list[GroundPlane | None]:
    """Return the best plane below the sensor for each axis of :data:`AXES` that may point up, None where there is none.

    Args:
        points: (N, 3) in any right-angled axes, metres.
        seed: of the trials.
    """
    cloud = thinned(points, _VOXEL, _NEAR, _FAR)
    rng = np.random.default_rng(seed)
    if len(cloud) < _LEAST:
        return [None] * len(AXES)
    if len(cloud) > _MOST:
        cloud = cloud[rng.choice(len(cloud), _MOST, replace=False)]
    corners = cloud[rng.integers(0, len(cloud), (_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1.0  # square metres: a sliver says nothing
    normals, corners = normals[usable] / length[usable, None], corners[usable]
    heights = -np.einsum("ij,ij->i", normals, corners[:, 0])
    normals, heights = np.where(heights[:, None] < 0, -normals, normals), np.abs(heights)
    scores = np.where(heights < _HIGHEST, _score(cloud @ normals.T + heights), -np.inf)
    return [_best(cloud, normals, heights, np.where(normals @ axis > _CONE, scores, -np.inf)) for axis in AXES]


def _best(cloud: Floats, normals: Floats, heights: Floats, scores: Floats) -> GroundPlane | None:
    """Return the plane of the highest score, fitted to the points on it."""
    if not len(scores) or not np.isfinite(scores.max()):
        return None
    which = int(np.argmax(scores))
    up, height = normals[which], float(heights[which])
    for _ in range(3):
        on = np.abs(cloud @ up + height) < _THICK
        if on.sum() < _LEAST:
            return None
        middle = cloud[on].mean(axis=0)
        normal = np.linalg.eigh(np.cov((cloud[on] - middle).T))[1][:, 0]
        up = normal if normal @ middle < 0 else -normal
        height = float(-up @ middle)
    return GroundPlane(up, height, float(_score((cloud @ up + height)[:, None])[0]))


def _score(off: Floats) -> Floats:
    """Return the score (K,) of planes by the distances (N, K) of points from them, positive on the sensor's side."""
    on, behind = np.abs(off) < _THICK, off < -_BEHIND
    return np.asarray((on.sum(axis=0) - _PENALTY * behind.sum(axis=0)) / len(off))


def thinned(points: Points, voxel: float, near: float, far: float) -> Floats:
    """Return the first point (K, 3) of each cube of ``voxel`` metres, of those between ``near`` and ``far`` metres."""
    cloud = np.asarray(points, dtype=np.float64)
    distance = np.linalg.norm(cloud, axis=1)
    cloud = cloud[(distance > near) & (distance < far)]
    cells = np.floor(cloud / voxel).astype(np.int64)
    wide = int(2 * far / voxel) + 4
    cells += wide // 2
    _, first = np.unique((cells[:, 0] * wide + cells[:, 1]) * wide + cells[:, 2], return_index=True)
    return np.asarray(cloud[first])
