"""Preparation of frames: validation, and correction of odometry by the calibration."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

import coview_kernels as kernels
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats, Reals
from coview_stream.geometry.transforms import Points, Pose, exp_so3, inverse, log_so3, pose_from, to_local
from coview_stream.geometry.validation import validate_cloud, validate_odometry
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.calibration.frame_motion import FrameMotion, Variances
from coview_stream.localization.calibration.odometry_history import Moment
from coview_stream.localization.witness.first_motions import Conventions

_FASTEST = 50.0  # metres per second; no robot drives faster
_FASTER = 3.0  # factor on the fastest of the earlier steps, as frames without stamps count as 0.1 s apart
_BEFORE = 10  # earlier steps, of which the fastest counts
_SHORT_JUMP = 1.0  # metres; a shorter step is never a jump
_PLACE_TILT = math.radians(0.5)  # sigma of roll and pitch of a frame registered at the right place


@dataclass(frozen=True)
class PreparedFrame:
    """One frame, checked and corrected."""

    cloud: Points  # (N, 3) float32 in the sensor's axes: as received, not levelled by the calibration
    T_odom_body: Pose  # (4, 4) corrected odometry at the moment of the cloud, about the anchor
    T_odom_raw: Pose  # (4, 4) raw odometry at the stamp
    stamp: float  # seconds
    scan: RawScan  # its points, one per voxel


class FramePreparation:
    """Preparation of a robot's frames, with the estimate of its calibration.

    Attributes:
        estimator: of the calibration; learns from registrations too.
        conventions: check of units and axes.
        steps: check of odometry for jumps.
        anchor: (3,) origin of the current odometry, near which float32 is exact; None before the first frame.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        self.estimator = CalibrationEstimator(config.sensor_leans, config.cloud_delay, config.mount_drawn)
        self.conventions = Conventions()
        self.steps = StepCheck()
        self.anchor: Floats | None = None
        self._odometry = OdometryCorrection()
        self._motion = FrameMotion(config.registration, config.keyframe.distance)
        self._newest: float | None = None  # stamp of the newest frame
        self._limits = config.keyframe.voxel, config.keyframe.range_min

    @property
    def calibration(self) -> Calibration:
        """The present calibration."""
        return self.estimator.calibration

    def restart(self) -> None:
        """Continue in another odometry frame, with the same calibration."""
        self.estimator.begin_odometry()
        self.conventions.clear()
        self._odometry = OdometryCorrection()
        self._motion.clear()
        self.steps = StepCheck()
        self.anchor = self._newest = None

    def forget_odometry(self) -> None:
        """Measure no motion to the next frame, and take its position as anchor, as odometry may have jumped."""
        self.forget_keyframe()
        self.anchor = None

    def begin_odometry(self) -> None:
        """Go on after a jump of odometry: no velocity or delay is measured across it."""
        self.estimator.begin_odometry()
        self.forget_odometry()

    def forget_keyframe(self) -> None:
        """Measure no motion from the newest keyframe to the next one."""
        self._motion.clear()

    def validate(self, cloud: Reals, T_odom_body: Pose, stamp: float) -> tuple[Points, Pose]:
        """Return a frame's finite points and its odometry, exactly rigid; the arguments as in ``Localizer.step``.

        Raises:
            CloudError, RunError: the frame is unusable; nothing has changed.
        """
        return validate_cloud(cloud), validate_odometry(T_odom_body, stamp, self._newest)

    def prepare(self, raw: Points, T_raw: Pose, stamp: float, drift: Variances | None = None) -> PreparedFrame:
        """Correct a frame whose points and odometry are valid.

        ``drift`` is odometry's, to correct the motion of a keyframe by registration to the previous keyframe. It is
        None while a place is known, as registrations to the map measure the motion better.
        """
        self.estimator.search_delay()
        delay = self.calibration.delay
        history = self.estimator.history
        before = history.at(self._newest - delay) if self._newest is not None and history else None
        history.add(stamp, T_raw)
        T = self._odometry.correct(history.at(stamp - delay), self.calibration, before)
        moment = Moment(stamp, history.rates(stamp - delay))
        self._newest = stamp
        if not self.conventions.plausible or self.conventions.finding is not None:
            self.conventions.add(self.calibration.level(raw), T_raw)
        if self.anchor is None:
            self.anchor = T[:3, 3].copy()
        T = to_local(T, self.anchor)
        if drift is not None and self._motion.is_due(T):
            T = self._motion.refine(self._voxels(raw, np.eye(4)), T, self.estimator, drift, moment)
            self._odometry.move_to(pose_from(T[:3, :3], T[:3, 3] + self.anchor))
        points = self._voxels(raw, T @ self.calibration.T_body_cloud)
        return PreparedFrame(raw, T, T_raw, stamp, RawScan(points, T, self.calibration, moment))

    def knows_moment(self, stamp: float) -> bool:
        """Return whether odometry reaches back to a cloud's moment if its delay is 2 sigma below the estimate."""
        late = self.calibration.delay - 2.0 * self.calibration.sigma_delay
        return late <= 0.0 or self.estimator.history.covers(stamp - late, stamp)

    def since_cloud(self, stamp: float) -> Pose:
        """Return the corrected motion (4, 4) of the body from the moment of a cloud, which may be late, to its stamp.

        Where odometry is the late one, the moment of the cloud is its stamp.
        """
        now = self.calibration
        return np.asarray(self.estimator.history.since_clouds(np.array([stamp]), now.delay, now.scale)[0])

    def learn_place(self, T_map_cloud: Pose, T_odom_body: Pose, probability: float | None = None) -> Pose:
        """Learn the tilt from a place of the search; return its ``T_map_odom`` (4, 4) with the new calibration.

        ``T_map_cloud`` (4, 4) is the registered pose of a keyframe's cloud in the sensor's axes, ``T_odom_body`` (4, 4)
        its corrected odometry, ``probability`` that of a place that leads the search; None for an accepted place.
        """
        if probability is None:
            self.estimator.measure_attitude(T_map_cloud, T_odom_body, _PLACE_TILT**2)
        else:
            self.estimator.suppose_attitude(T_map_cloud, T_odom_body, _PLACE_TILT**2, probability)
        return T_map_cloud @ inverse(T_odom_body @ self.calibration.T_body_cloud)

    def _voxels(self, cloud: Points, T: Pose) -> Points:
        return kernels.transform_unique(cloud, T, *self._limits)[0]


