"""Motion while tracking: distance and drift of odometry, and the points of the newest frames.

A wheeled robot on asphalt drifts by half a per cent, one on gravel by five. So the rates are measured while tracking:
the motion between two registrations minus odometry's is its drift plus the noise of both registrations.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import exp

import numpy as np

from coview_stream.config import TrackingConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, boxminus, inverse, rotate_covariance, yaw_of
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator, motion_jacobian, tilt_variance
from coview_stream.localization.calibration.odometry_history import Moment
from coview_stream.localization.registration.register import propagate, swap_rotation_translation

MAX_FRAMES = 40
"""Frames whose points are kept."""
_OWN_NOISE = 0.4  # independent share of successive registrations' variances, measured once on simulated drives
_FLAT = [3, 4, 2]  # x, y and heading of (rx, ry, rz, x, y, z)
_GROUPS = ((0, 1), (2,), (3, 4), (5,))  # of (rx, ry, rz, x, y, z): tilt, yaw, position, height
_MIN_FACTOR = 0.3  # of the configured rates
_MAX_FACTOR = 20.0  # likewise; a scale error is not a random walk, but looks like a high rate
_MEMORY = 40.0  # metres over which measured drift is forgotten
_OUTLIER = 16.0  # variances; limit for larger slips, as rates should grow step by step
_MIN_STEP = 0.2  # metres; on shorter steps the registrations' noise hides the drift
_MIN_TURN = float(np.radians(5.0))  # likewise
_TREMBLE = float(np.radians(0.03))  # sigma of a frame's jitter in roll and pitch, before it is measured
_TREMBLE_COUNT, _MAX_COUNT = 5.0, 40.0  # weight of this value in registrations, and memory of the estimate
_MIN_DRIVEN = 1e-3  # metres: keeps the covariance positive definite when standing still


@dataclass(frozen=True)
class Drift:
    """Sigmas of the random walk of odometry's errors: metres and radians per square root of a metre driven."""

    position: float  # each of x and y
    height: float
    tilt: float  # each of roll and pitch
    yaw: float
    turn: float  # radians of yaw per radian turned

    @classmethod
    def of(cls, config: TrackingConfig) -> Drift:
        """Return the configured rates."""
        return cls(config.position_drift, config.height_drift, config.tilt_drift, config.yaw_drift, config.turn_drift)

    def variances(self, driven: float, turned: float) -> Floats:
        """Variances (6,) over (rx, ry, rz, x, y, z) after metres driven and radians turned."""
        rates = np.array([self.tilt, self.tilt, self.yaw, self.position, self.position, self.height])
        gathered: Floats = rates**2 * max(driven, _MIN_DRIVEN)
        gathered[2] += (self.turn * turned) ** 2
        return gathered

    def covariance(self, driven: float, turned: float) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) of the body's motion; positive definite even standing still."""
        return np.diag(self.variances(driven, turned))

    def reported(self, driven: float, turned: float) -> Floats:
        """Return the same covariance over (x, y, z, roll, pitch, yaw)."""
        return swap_rotation_translation(self.covariance(driven, turned))


