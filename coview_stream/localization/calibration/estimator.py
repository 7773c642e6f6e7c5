"""Kalman filter for the calibration of a robot's sensor and odometry.

The state is x = (roll, pitch, s, w, g): tilt of the sensor against odometry's gravity, scale of odometry's distances
less one, turn of its heading per metre, and lean of the odometry frame against the map (2 components). These are the
systematic errors; :class:`coview_stream.localization.tracking.motion.Drift` holds the random ones. Every believed
registration to the map gives two measurements:

* Attitude against odometry's gravity. With u the vertical in the body's axes, by the map and by odometry, the residual
  tilt is u_map x u_odometry (eq. C1). The sensor's tilt turns with the body, the lean of the odometry frame does not;
  the pose graph follows the latter.
* Motion since the previous registration against odometry's. They differ by s times the distance along the path and by
  w times the distance in heading (eq. C2), apart from both registrations' errors and odometry's random walk.

A motion far outside this model (slipping wheels) counts less, by Student's t distribution. All components walk randomly
with the metres driven. While a place only leads a search, the state is a mixture of two Gaussians: the place is right
and its attitude has been measured, or the place is wrong.
"""

from __future__ import annotations

import math
from copy import deepcopy
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, exp_so3, inverse, log_so3, pose_from
from coview_stream.localization.calibration.calibration import Calibration


class _Prior(NamedTuple):
    """Prior of a group of components (values set by hand)."""

    axes: slice
    exact: float  # sigma of a correct sensor or odometry
    wide: float  # sigma of a faulty one
    share: float  # probability of a fault
    walk: float  # sigma of the random walk, per square root of a metre


_TILT = _Prior(slice(0, 2), math.radians(0.15), math.radians(4.0), 0.5, math.radians(0.03))
_SCALE = _Prior(slice(2, 3), 0.003, 0.04, 0.3, 5e-4)
_TURN = _Prior(slice(3, 4), math.radians(0.005), math.radians(0.05), 0.3, math.radians(5e-4))
GRAVITY = _Prior(slice(4, 6), math.radians(0.25), math.radians(0.25), 1.0, math.radians(0.1))
_GROUPS = (_TILT, _SCALE, _TURN)  # corrected components
_WIDE = np.concatenate([np.full(g.axes.stop - g.axes.start, g.wide) for g in (*_GROUPS, GRAVITY)])
SIZE = len(_WIDE)
"""Components of the state."""
_FREEDOM = 4.0  # degrees of freedom of Student's distribution


