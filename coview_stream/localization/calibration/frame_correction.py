"""Correction of a robot's frames: clouds levelled, odometry mended, by a calibration that is learnt from them."""

from __future__ import annotations

import math

import numpy as np

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, pose_from
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator, tilt_variance
from coview_stream.localization.calibration.frame_motion import FrameMotion, Variances
from coview_stream.localization.calibration.odometry_correction import OdometryCorrection

_LEADER_TILT = math.radians(1.0)  # sigma of a leading place's roll and pitch, if it is the right one; set by hand
_ANY_TILT = math.radians(4.0)  # and if it is not
_GATHERED = math.radians(1.0)  # keyframes that lean by less stay as they are; set by hand
_LEVEL = math.radians(0.05)  # a frame that leans by less is not registered again for it; set by hand


class FrameCorrection:
    """What is learnt of a robot's sensor and odometry, applied to each of its frames.

    Attributes:
        estimator: learns from registrations while tracking.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        """Begin with nothing known."""
        self.estimator = CalibrationEstimator(config.sensor_leans)
        self._odometry = OdometryCorrection()
        self._motion = FrameMotion(config.registration, config.keyframe.distance)
        self._gathered = self.calibration  # by which the keyframes of the search have been levelled

    @property
    def calibration(self) -> Calibration:
        """What is applied now."""
        return self.estimator.calibration

    def odometry(self, T_odom_body: Pose) -> Pose:
        """Return the next pose (4, 4) of odometry as it is corrected."""
        return self._odometry.correct(T_odom_body, self.calibration)

    def level(self, cloud: Points) -> Points:
        """Return a cloud (N, 3), body frame, turned by what is known of the sensor's tilt."""
        R = self.calibration.R_body_cloud
        return cloud if np.array_equal(R, np.eye(3)) else cloud @ R.T.astype(np.float32)

    # ---- while no place is known

    def is_due(self, T_odom_body: Pose) -> bool:
        """Tell whether a frame at a corrected pose (4, 4) is to be compared with the one before (:meth:`refine`)."""
        return self._motion.is_due(T_odom_body)

    def refine(self, points: Points, T_odom_body: Pose, anchor: Floats, drift: Variances) -> Pose:
        """Compare a frame with the one before; return its odometry, mended.

        Args:
            points: (N, 3) body frame, one per voxel, as they came.
            T_odom_body: (4, 4) corrected odometry about ``anchor``.
            anchor: (3,).
            drift: of odometry.
        """
        T = self._motion.refine(points, T_odom_body, self.estimator, drift)
        self._odometry.move_to(pose_from(T[:3, :3], T[:3, 3] + anchor))
        return T

    def forget_frame(self) -> None:
        """Compare the next frame with none before it."""
        self._motion.clear()

    def level_gathered(self, anything: bool) -> Floats | None:
        """Return the rotation (3, 3), body axes, that keyframes gathered so far need, None if none, and count it done.

        ``anything`` says whether there are any.
        """
        before, now = self._gathered, self.calibration
        if anything and now.turned_since(before) <= _GATHERED:
            return None
        self._gathered = now
        return now.R_body_cloud @ before.R_body_cloud.T if anything else None

    def learn_leader(self, T_map_body: Pose, T_odom_body: Pose, probability: float) -> None:
        """Learn the tilt from a place that leads, (4, 4) as registered, as far as it is probable."""
        if probability > 0.0:
            variance = _LEADER_TILT**2 + (1.0 - probability) / probability * _ANY_TILT**2
            self.estimator.measure_attitude(T_map_body, T_odom_body, variance)

    def learn_found(self, T_map_body: Pose, covariance: Floats, T_odom_body: Pose) -> Pose | None:
        """Learn the tilt from the first registration at an accepted place.

        Args:
            T_map_body: (4, 4) as registered.
            covariance: (6, 6) of that.
            T_odom_body: (4, 4) corrected odometry of the same frame.

        Returns:
            The pose of the frame once it is levelled anew; None where that changes nothing.
        """
        before = self.calibration
        self.estimator.measure_attitude(T_map_body, T_odom_body, tilt_variance(covariance))
        now = self.calibration
        if now.turned_since(before) < _LEVEL:
            return None
        return pose_from(T_map_body[:3, :3] @ before.R_body_cloud @ now.R_body_cloud.T, T_map_body[:3, 3])