class StepCheck:
    """Check of odometry for jumps: steps that are longer than a robot drives. Turns on the spot are not checked."""

    def __init__(self) -> None:
        self._newest: tuple[Pose, float] | None = None  # odometry, stamp
        self._speeds: deque[float] = deque(maxlen=_BEFORE)  # metres per second
        self._since_jump = _BEFORE  # steps

    def add(self, T_odom_body: Pose, stamp: float) -> bool:
        """Add a frame's odometry (4, 4); return whether it has jumped.

        The first step is not a jump. After two jumps within ten steps such steps count as usual: frames lie far apart.
        """
        before, self._newest = self._newest, (T_odom_body, stamp)
        if before is None or stamp <= before[1]:
            return False
        step, seconds = float(np.linalg.norm(T_odom_body[:3, 3] - before[0][:3, 3])), stamp - before[1]
        limit = (_FASTEST + _FASTER * max(self._speeds, default=math.inf)) * seconds
        jumped = step > max(_SHORT_JUMP, limit)
        if not jumped or self._since_jump < _BEFORE:
            self._speeds.append(step / seconds)
        self._since_jump = 0 if jumped else self._since_jump + 1
        return jumped


class OdometryCorrection:
    """Incremental correction of odometry's scale and heading (about the vertical).

    A later calibration does not change steps that are already corrected.
    """

    def __init__(self) -> None:
        self._before: Pose | None = None  # raw
        self._position = np.zeros(3)
        self._turned = 0.0  # radians about the vertical, by all corrections

    def correct(self, T_odom_body: Pose, calibration: Calibration, before: Pose | None = None) -> Pose:
        """Return the next raw pose (4, 4), corrected; ``before`` is the previous one, if a new delay has changed it."""
        if self._before is not None and before is not None:
            self._before = before
        if self._before is None:
            self._position = T_odom_body[:3, 3].copy()
        else:
            step = T_odom_body[:3, 3] - self._before[:3, 3]
            turn = calibration.turn * float(np.linalg.norm(step))
            middle = exp_so3(np.array([0.0, 0.0, self._turned + 0.5 * turn]))
            self._position = self._position + (1.0 + calibration.scale) * (middle @ step)
            self._turned += turn
        self._before = T_odom_body
        return self._corrected(T_odom_body)

    def move_to(self, T_odom_body: Pose) -> Pose:
        """Replace the newest corrected pose by another one (4, 4); roll and pitch stay odometry's."""
        assert self._before is not None  # there is a newest pose
        now = self._corrected(self._before)
        self._turned += float(log_so3(T_odom_body[:3, :3] @ now[:3, :3].T)[2])
        self._position = T_odom_body[:3, 3].copy()
        return self._corrected(self._before)

    def _corrected(self, T_odom_body: Pose) -> Pose:
        return pose_from(exp_so3(np.array([0.0, 0.0, self._turned])) @ T_odom_body[:3, :3], self._position)
