"""Estimation of the calibration: a Kalman filter over what is constant about a robot, or nearly so.

The state is x = (roll, pitch, s, w, g): the tilt of the sensor against odometry's gravity, the scale of odometry's
distances less one, the turn of its heading per metre, and how odometry's frame leans against the map (2). It is what is
left of the pose graph's errors when those that are independent from step to step
(:class:`coview_stream.localization.tracking.motion.Drift`) are taken away. Each registration to the map that is
believed measures two things:

* its attitude against odometry's gravity. With u the vertical in the body's axes, by the map and by odometry, the tilt
  that is left is u_map x u_odometry (eq. C1). The sensor's turns with the body, that of odometry's frame does not; the
  latter is left to the pose graph, which follows it;
* the motion since the registration before against odometry's. Along the way they differ by s times the distance, in
  heading by w times the distance (eq. C2), but for both registrations' errors and odometry's random walk.

A motion far outside what all this allows (wheels slip) counts less, as under Student's t distribution. Nothing is for
ever: each component walks at random, slowly, with the metres driven.

Most sensors stand straight and most odometry has the right scale. So each of the three groups is a mixture: zero but
for a small spread, or anything up to a large one; what is applied is the mean of both, weighed by how probable they are
(Savage and Dickey's ratio, eq. C3).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, exp_so3, inverse, log_so3, pose_from
from coview_stream.localization.calibration.calibration import Calibration


class _Prior(NamedTuple):
    """What is known of a group of components before anything is seen; all set by hand.

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
_GRAVITY = _Prior(slice(4, 6), math.radians(0.25), math.radians(0.25), 1.0, math.radians(0.1))
_GROUPS = (_TILT, _SCALE, _TURN)  # that are corrected
_WIDE = np.concatenate([np.full(g.axes.stop - g.axes.start, g.wide) for g in (*_GROUPS, _GRAVITY)])
_SIZE = len(_WIDE)

_ATTITUDE = math.radians(0.1)  # sigma of a registration's roll and pitch beside its own; set by hand
_LEAN = 3.0  # times its heading's error that a motion from frame to frame is off in roll and pitch; set by hand
_FREEDOM = 4.0  # degrees of freedom of Student's distribution; set by hand
_MIN_STEP = 0.2  # metres; over less, the registrations' noise hides all else; set by hand


