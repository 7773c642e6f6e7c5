"""Correction of a robot's frames: clouds levelled, odometry mended, by a calibration that is learnt from them."""

from __future__ import annotations

import math

import numpy as np

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, pose_from, rotation_angle
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator, tilt_variance
from coview_stream.localization.calibration.frame_motion import FrameMotion, Variances
from coview_stream.localization.calibration.odometry_correction import OdometryCorrection

_LEADER_TILT = math.radians(1.0)  # sigma of a leading place's roll and pitch, if it is the right one; set by hand
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

    def leans(self, R_body_cloud: Floats) -> bool:
        """Tell whether a frame that has been levelled by a rotation (3, 3) leans enough to be registered again."""
        return rotation_angle(self.calibration.R_body_cloud.T @ R_body_cloud) >= _LEVEL

    def restart(self) -> None:
        """Go on in another frame of odometry, with what is known of the robot."""
        self.estimator.begin_odometry()
        self._odometry = OdometryCorrection()
        self._motion.clear()

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

    def learn_leader(self, T_map_body: Pose, T_odom_body: Pose, probability: float, R_body_cloud: Floats) -> Pose:
        """Learn the tilt from a place that leads, as far as it is probable; return its pose (4, 4), levelled anew.

        Args:
            T_map_body: (4, 4) of a keyframe, as registered.
            T_odom_body: (4, 4) corrected odometry of the same keyframe.
            probability: that it is the right place.
            R_body_cloud: (3, 3) rotation that its clouds had been levelled by.
        """
        self.estimator.suppose_attitude(T_map_body, T_odom_body, _LEADER_TILT**2, R_body_cloud, probability)
        return self._levelled(T_map_body, R_body_cloud)

    def learn_found(self, T_map_body: Pose, covariance: Floats, T_odom_body: Pose, R_body_cloud: Floats) -> Pose:
        """Learn the tilt from the first registration at an accepted place; return its pose (4, 4), levelled anew.

        Args:
            T_map_body: (4, 4) as registered.
            covariance: (6, 6) of that.
            T_odom_body: (4, 4) corrected odometry of the same frame.
            R_body_cloud: (3, 3) rotation that its cloud had been levelled by.
        """
        self.estimator.measure_attitude(T_map_body, T_odom_body, tilt_variance(covariance), R_body_cloud)
        return self._levelled(T_map_body, R_body_cloud)

    def _levelled(self, T_map_body: Pose, R_body_cloud: Floats) -> Pose:
        return pose_from(T_map_body[:3, :3] @ R_body_cloud @ self.calibration.R_body_cloud.T, T_map_body[:3, 3])
