"""Keyframes and the virtual local scans made of them: a ring buffer of fixed size (paper, section 3.3)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.config import KeyframeConfig
from coview_stream.geometry import Points, Pose

_PENDING_POINTS = 200_000  # re-voxelise the frames of a robot that stands still beyond this many points


@dataclass(frozen=True)
class Keyframe:
    """All frames since the previous keyframe, one point per voxel.

    Attributes:
        stamp: seconds, of the newest frame.
        T_odom_body: (4, 4) of the newest frame.
        points: (N, 3) float32 odometry-frame coordinates, metres.
    """

    stamp: float
    T_odom_body: Pose
    points: Points

    @property
    def position(self) -> npt.NDArray[np.float64]:
        """(3,) sensor position in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])


def thinned(cloud: Points, T_odom_body: Pose, config: KeyframeConfig) -> Points:
    """Points (K, 3) of a frame (N, 3) in the odometry frame, one per voxel, without those near the sensor."""
    return kernels.transform_unique(cloud, T_odom_body, config.voxel, config.range_min)[0]


class KeyframeBuffer:
    """Turns frames into keyframes and keeps the newest ``capacity`` of them.

    All coordinates are in the odometry frame, which must be gravity aligned and near its own origin.

    Attributes:
        keyframes: the newest ones, oldest first.
        newest: (N, 3) float32 points of the newest frame, one per voxel.
        travelled: metres between keyframes.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self.config = config
        self.keyframes: deque[Keyframe] = deque(maxlen=config.capacity)
        self.travelled = 0.0
        self.newest: Points = np.empty((0, 3), dtype=np.float32)
        self._pending: list[Points] = []
        self._filter = kernels.VoxelFilter(config.voxel, config.range_min)

    def thin(self, cloud: Points, T_odom_body: Pose) -> Points:
        """Thin one frame (N, 3) in the body frame to :attr:`newest`, for who needs no keyframes."""
        self.newest = self._filter(cloud, T_odom_body)[0].copy()  # which the next frame overwrites
        return self.newest

    def add(self, cloud: Points, T_odom_body: Pose, stamp: float) -> Keyframe | None:
        """Take in one frame (N, 3) in the body frame; return the keyframe it completes, if it does."""
        self.thin(cloud, T_odom_body)
        self._pending.append(self.newest)
        if sum(map(len, self._pending)) > _PENDING_POINTS:
            self._pending = [self._unique(np.concatenate(self._pending))]
        if self.keyframes:
            moved = float(np.linalg.norm(T_odom_body[:3, 3] - self.keyframes[-1].position))
            if moved < self.config.distance:
                return None
            self.travelled += moved
        keyframe = Keyframe(stamp, T_odom_body, self._unique(np.concatenate(self._pending)))
        self.keyframes.append(keyframe)
        self._pending = []
        return keyframe

    def recent(self, count: int) -> Points:
        """Points (N, 3) of the newest ``count`` keyframes and of the frames since."""
        parts = [k.points for k in list(self.keyframes)[-count:]] + self._pending
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.float32)

    def virtual_scan(self, centre: npt.NDArray[np.float64], radius: float, voxel: float) -> Points:
        """Virtual local scan: everything so far within ``radius`` metres of ``centre``, one point per voxel."""
        points = np.concatenate([k.points for k in self.keyframes])
        near = np.hypot(points[:, 0] - centre[0], points[:, 1] - centre[1]) < radius
        return self._unique(points[near], voxel)

    def clear(self) -> None:
        """Forget all keyframes: their odometry no longer fits the next frame's."""
        self.keyframes.clear()
        self._pending = []

    def _unique(self, points: Points, voxel: float | None = None) -> Points:
        return kernels.transform_unique(points, np.eye(4), voxel or self.config.voxel)[0]