class CalibrationBelief:
    """Gaussian over the state x = (roll, pitch, s, w, g), with heavier tails where measurements contradict it.

    Most sensors stand straight and most odometry has the right scale. So a group is a mixture of a narrow prior about
    zero and a wide one; the applied value is the mean of both by their probabilities (Savage-Dickey ratio, eq. C3).

    Attributes:
        x: (6,) mean.
        P: (6, 6) covariance.
    """

    def __init__(self, sensor_leans: bool) -> None:
        self.x = np.zeros(SIZE)
        self.P = np.diag(_WIDE**2)
        self._sensor_leans = sensor_leans
        self._stand_straight()

    def learn(self, earlier: Calibration) -> None:
        """See :meth:`CalibrationEstimator.learn`."""
        present = self.applied()
        values = np.array([earlier.roll, earlier.pitch, earlier.scale, earlier.turn])
        sigmas = (earlier.sigma_tilt, earlier.sigma_scale, earlier.sigma_turn)
        limits = (present.sigma_tilt, present.sigma_scale, present.sigma_turn)
        for group, sigma, limit in zip(_GROUPS, sigmas, limits, strict=True):
            if sigma < limit:
                self.x[group.axes] = values[group.axes]
                self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0
                axes = np.arange(SIZE)[group.axes]
                self.P[axes, axes] = sigma**2
        self._stand_straight()

    def begin_odometry(self) -> None:
        """See :meth:`CalibrationEstimator.begin_odometry`."""
        self.x[GRAVITY.axes] = 0.0
        self.P[GRAVITY.axes], self.P[:, GRAVITY.axes] = 0.0, 0.0
        self.P[GRAVITY.axes, GRAVITY.axes] = np.eye(2) * GRAVITY.wide**2

    def walk(self, driven: float) -> None:
        """Widen all components by their random walks over ``driven`` metres."""
        for group in (*_GROUPS, GRAVITY):
            axes = np.arange(SIZE)[group.axes]
            self.P[axes, axes] = np.minimum(self.P[axes, axes] + group.walk**2 * driven, group.wide**2)
        self._stand_straight()

    def doubt_tilt(self, measured: Floats, H: Floats, R: Floats) -> None:
        """Widen the tilt's covariance where a measurement contradicts it by far."""
        gap, spread = measured - H @ self.x, H @ self.P @ H.T + R
        factor = heavier(float(gap @ np.linalg.solve(spread, gap)), len(gap))
        widest = _TILT.wide**2 / max(float(self.P[0, 0]), float(self.P[1, 1]), 1e-30)
        wider = math.sqrt(min(factor, max(widest, 1.0)))
        self.P[:2] *= wider
        self.P[:, :2] *= wider

    def update(self, measured: Floats, H: Floats, R: Floats) -> float:
        """Add a measurement ``measured`` = H x + noise of covariance R; return its prior log-likelihood."""
        gap = measured - H @ self.x
        distance = float(gap @ np.linalg.solve(H @ self.P @ H.T + R, gap))
        R = R * heavier(distance, len(gap))
        spread = H @ self.P @ H.T + R
        gain = np.linalg.solve(spread, H @ self.P).T
        self.x = self.x + gain @ gap
        rest = np.eye(SIZE) - gain @ H
        self.P = rest @ self.P @ rest.T + gain @ R @ gain.T
        return -0.5 * float(gap @ np.linalg.solve(spread, gap) + np.linalg.slogdet(spread)[1])

    def applied(self) -> Calibration:
        """Return the mean of the narrow and the wide prior, group by group (eq. C3)."""
        means, sigmas = np.zeros(4), []
        for group in _GROUPS:
            x, P = self.x[group.axes], self.P[group.axes, group.axes]
            size = len(x)
            spread = P + group.exact**2 * np.eye(size)
            exact = -0.5 * (x @ np.linalg.solve(spread, x) + np.linalg.slogdet(spread)[1]) + size * math.log(group.wide)
            weight = 1.0 / (1.0 + (1.0 - group.share) / group.share * math.exp(min(exact, 500.0)))
            means[group.axes] = weight * x
            variance = group.exact**2 * np.trace(P) / (np.trace(P) + size * group.exact**2)
            within = weight * np.trace(P) + (1.0 - weight) * variance
            sigmas.append(math.sqrt((within + weight * (1.0 - weight) * float(x @ x)) / size))
        return Calibration(*means.tolist(), *sigmas)

    def _stand_straight(self) -> None:
        """Fix the tilt at zero for a sensor that cannot lean: then odometry's gravity leans."""
        if not self._sensor_leans:
            self.x[:2] = 0.0
            self.P[:2], self.P[:, :2] = 0.0, 0.0


def mixed(one: Calibration, other: Calibration, share: float) -> Calibration:
    """Return the mixture of two calibrations, with the probability ``share`` of ``other``."""

    def mean(a: float, b: float) -> float:
        return (1.0 - share) * a + share * b

    def sigma(a: float, b: float, apart: float) -> float:
        return math.sqrt(mean(a**2, b**2) + share * (1.0 - share) * apart**2)

    apart = math.hypot(one.roll - other.roll, one.pitch - other.pitch) / math.sqrt(2.0)  # per angle
    return Calibration(
        mean(one.roll, other.roll),
        mean(one.pitch, other.pitch),
        mean(one.scale, other.scale),
        mean(one.turn, other.turn),
        sigma(one.sigma_tilt, other.sigma_tilt, apart),
        sigma(one.sigma_scale, other.sigma_scale, one.scale - other.scale),
        sigma(one.sigma_turn, other.sigma_turn, one.turn - other.turn),
    )


