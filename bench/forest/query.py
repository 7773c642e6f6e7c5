"""A drive becomes a query as in the product: what the ring buffer would hold, in the odometry's frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from bench.forest.worlds import Drive, in_odometry
from coview_stream.config import LocalizerConfig
from coview_stream.geometry import Points, Pose, inverse
from coview_stream.place.keyframes import thinned
from coview_stream.query import Query

_SUBMAP = 8.0  # metres driven that are registered: four keyframes, as in coview_stream.query


def query_of(drive: Drive, config: LocalizerConfig) -> tuple[Query, Pose]:
    """Return the query of the newest frame, and the true pose (4, 4) map <- odometry, of the map's source.

    The odometry's origin is put where the robot is now.
    """
    told, truth = in_odometry(drive)
    keyframe = config.keyframe
    parts = [
        thinned(cloud, T, keyframe) if len(cloud) else np.empty((0, 3), dtype=np.float32)
        for cloud, T in zip(drive.clouds, told, strict=True)
    ]
    steps = np.linalg.norm(np.diff(told[:, :3, 3], axis=0), axis=1)
    left = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])  # metres still to drive from each frame on
    recent = [part for part, metres in zip(parts, left, strict=True) if metres < _SUBMAP]
    around = _once(parts, keyframe.voxel)
    around = around[np.hypot(around[:, 0], around[:, 1]) < config.learned.reach]
    query = Query(
        stamp=0.0,
        T_odom_body=told[-1],
        scan=around,
        submap=_once(recent, keyframe.voxel),
        cloud=drive.clouds[-1],
        travelled=drive.travelled,
        surroundings=around,
    )
    return query, truth


def local(truth: Pose, origin: npt.NDArray[np.float64]) -> Pose:
    """Return a pose (4, 4) of the map's source relative to the map's ``origin`` (3,)."""
    moved: Pose = truth.copy()
    moved[:3, 3] -= origin
    return moved


def errors(T: Pose, truth: Pose, query: Query) -> tuple[float, float, float, float]:
    """How far a ``T_map_odom`` puts the robot off: metres in the plane, degrees of heading, metres, degrees."""
    apart = T @ query.T_odom_body @ inverse(truth @ query.T_odom_body)
    shift = (T @ query.T_odom_body)[:3, 3] - (truth @ query.T_odom_body)[:3, 3]
    heading = abs(float(np.degrees(np.arctan2(apart[1, 0], apart[0, 0]))))
    cosine = np.clip(0.5 * (np.trace(apart[:3, :3]) - 1.0), -1.0, 1.0)
    return (
        float(np.hypot(shift[0], shift[1])), heading, float(np.linalg.norm(shift)),
        float(np.degrees(np.arccos(cosine))),
    )  # fmt: skip


def _once(parts: list[Points], voxel: float) -> Points:
    points: Points = kernels.transform_unique(np.concatenate(parts), np.eye(4), voxel)[0]
    return points