class DriftEstimator:
    """Estimator of the drift's rates: a prior at the configured ones, and measurements that fade by the metre."""

    def __init__(self, config: TrackingConfig) -> None:
        self._nominal = Drift.of(config)
        self._metres = np.full(len(_GROUPS), config.drift_prior)
        self._sums = self._metres.copy()
        self._tilt, self._count = _TREMBLE**2, _TREMBLE_COUNT

    @property
    def drift(self) -> Drift:
        """The present estimate of the rates."""
        factors = np.sqrt(np.clip(self._sums / self._metres, _MIN_FACTOR**2, _MAX_FACTOR**2))
        tilt, yaw, position, height = factors.tolist()
        base = self._nominal
        return Drift(position * base.position, height * base.height, tilt * base.tilt, yaw * base.yaw, yaw * base.turn)

    @property
    def tremble(self) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z), map axes, of a frame's tilt relative to neighbouring frames.

        Roll and pitch of odometry jitter from frame to frame, and so do those of registrations. Each is assigned half
        of the mean square of their disagreement between successive registrations.
        """
        return np.diag([self._tilt, self._tilt, 0.0, 0.0, 0.0, 0.0])

    def add(self, gap: Floats, noise: Floats, driven: float, turned: float) -> None:
        """Add the motion between two registrations, where it is :func:`worth_learning`.

        ``gap`` (6,) over (rx, ry, rz, x, y, z) is the later pose minus odometry's prediction from the earlier one,
        ``noise`` (6,) the sum of the independent variances of the two registrations, with metres ``driven`` and radians
        ``turned`` between.
        """
        nominal = self._nominal.variances(driven, turned)
        now = self.drift.variances(driven, turned)
        # squares less than their noise become negative and stay so: otherwise their mean would be biased
        squares = np.minimum(gap**2, _OUTLIER * (now + noise))
        self._count = min(self._count + 1.0, _MAX_COUNT)
        self._tilt += (float(squares[:2].mean()) / 2.0 - self._tilt) / self._count
        squares -= noise
        for group, axes in enumerate(_GROUPS):
            rows = list(axes)
            if driven < _MIN_STEP and rows != [2]:
                continue  # turning on the spot informs only the heading
            # for the heading, a turn on the spot counts as metres of driving
            metres = float(nominal[rows[0]] / self._nominal.variances(1.0, 0.0)[rows[0]])
            # a registration with a large variance in a direction hardly informs its drift
            weight = metres * float((now[rows] / (now[rows] + noise[rows])).mean()) ** 2
            fade = exp(-weight / _MEMORY)
            ratio = float((squares[rows] / nominal[rows]).mean())
            self._sums[group] = fade * self._sums[group] + weight * ratio
            self._metres[group] = fade * self._metres[group] + weight


def worth_learning(driven: float, turned: float) -> bool:
    """Return whether a motion by these metres and radians is long enough to measure drift."""
    return driven >= _MIN_STEP or turned >= _MIN_TURN


@dataclass(frozen=True)
class _Mark:
    """Odometry at one moment: pose (4, 4), metres driven and radians turned so far, and the frame's moment."""

    T_odom_body: Pose
    travelled: float
    turned: float
    moment: Moment | None = None


@dataclass(frozen=True)
class _Registered:
    """A verified registration, as in :meth:`OdometryTracker.learn`, with the odometry at it."""

    T_map_cloud: Pose
    covariance: Floats
    mark: _Mark


