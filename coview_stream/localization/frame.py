"""Frames as the localizer uses them: checked, levelled, and with their odometry corrected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import coview_kernels as kernels
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, to_local
from coview_stream.geometry.validation import validate_cloud, validate_odometry
from coview_stream.localization.calibration.frame_correction import FrameCorrection
from coview_stream.localization.calibration.frame_motion import Variances


@dataclass(frozen=True)
class Frame:
    """One frame, checked.

    Attributes:
        raw: (N, 3) float32, body frame, as it came.
        cloud: (N, 3) float32, body frame, levelled.
        T_odom_body: (4, 4) odometry about the anchor, corrected.
        T_odom_raw: (4, 4) odometry as it came.
        stamp: seconds.
        R_body_cloud: (3, 3) rotation that the cloud has been levelled by.
        voxels: (M, 3) float32, one point per voxel, odometry frame about the anchor.
    """

    raw: Points
    cloud: Points
    T_odom_body: Pose
    T_odom_raw: Pose
    stamp: float
    R_body_cloud: Floats
    voxels: Points


class FramePreparation:
    """Preparation of a robot's frames, by what has been learnt of its sensor and odometry.

    Attributes:
        correction: what has been learnt.
        anchor: (3,) origin of odometry in use, so that float32 stays exact; None before the first frame.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        """Begin with nothing known of the robot."""
        self.correction = FrameCorrection(config)
        self.anchor: Floats | None = None
        self._newest: float | None = None  # stamp of the newest frame
        self._voxel_filter = kernels.VoxelFilter(config.keyframe.voxel, config.keyframe.range_min)

    def restart(self) -> None:
        """Go on in another frame of odometry, with what is known of the robot."""
        self.correction.restart()
        self.anchor = self._newest = None

    def forget_odometry(self) -> None:
        """Connect the next frame with none before it: odometry may have jumped."""
        self.correction.forget_frame()
        self.anchor = None

    def prepare(self, cloud: Points, T_odom_body: Pose, stamp: float, drift: Variances | None = None) -> Frame:
        """Check and correct a frame.

        Args:
            cloud: (N, 3) as :meth:`coview_stream.localization.localizer.Localizer.step` takes it.
            T_odom_body: (4, 4) likewise.
            stamp: seconds.
            drift: of odometry; a keyframe's motion is then mended by its registration to the keyframe before, if one is
                due. None while a place is known, which tells the motion better.

        Raises:
            CloudError, RunError: the frame is unusable; nothing has changed.
        """
        raw, T_raw = validate_cloud(cloud), validate_odometry(T_odom_body, stamp, self._newest)
        self._newest = stamp
        T = self.correction.odometry(T_raw)
        if self.anchor is None:
            self.anchor = T[:3, 3].copy()
        T = to_local(T, self.anchor)
        if drift is not None and self.correction.is_due(T):
            T = self.correction.refine(self._voxels(raw, np.eye(4)), T, self.anchor, drift)
        return self._levelled(Frame(raw, raw, T, T_raw, stamp, np.eye(3), raw))

    def level_again(self, frame: Frame) -> Frame:
        """Return a frame, levelled by what is known now; the same if it stands straight."""
        return self._levelled(frame) if self.correction.leans(frame.R_body_cloud) else frame

    def _levelled(self, frame: Frame) -> Frame:
        cloud, R_body_cloud = self.correction.level(frame.raw), self.correction.calibration.R_body_cloud
        return replace(frame, cloud=cloud, R_body_cloud=R_body_cloud, voxels=self._voxels(cloud, frame.T_odom_body))

    def _voxels(self, cloud: Points, T: Pose) -> Points:
        return self._voxel_filter(cloud, T)[0].copy()  # the next frame overwrites the filter's array