def heavier(distance: float, size: int) -> float:
    """Return Student's t factor on the variance of a measurement, from its squared Mahalanobis distance and size."""
    return max(1.0, (_FREEDOM + distance) / (_FREEDOM + size))


_ATTITUDE = math.radians(0.1)  # sigma of a registration's roll and pitch, added to its covariance
_LEAN = 3.0  # ratio of the roll and pitch errors of a frame-to-frame motion to its heading error
_MIN_STEP = 0.2  # metres; over less, the registrations' noise hides the motion's errors


class CalibrationEstimator:
    """Estimator of the calibration from registrations.

    Attributes:
        calibration: the applied calibration.
    """

    def __init__(self, sensor_leans: bool = True) -> None:
        """Begin with the priors; ``sensor_leans``: whether the sensor may lean against odometry's gravity."""
        self._known = CalibrationBelief(sensor_leans)
        self._supposed: CalibrationBelief | None = None  # belief if the place that leads a search is right
        self._probability = 0.0  # that the leading place is right
        self._apply()

    def learn(self, earlier: Calibration) -> None:
        """Take over the components of an earlier calibration that have a smaller sigma than the present ones."""
        self._supposed = None
        self._known.learn(earlier)
        self._apply()

    def forget_leader(self) -> None:
        """Forget the measurement at a place that led a search."""
        self._supposed = None
        self._apply()

    def begin_odometry(self) -> None:
        """Forget the lean of the odometry frame, as a new one begins; the robot's constants stay."""
        self._supposed = None
        self._known.begin_odometry()
        self._apply()

    def measure_attitude(self, T_map_cloud: Pose, T_odom_body: Pose, variance: float) -> None:
        """Add the attitude of a registration at the tracked place (eq. C1).

        ``T_map_cloud`` (4, 4) is of the cloud in the sensor's axes, the prior removed, ``T_odom_body`` (4, 4) of the
        same frame, ``variance`` of the registration's roll and pitch, rad^2.
        """
        self._supposed = None
        _measure_attitude(self._known, T_map_cloud, T_odom_body, variance)
        self._apply()

    def suppose_attitude(self, T_map_cloud: Pose, T_odom_body: Pose, variance: float, probability: float) -> None:
        """Add the attitude at a place that is right with a ``probability``, in place of the previous supposition.

        A search registers the same scans again, so suppositions do not add up. Args as :meth:`measure_attitude`.
        """
        self._supposed, self._probability = deepcopy(self._known), probability
        _measure_attitude(self._supposed, T_map_cloud, T_odom_body, variance)
        self._apply()

    def measure_motion(self, T_map_before: Pose, T_map_body: Pose, step: Pose, noise: Floats) -> Pose:
        """Add the motion between two registrations (eq. C2); return ``step`` corrected by the new calibration.

        Args:
            T_map_before: (4, 4) earlier pose, the prior removed.
            T_map_body: (4, 4) later pose, likewise.
            step: (4, 4) odometry between them, corrected by the calibration of its time.
            noise: (2,) variances along the path and of the heading, without the calibration's.
        """
        driven = float(np.linalg.norm(step[:3, 3]))
        if driven < _MIN_STEP:
            return step
        for belief in filter(None, (self._known, self._supposed)):
            belief.walk(driven)
        motion = inverse(T_map_before) @ T_map_body
        along = float((motion[:3, 3] - step[:3, 3]) @ step[:3, 3]) / driven
        turned = float(log_so3(motion[:3, :3] @ step[:3, :3].T)[2])
        before = self.calibration
        raw = driven / (1.0 + before.scale)
        for axis, gap, applied in ((2, along, before.scale), (3, turned, before.turn)):
            H = np.zeros((1, SIZE))
            H[0, axis] = raw
            self._update(np.array([gap + applied * raw]), H, np.array([[noise[axis - 2]]]))
        now = self.calibration
        turn = exp_so3(np.array([0.0, 0.0, (now.turn - before.turn) * raw]))
        return pose_from(turn @ step[:3, :3], (1.0 + now.scale) / (1.0 + before.scale) * step[:3, 3])

    def measure_frames(self, motion: Pose, step: Pose, variances: Floats, position: float, angle: float) -> Pose:
        """Add a motion between frames measured by the lidar alone (eq. C4); return ``step``, newly corrected.

        Args:
            motion: (4, 4) of the levelled body.
            step: (4, 4) odometry's motion, corrected by the calibration of its time.
            variances: (6,) of odometry's random walk over the step, (rx, ry, rz, x, y, z).
            position: sigma of ``motion``, metres.
            angle: sigma of ``motion``, radians.
        """
        t, before = step[:3, 3], self.calibration
        applied = log_so3(before.R_body_cloud)[:2]
        turned = log_so3(motion[:3, :3] @ step[:3, :3].T)
        # a tilted sensor sees a climb
        H = np.zeros((1, SIZE))
        H[0, :2] = -t[1], t[0]
        rise = np.array([motion[2, 3] - t[2] + H[0, :2] @ applied])
        self._update(rise, H, np.array([[variances[5] + position**2]]))
        H = np.zeros((2, SIZE))
        H[:, :2] = (motion[:3, :3] - np.eye(3))[:2, :2]  # the lidar's heading, which is better than odometry's
        self._update(turned[:2] + H[:, :2] @ applied, H, np.eye(2) * (variances[0] + (_LEAN * angle) ** 2))
        noise = np.array([variances[3] + position**2, variances[2] + angle**2])
        level = pose_from(self.calibration.R_body_cloud @ before.R_body_cloud.T, np.zeros(3))
        return self.measure_motion(np.eye(4), level @ motion @ inverse(level), step, noise)

    def _update(self, measured: Floats, H: Floats, R: Floats) -> None:
        """Add a measurement ``measured`` = H x + noise of covariance R to both beliefs."""
        likelihood = self._known.update(measured, H, R)
        if self._supposed is not None:
            ratio = self._supposed.update(measured, H, R) - likelihood
            right = self._probability * math.exp(min(ratio, 50.0))
            self._probability = right / (right + 1.0 - self._probability)
        self._apply()

    def _apply(self) -> None:
        self.calibration = self._known.applied()
        if self._supposed is not None:
            self.calibration = mixed(self.calibration, self._supposed.applied(), self._probability)


def _measure_attitude(belief: CalibrationBelief, T_map_cloud: Pose, T_odom_body: Pose, variance: float) -> None:
    R_body_cloud = belief.applied().R_body_cloud
    residual = np.cross((T_map_cloud[:3, :3] @ R_body_cloud.T)[2], T_odom_body[2, :3])
    residual[2] = 0.0
    measured = log_so3(exp_so3(residual) @ R_body_cloud)[:2]
    H = np.eye(2, SIZE)
    H[:, GRAVITY.axes] = T_odom_body[:2, :2].T  # the lean of odometry's frame turns with the body
    R = np.eye(2) * (variance + _ATTITUDE**2)
    belief.doubt_tilt(measured, H, R)
    belief.update(measured, H, R)


def tilt_variance(covariance: Floats) -> float:
    """Return the variance of roll or pitch, rad^2, of a covariance (6, 6) over (rx, ry, rz, x, y, z)."""
    return 0.5 * float(covariance[0, 0] + covariance[1, 1])
