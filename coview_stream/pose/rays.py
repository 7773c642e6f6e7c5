"""Free space: a lidar ray that passed through a map point says that the point is not there, or the pose is wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Points, Pose, inverse, lengths, transform

_FREE_RANGE = 35.0  # metres, beyond which a degree is wider than most objects
_FREE_EVERY = 3  # of the map's points: a share needs no more
_FREE_HEIGHT = 0.8  # metres above the ground below the robot: kerbs and slopes graze the rays
_BEAM = np.radians(2.0)  # cell of the range image
_COLUMNS = int(np.ceil(2 * np.pi / _BEAM)) + 1
_CELLS = _COLUMNS * (int(np.ceil(np.pi / _BEAM)) + 1)
_BEAM_HITS = 2
_MOST_RAYS = 32_768  # of a frame: a dense lidar has tens of them in each cell
_SLACK = 0.5  # metres, plus _SLACK_SLOPE per metre of range, before a ray counts as having passed
_SLACK_SLOPE = 0.03


@dataclass(frozen=True)
class RangeImage:
    """One frame by direction, in cells of 2 degrees; made once, compared with the map at any number of poses.

    Attributes:
        nearest: (C,) range of the nearest return in each cell, metres; infinite without one.
        farthest: (C,) of the farthest; zero without one.
        hits: (C,) returns.
        floor: height of the ground relative to the sensor, metres, not above it.
    """

    nearest: npt.NDArray[np.float32]
    farthest: npt.NDArray[np.float32]
    hits: npt.NDArray[np.int64]
    floor: float

    @classmethod
    def of(cls, cloud: Points) -> RangeImage:
        """Sort a frame (N, 3), body frame, metres, by direction; returns within a metre are the robot's own."""
        cloud = cloud[:: max(1, -(-len(cloud) // _MOST_RAYS))]
        ranges = lengths(cloud)
        usable = ranges > 1.0
        ranges = ranges[usable]
        cell = _beam_cells(cloud.compress(usable, axis=0), ranges)
        nearest = np.full(_CELLS, np.inf, dtype=np.float32)
        farthest = np.zeros(_CELLS, dtype=np.float32)
        np.minimum.at(nearest, cell, ranges)
        np.maximum.at(farthest, cell, ranges)
        return cls(nearest, farthest, np.bincount(cell, minlength=_CELLS), _floor_below(cloud))


def rays_against_map(seen: RangeImage, T_map_body: Pose, points: Points) -> tuple[int, int]:
    """How many map points the frame's rays met, and how many they passed through.

    A map point is passed through where every return in its 2-degree cell of the frame's range image lies clearly
    behind it; points behind the returns are hidden and do not count.

    Args:
        seen: the frame.
        T_map_body: (4, 4).
        points: (K, 3) map points, map frame.
    """
    position = T_map_body[:3, 3]
    points = points[::_FREE_EVERY]
    dx, dy = points[:, 0] - position[0], points[:, 1] - position[1]
    wanted = (dx * dx + dy * dy < _FREE_RANGE**2) & (points[:, 2] > position[2] + seen.floor + _FREE_HEIGHT)
    body = transform(inverse(T_map_body), points.compress(wanted, axis=0).astype(np.float64))
    distance = lengths(body)
    off = distance > 1.0
    body, distance = body.compress(off, axis=0), distance[off]
    cell = _beam_cells(body, distance)
    looked = seen.hits[cell] >= _BEAM_HITS
    slack = _SLACK + _SLACK_SLOPE * distance
    passed = looked & (distance < seen.nearest[cell] - slack)
    met = looked & ~passed & (distance <= seen.farthest[cell] + slack)
    return int(met.sum()), int(passed.sum())


def _beam_cells(points: npt.NDArray[np.floating], ranges: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
    azimuth = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / _BEAM).astype(np.int64)
    elevation = np.floor((np.arcsin(np.clip(points[:, 2] / ranges, -1, 1)) + np.pi / 2) / _BEAM).astype(
        np.int64
    )
    return np.asarray(elevation * _COLUMNS + azimuth)


def _floor_below(cloud: Points) -> float:
    """Height of the ground relative to the sensor: a low percentile of the points within 10 m, never above it."""
    near = cloud[:, 2][np.hypot(cloud[:, 0], cloud[:, 1]) < 10.0]
    return min(0.0, float(np.percentile(near, 5))) if len(near) >= 20 else 0.0