class CalibrationEstimator:
    """Estimate of the calibration, and the correction of clouds and odometry by it.

    Attributes:
        calibration: what is applied.
    """

    def __init__(self, sensor_leans: bool = True) -> None:
        """Begin with nothing known; ``sensor_leans``: whether the sensor may lean against odometry's gravity."""
        self._sensor_leans = sensor_leans
        self._x = np.zeros(_SIZE)
        self._P = np.diag(_WIDE**2)
        self._stand_straight()
        self._mix()

    def restore(self, known: Calibration) -> None:
        """Begin with what was known of this robot before; it goes on being measured."""
        self._x = np.array([known.roll, known.pitch, known.scale, known.turn, 0.0, 0.0])
        self._P = np.diag(_WIDE**2)
        sigmas = [known.sigma_tilt, known.sigma_tilt, known.sigma_scale, known.sigma_turn]
        self._P[:4, :4] = np.diag(np.square(sigmas))
        self._stand_straight()
        self._mix()

    def begin_odometry(self) -> None:
        """Forget how odometry's frame leans, for another one begins; what is known of the robot stays."""
        self._x[_GRAVITY.axes] = 0.0
        self._P[_GRAVITY.axes], self._P[:, _GRAVITY.axes] = 0.0, 0.0
        self._P[_GRAVITY.axes, _GRAVITY.axes] = np.eye(2) * _GRAVITY.wide**2

    def motion_covariance(self, step: Floats) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) of a motion by ``step`` (3,) metres, in the axes of that."""
        along = np.concatenate([np.zeros(3), step])
        spread = np.outer(along, along) * self.calibration.sigma_scale**2
        spread[2, 2] += (self.calibration.sigma_turn * float(np.linalg.norm(step))) ** 2
        return np.asarray(spread)

    def measure_attitude(self, T_map_body: Pose, T_odom_body: Pose, variance: float, R_body_cloud: Floats) -> None:
        """Take in the attitude of a registration (eq. C1).

        Args:
            T_map_body: (4, 4) as the map alone has it, of a cloud that has been levelled.
            T_odom_body: (4, 4) odometry of the same body.
            variance: of the registration's roll and pitch, rad^2.
            R_body_cloud: (3, 3) rotation that the cloud has been levelled by, which may be known better by now.
        """
        left = np.cross(T_map_body[2, :3], T_odom_body[2, :3])
        left[2] = 0.0
        seen = log_so3(exp_so3(left) @ R_body_cloud)[:2]
        H = np.eye(2, _SIZE)
        H[:, 4:] = T_odom_body[:2, :2].T  # what leans with odometry's frame turns as the body does
        R = np.eye(2) * (variance + _ATTITUDE**2)
        self._doubt_tilt(seen - H @ self._x, H @ self._P @ H.T + R)
        self._update(seen, H, R)

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
        self._walk(driven)
        motion = inverse(T_map_before) @ T_map_body
        along = float((motion[:3, 3] - step[:3, 3]) @ step[:3, 3]) / driven
        turned = float(log_so3(motion[:3, :3] @ step[:3, :3].T)[2])
        before = self.calibration
        raw = driven / (1.0 + before.scale)
        for axis, gap, applied in ((2, along, before.scale), (3, turned, before.turn)):
            H = np.zeros((1, _SIZE))
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
        H = np.zeros((1, _SIZE))
        H[0, :2] = -t[1], t[0]
        rise = np.array([motion[2, 3] - t[2] + H[0, :2] @ applied])
        self._update(rise, H, np.array([[variances[5] + position**2]]))
        H = np.zeros((2, _SIZE))
        H[:, :2] = (motion[:3, :3] - np.eye(3))[:2, :2]  # odometry's heading is the worse one
        self._update(turned[:2] + H[:, :2] @ applied, H, np.eye(2) * (variances[0] + (_LEAN * angle) ** 2))
        noise = np.array([variances[3] + position**2, variances[2] + angle**2])
        level = pose_from(self.calibration.R_body_cloud @ before.R_body_cloud.T, np.zeros(3))
        return self.measure_motion(np.eye(4), level @ motion @ inverse(level), step, noise)

    def _walk(self, driven: float) -> None:
        """Let everything have changed a little over ``driven`` metres."""
        for group in (*_GROUPS, _GRAVITY):
            axes = np.arange(_SIZE)[group.axes]
            self._P[axes, axes] = np.minimum(self._P[axes, axes] + group.walk**2 * driven, group.wide**2)
        self._stand_straight()

    def _stand_straight(self) -> None:
        """Know for sure that the sensor does not lean, if it cannot: then what leans is odometry's gravity."""
        if not self._sensor_leans:
            self._x[:2] = 0.0
            self._P[:2], self._P[:, :2] = 0.0, 0.0

    def _doubt_tilt(self, gap: Floats, spread: Floats) -> None:
        """Widen a tilt that a measurement contradicts by far: it is as probably right as what the state came from."""
        factor = heavier(float(gap @ np.linalg.solve(spread, gap)), 2)
        widest = _TILT.wide**2 / max(float(self._P[0, 0]), float(self._P[1, 1]), 1e-30)
        wider = math.sqrt(min(factor, max(widest, 1.0)))
        self._P[:2] *= wider
        self._P[:, :2] *= wider

    def _update(self, seen: Floats, H: Floats, R: Floats) -> None:
        """Take in a measurement ``seen`` = H x + noise of covariance R, heavy-tailed."""
        gap = seen - H @ self._x
        distance = float(gap @ np.linalg.solve(H @ self._P @ H.T + R, gap))
        R = R * heavier(distance, len(gap))
        gain = np.linalg.solve(H @ self._P @ H.T + R, H @ self._P).T
        self._x = self._x + gain @ gap
        rest = np.eye(_SIZE) - gain @ H
        self._P = rest @ self._P @ rest.T + gain @ R @ gain.T
        self._mix()

    def _mix(self) -> None:
        """Weigh, group by group, "as it should be" against "anything" (eq. C3)."""
        means, sigmas = np.zeros(4), []
        for group in _GROUPS:
            x, P = self._x[group.axes], self._P[group.axes, group.axes]
            size = len(x)
            spread = P + group.exact**2 * np.eye(size)
            exact = -0.5 * (x @ np.linalg.solve(spread, x) + np.linalg.slogdet(spread)[1]) + size * math.log(group.wide)
            weight = 1.0 / (1.0 + (1.0 - group.share) / group.share * math.exp(min(exact, 500.0)))
            means[group.axes] = weight * x
            about = group.exact**2 * np.trace(P) / (np.trace(P) + size * group.exact**2)
            within = weight * np.trace(P) + (1.0 - weight) * about
            sigmas.append(math.sqrt((within + weight * (1.0 - weight) * float(x @ x)) / size))
        self.calibration = Calibration(*means.tolist(), *sigmas)


def heavier(distance: float, size: int) -> float:
    """Return what a variance is to be multiplied with under Student's t distribution.

    Args:
        distance: squared Mahalanobis distance of what was measured.
        size: how many numbers that were.
    """
    return max(1.0, (_FREEDOM + distance) / (_FREEDOM + size))


def tilt_variance(covariance: Floats) -> float:
    """Return the variance of roll or pitch, rad^2, of a covariance (6, 6) over (rx, ry, rz, x, y, z)."""
    return 0.5 * float(covariance[0, 0] + covariance[1, 1])