class OdometryTracker:
    """Distance and rotation of odometry, in total and since the newest keyframe, and its measured drift.

    Attributes:
        travelled: metres driven.
        pose: (4, 4) the newest; None before the first, and where odometry may have jumped.
    """

    def __init__(self, config: TrackingConfig, calibration: CalibrationEstimator) -> None:
        """Start with the configured rates; ``calibration`` learns the systematic part."""
        self.travelled = 0.0
        self.pose: Pose | None = None
        self._moment: Moment | None = None
        self._calibration = calibration
        self._turned = 0.0
        self._keyframe = _Mark(np.eye(4), 0.0, 0.0)
        self._estimator = DriftEstimator(config)
        self._registered: _Registered | None = None
        self._unconfirmed: _Registered | None = None  # the registration that odometry contradicts

    def add_pose(self, T_odom_body: Pose, moment: Moment | None = None) -> None:
        """Add the pose (4, 4) of a frame, and its moment if known."""
        self._moment = moment
        if self.pose is not None:
            self.travelled += float(np.linalg.norm(T_odom_body[:3, 3] - self.pose[:3, 3]))
            # about the vertical only, as a shaking robot does not turn
            self._turned += abs(yaw_of(inverse(self.pose) @ T_odom_body))
        self.pose = T_odom_body

    def forget_pose(self) -> None:
        """Count nothing up to the next pose, as odometry may have jumped."""
        self.pose = None

    def set_keyframe(self, T_odom_body: Pose) -> None:
        """Take the newest frame as a keyframe."""
        self._keyframe = _Mark(T_odom_body, self.travelled, self._turned, self._moment)

    def since_keyframe(self) -> tuple[float, float]:
        """Return metres driven and radians turned since the newest keyframe."""
        return self.travelled - self._keyframe.travelled, self._turned - self._keyframe.turned

    def motion(self, T_odom_body: Pose) -> Pose:
        """Return the motion (4, 4) of the body since the newest keyframe."""
        return inverse(self._keyframe.T_odom_body) @ T_odom_body

    def change(self) -> Floats:
        """Return the derivative (3,) of the motion (x, y, yaw) since the newest keyframe by the clouds' delay."""
        motion = np.eye(4) if self.pose is None else self.motion(self.pose)
        return np.asarray(motion_jacobian(motion, np.array([_rates(self._keyframe.moment), self.rates]))[:, 2])

    @property
    def rates(self) -> Floats:
        """(3,) rates of the newest frame, as in a Moment; zero where unknown."""
        return _rates(self._moment)

    @property
    def drift(self) -> Drift:
        """Rates of odometry's drift, as measured so far."""
        return self._estimator.drift

    @property
    def tremble(self) -> Floats:
        """Covariance (6, 6) of a frame's tilt relative to neighbouring frames; see :attr:`DriftEstimator.tremble`."""
        return self._estimator.tremble

    def learn(self, T_map_cloud: Pose, covariance: Floats, slips: bool = False) -> None:
        """Learn calibration and drift from a verified registration at the newest keyframe.

        ``T_map_cloud`` (4, 4) and its covariance (6, 6) are of the cloud in the sensor's axes, without the prior.
        ``slips`` as in :meth:`Tracker.update`.
        """
        self._learn_unconfirmed()
        if slips:
            self._registered = None
        self._learn(_Registered(T_map_cloud, covariance, self._keyframe))

    def learn_once_confirmed(self, T_map_cloud: Pose, covariance: Floats) -> None:
        """Learn from a registration that contradicts odometry once the next one follows; args as in :meth:`learn`."""
        self._learn_unconfirmed()
        self._unconfirmed = _Registered(T_map_cloud, covariance, self._keyframe)

    def forget_registration(self) -> None:
        """Forget the last registration; the rates stay."""
        self._registered = self._unconfirmed = None

    def _learn_unconfirmed(self) -> None:
        if self._unconfirmed is not None:
            self._learn(self._unconfirmed, contradicts=True)
        self._unconfirmed = None

    def _learn(self, now: _Registered, contradicts: bool = False) -> None:
        """Learn from a registration; ``contradicts`` if it contradicts odometry, which drifts or slips."""
        before = self._registered
        if before is not None:
            driven, turned = now.mark.travelled - before.mark.travelled, now.mark.turned - before.mark.turned
            if not worth_learning(driven, turned):
                return
            step = inverse(before.mark.T_odom_body) @ now.mark.T_odom_body
            noise = _OWN_NOISE * np.diag(now.covariance + before.covariance)
            level = inverse(self._calibration.calibration.T_body_cloud)
            T_before, T_now = before.T_map_cloud @ level, now.T_map_cloud @ level
            R = T_before[:3, :3].T
            moved = T_now[:3, 3] - T_before[:3, 3]
            errors = rotate_covariance(now.covariance + propagate(before.covariance, moved), R)
            spread = _OWN_NOISE * errors[np.ix_(_FLAT, _FLAT)] + np.diag(self.drift.variances(driven, turned)[_FLAT])
            moments = before.mark.moment, now.mark.moment
            step = self._calibration.measure_motion(T_before, T_now, step, spread, moments, contradicts)
            level = inverse(self._calibration.calibration.T_body_cloud)
            T_before, T_now = before.T_map_cloud @ level, now.T_map_cloud @ level
            self._estimator.add(boxminus(T_now, T_before @ step), noise, driven, turned)
        self._calibration.measure_attitude(now.T_map_cloud, now.mark.T_odom_body, tilt_variance(now.covariance))
        self._registered = now


def _rates(moment: Moment | None) -> Floats:
    return np.zeros(3) if moment is None else np.nan_to_num(moment.rates)


class ScanBuffer:
    """Buffer of the newest 40 scans, levelled by the calibration on access."""

    def __init__(self, config: TrackingConfig, calibration: CalibrationEstimator) -> None:
        self._config = config
        self._calibration = calibration
        self._frames: deque[tuple[float, RawScan]] = deque(maxlen=MAX_FRAMES)  # metres driven, scan

    def add(self, scan: RawScan, travelled: float) -> None:
        """Add a frame at ``travelled`` metres."""
        self._frames.append((travelled, scan))

    def keep_newest(self, count: int) -> None:
        """Forget all but the newest ``count`` frames."""
        while len(self._frames) > count:
            self._frames.popleft()

    @property
    def newest(self) -> Points | None:
        """(N, 3) points of the newest frame, odometry frame."""
        return self._frames[-1][1].levelled(self._calibration.calibration) if self._frames else None

    def window(self) -> Points:
        """Points (N, 3) of the newest frames, as many as :class:`coview_stream.config.TrackingConfig` allows."""
        parts: list[Points] = []
        count = 0
        for travelled, scan in reversed(self._frames):
            old = self._frames[-1][0] - travelled > self._config.window
            if count >= self._config.max_points or (old and count >= self._config.min_points):
                break
            parts.append(scan.levelled(self._calibration.calibration))
            count += len(parts[-1])
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.float32)
