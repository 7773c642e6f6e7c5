"""Estimation of the calibration: a Kalman filter over a robot's constants, or nearly so.

The state is x = (roll, pitch, s, w, g): the tilt of the sensor against odometry's gravity, the scale of odometry's
distances less one, the turn of its heading per metre, and how odometry's frame leans against the map (2): the errors
of the pose graph but for those that are independent from step to step
(:class:`coview_stream.localization.tracking.motion.Drift`). Each registration to the map that is
believed measures two things:

* its attitude against odometry's gravity. With u the vertical in the body's axes, by the map and by odometry, the tilt
  that is left is u_map x u_odometry (eq. C1). The sensor's turns with the body, that of odometry's frame does not; the
  latter is left to the pose graph, which follows it;
* the motion since the registration before against odometry's. Along the way they differ by s times the distance, in
  heading by w times the distance (eq. C2), but for both registrations' errors and odometry's random walk.

A motion far outside what all this allows (wheels slip) counts less, as under Student's t distribution. Nothing is for
ever: each component walks at random, slowly, with the metres driven.

While a place only leads a search, the state is a mixture of two such Gaussians: that it is the right place, whose
attitude has been measured, and that it is not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, exp_so3, inverse, log_so3, pose_from
from coview_stream.localization.calibration.calibration import Calibration


class _Prior(NamedTuple):
    """Prior of a group of components; all set by hand.

    Attributes:
        axes: of the state.
        exact: sigma of one that is as it should be.
        wide: sigma of one that is not.
        share: probability that it is not.
        walk: sigma of its random walk, per square root of a metre.
    """

    axes: slice
    exact: float
    wide: float
    share: float
    walk: float


_TILT = _Prior(slice(0, 2), math.radians(0.15), math.radians(4.0), 0.5, math.radians(0.03))
_SCALE = _Prior(slice(2, 3), 0.003, 0.04, 0.3, 5e-4)
_TURN = _Prior(slice(3, 4), math.radians(0.005), math.radians(0.05), 0.3, math.radians(5e-4))
GRAVITY = _Prior(slice(4, 6), math.radians(0.25), math.radians(0.25), 1.0, math.radians(0.1))
_GROUPS = (_TILT, _SCALE, _TURN)  # that are corrected
_WIDE = np.concatenate([np.full(g.axes.stop - g.axes.start, g.wide) for g in (*_GROUPS, GRAVITY)])
SIZE = len(_WIDE)
"""Components of the state."""
_FREEDOM = 4.0  # degrees of freedom of Student's distribution


class CalibrationBelief:
    """Gaussian over the state x = (roll, pitch, s, w, g), heavy-tailed where measurements contradict it.

    Most sensors stand straight and most odometry has the right scale. So each group of the state is a mixture: zero but
    for a small spread, or anything up to a large one; the mean of both is applied, weighed by their probabilities
    (Savage and Dickey's ratio, eq. C3).

    Attributes:
        x: (6,) mean.
        P: (6, 6) covariance.
    """

    def __init__(self, sensor_leans: bool = True) -> None:
        """Begin with nothing known; ``sensor_leans``: whether the sensor may lean against odometry's gravity."""
        self.x = np.zeros(SIZE)
        self.P = np.diag(_WIDE**2)
        self._sensor_leans = sensor_leans
        self._stand_straight()

    def copy(self) -> CalibrationBelief:
        """Return the same belief, to be changed on its own."""
        other = CalibrationBelief(self._sensor_leans)
        other.x, other.P = self.x.copy(), self.P.copy()
        return other

    def restore(self, known: Calibration) -> None:
        """Begin with an earlier calibration."""
        self.x = np.array([known.roll, known.pitch, known.scale, known.turn, 0.0, 0.0])
        self.P = np.diag(_WIDE**2)
        sigmas = [known.sigma_tilt, known.sigma_tilt, known.sigma_scale, known.sigma_turn]
        self.P[:4, :4] = np.diag(np.square(sigmas))
        self._stand_straight()

    def learn(self, known: Calibration) -> None:
        """Take over an earlier calibration as far as it is better known than the present one."""
        own = self.applied()
        values = np.array([known.roll, known.pitch, known.scale, known.turn])
        sigmas = (known.sigma_tilt, known.sigma_scale, known.sigma_turn)
        for group, sigma, here in zip(_GROUPS, sigmas, (own.sigma_tilt, own.sigma_scale, own.sigma_turn), strict=True):
            if sigma < here:
                self.x[group.axes] = values[group.axes]
                self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0
                axes = np.arange(SIZE)[group.axes]
                self.P[axes, axes] = sigma**2
        self._stand_straight()

    def begin_odometry(self) -> None:
        """Forget how odometry's frame leans, for another one begins; the robot's constants stay."""
        self.x[GRAVITY.axes] = 0.0
        self.P[GRAVITY.axes], self.P[:, GRAVITY.axes] = 0.0, 0.0
        self.P[GRAVITY.axes, GRAVITY.axes] = np.eye(2) * GRAVITY.wide**2

    def walk(self, driven: float) -> None:
        """Let everything have changed a little over ``driven`` metres."""
        for group in (*_GROUPS, GRAVITY):
            axes = np.arange(SIZE)[group.axes]
            self.P[axes, axes] = np.minimum(self.P[axes, axes] + group.walk**2 * driven, group.wide**2)
        self._stand_straight()

    def doubt_tilt(self, seen: Floats, H: Floats, R: Floats) -> None:
        """Widen a tilt that a measurement contradicts by far: it is as probably right as the measurements before."""
        gap, spread = seen - H @ self.x, H @ self.P @ H.T + R
        factor = heavier(float(gap @ np.linalg.solve(spread, gap)), len(gap))
        widest = _TILT.wide**2 / max(float(self.P[0, 0]), float(self.P[1, 1]), 1e-30)
        wider = math.sqrt(min(factor, max(widest, 1.0)))
        self.P[:2] *= wider
        self.P[:, :2] *= wider

    def update(self, seen: Floats, H: Floats, R: Floats) -> float:
        """Take in a measurement ``seen`` = H x + noise of covariance R; return its log-likelihood before."""
        gap = seen - H @ self.x
        distance = float(gap @ np.linalg.solve(H @ self.P @ H.T + R, gap))
        R = R * heavier(distance, len(gap))
        spread = H @ self.P @ H.T + R
        gain = np.linalg.solve(spread, H @ self.P).T
        self.x = self.x + gain @ gap
        rest = np.eye(SIZE) - gain @ H
        self.P = rest @ self.P @ rest.T + gain @ R @ gain.T
        return -0.5 * float(gap @ np.linalg.solve(spread, gap) + np.linalg.slogdet(spread)[1])

    def applied(self) -> Calibration:
        """Weigh, group by group, "as it should be" against "anything" (eq. C3)."""
        means, sigmas = np.zeros(4), []
        for group in _GROUPS:
            x, P = self.x[group.axes], self.P[group.axes, group.axes]
            size = len(x)
            spread = P + group.exact**2 * np.eye(size)
            exact = -0.5 * (x @ np.linalg.solve(spread, x) + np.linalg.slogdet(spread)[1]) + size * math.log(group.wide)
            weight = 1.0 / (1.0 + (1.0 - group.share) / group.share * math.exp(min(exact, 500.0)))
            means[group.axes] = weight * x
            about = group.exact**2 * np.trace(P) / (np.trace(P) + size * group.exact**2)
            within = weight * np.trace(P) + (1.0 - weight) * about
            sigmas.append(math.sqrt((within + weight * (1.0 - weight) * float(x @ x)) / size))
        return Calibration(*means.tolist(), *sigmas)

    def _stand_straight(self) -> None:
        """Know for sure that the sensor does not lean, if it cannot: then odometry's gravity leans."""
        if not self._sensor_leans:
            self.x[:2] = 0.0
            self.P[:2], self.P[:, :2] = 0.0, 0.0


def mixed(one: Calibration, other: Calibration, share: float) -> Calibration:
    """Return the mean of two calibrations, ``share`` of it the other's, with the sigmas of the mixture."""

    def mean(a: float, b: float) -> float:
        return (1.0 - share) * a + share * b

    def sigma(a: float, b: float, apart: float) -> float:
        return math.sqrt(mean(a**2, b**2) + share * (1.0 - share) * apart**2)

    apart = math.hypot(one.roll - other.roll, one.pitch - other.pitch) / math.sqrt(2.0)  # of each of the two
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
    """Return the factor on a variance under Student's t distribution.

    Args:
        distance: squared Mahalanobis distance of the measurement.
        size: its number of components.
    """
    return max(1.0, (_FREEDOM + distance) / (_FREEDOM + size))


_ATTITUDE = math.radians(0.1)  # sigma of a registration's roll and pitch beside its own
_LEAN = 3.0  # times its heading's error that a motion from frame to frame is off in roll and pitch
_MIN_STEP = 0.2  # metres; over less, the registrations' noise hides all else


class CalibrationEstimator:
    """Estimate of the calibration, and the correction of clouds and odometry by it.

    Attributes:
        calibration: the applied one.
    """

    def __init__(self, sensor_leans: bool = True) -> None:
        """Begin with nothing known; ``sensor_leans``: whether the sensor may lean against odometry's gravity."""
        self._known = CalibrationBelief(sensor_leans)
        self._supposed: CalibrationBelief | None = None  # the same if a place that leads a search is the right one
        self._probability = 0.0  # that it is
        self._apply()

    def restore(self, known: Calibration) -> None:
        """Begin with an earlier calibration; it goes on being measured."""
        self._supposed = None
        self._known.restore(known)
        self._apply()

    def learn(self, known: Calibration) -> None:
        """Take over an earlier calibration as far as it is better known than the present one."""
        self._supposed = None
        self._known.learn(known)
        self._apply()

    def forget_leader(self) -> None:
        """Forget the supposition by a place that led a search."""
        self._supposed = None
        self._apply()

    def begin_odometry(self) -> None:
        """Forget how odometry's frame leans, for another one begins; the robot's constants stay."""
        self._supposed = None
        self._known.begin_odometry()
        self._apply()

    def motion_covariance(self, step: Floats) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) of a motion by ``step`` (3,) metres, in the axes of that."""
        along = np.concatenate([np.zeros(3), step])
        spread = np.outer(along, along) * self.calibration.sigma_scale**2
        spread[2, 2] += (self.calibration.sigma_turn * float(np.linalg.norm(step))) ** 2
        return np.asarray(spread)

    def measure_attitude(self, T_map_cloud: Pose, T_odom_body: Pose, variance: float) -> None:
        """Take in the attitude of a registration at the known place (eq. C1).

        Args:
            T_map_cloud: (4, 4) registered pose of the cloud in the sensor's own axes, without the prediction's share.
            T_odom_body: (4, 4) odometry of the same frame.
            variance: of the registration's roll and pitch, rad^2.
        """
        self._supposed = None
        _measure_attitude(self._known, T_map_cloud, T_odom_body, variance)
        self._apply()

    def suppose_attitude(self, T_map_cloud: Pose, T_odom_body: Pose, variance: float, probability: float) -> None:
        """Take in the attitude at a place that is right with a ``probability``; a wrong place says nothing.

        Replaces the previous supposition, for a search registers the same scans again. Args as
        :meth:`measure_attitude`.
        """
        self._supposed, self._probability = self._known.copy(), probability
        _measure_attitude(self._supposed, T_map_cloud, T_odom_body, variance)
        self._apply()

    def measure_motion(self, T_map_before: Pose, T_map_body: Pose, step: Pose, noise: Floats) -> Pose:
        """Take in the motion between two registrations (eq. C2); return the step as it is corrected from now on.

        Args:
            T_map_before: (4, 4) the earlier one, as the map alone has it.
            T_map_body: (4, 4) the later one.
            step: (4, 4) odometry between them, as it has been corrected.
            noise: (2,) variances along the way and of the heading, but for the calibration's.
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
        """Take in the motion from frame to frame that the lidar alone has seen (eq. C4).

        Args:
            motion: (4, 4) of the levelled body.
            step: (4, 4) odometry's, as it has been corrected.
            variances: (6,) of odometry's random walk meanwhile, over (rx, ry, rz, x, y, z).
            position: sigma of ``motion``, metres.
            angle: sigma of it, radians.

        Returns:
            ``step`` as it is corrected from now on.
        """
        t, before = step[:3, 3], self.calibration
        applied = log_so3(before.R_body_cloud)[:2]
        turned = log_so3(motion[:3, :3] @ step[:3, :3].T)
        # the motion's height, of which the tilt is the cause
        H = np.zeros((1, SIZE))
        H[0, :2] = -t[1], t[0]
        rise = np.array([motion[2, 3] - t[2] + H[0, :2] @ applied])
        self._update(rise, H, np.array([[variances[5] + position**2]]))
        H = np.zeros((2, SIZE))
        H[:, :2] = (motion[:3, :3] - np.eye(3))[:2, :2]  # odometry's heading is the worse one
        self._update(turned[:2] + H[:, :2] @ applied, H, np.eye(2) * (variances[0] + (_LEAN * angle) ** 2))
        noise = np.array([variances[3] + position**2, variances[2] + angle**2])
        level = pose_from(self.calibration.R_body_cloud @ before.R_body_cloud.T, np.zeros(3))
        return self.measure_motion(np.eye(4), level @ motion @ inverse(level), step, noise)

    def _update(self, seen: Floats, H: Floats, R: Floats) -> None:
        """Take in a measurement ``seen`` = H x + noise of covariance R, whatever is supposed."""
        likelihood = self._known.update(seen, H, R)
        if self._supposed is not None:
            ratio = self._supposed.update(seen, H, R) - likelihood
            right = self._probability * math.exp(min(ratio, 50.0))
            self._probability = right / (right + 1.0 - self._probability)
        self._apply()

    def _apply(self) -> None:
        self.calibration = self._known.applied()
        if self._supposed is not None:
            self.calibration = mixed(self.calibration, self._supposed.applied(), self._probability)


def _measure_attitude(belief: CalibrationBelief, T_map_cloud: Pose, T_odom_body: Pose, variance: float) -> None:
    R_body_cloud = belief.applied().R_body_cloud
    left = np.cross((T_map_cloud[:3, :3] @ R_body_cloud.T)[2], T_odom_body[2, :3])
    left[2] = 0.0
    seen = log_so3(exp_so3(left) @ R_body_cloud)[:2]
    H = np.eye(2, SIZE)
    H[:, GRAVITY.axes] = T_odom_body[:2, :2].T  # the lean of odometry's frame turns with the body
    R = np.eye(2) * (variance + _ATTITUDE**2)
    belief.doubt_tilt(seen, H, R)
    belief.update(seen, H, R)


def tilt_variance(covariance: Floats) -> float:
    """Return the variance of roll or pitch, rad^2, of a covariance (6, 6) over (rx, ry, rz, x, y, z)."""
    return 0.5 * float(covariance[0, 0] + covariance[1, 1])
