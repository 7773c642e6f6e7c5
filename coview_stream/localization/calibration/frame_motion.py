"""Lidar motion between keyframes before the first fix, as a measurement of sensor and odometry errors.

The newest keyframe is registered to the previous one. With ε the uncorrected tilt of the sensor, t and R odometry's
motion in the body's axes, s and w as in :mod:`coview_stream.localization.calibration.estimator`, the registered motion
differs from odometry's (hand-eye calibration, to first order) by

* t x ε + s t in position. The components along the path (s) and along the body's z (ε) are used; the third shows the
  heading of the sensor on the body (eq. C2).
* (R - I) ε + w |t| z in rotation: a turning robot also observes its roll (eq. C4).

The registration also corrects the motion itself, as odometry's drift smears the virtual scan of many keyframes. The
two motions are weighted by their variances, and a registration that contradicts odometry counts less.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from coview_stream.config import RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Points, Pose, inverse, log_so3, orthonormal, rot_z, transform, yaw_of
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator, Moments, heavier
from coview_stream.localization.calibration.odometry_history import Moment
from coview_stream.localization.registration.clouds import LocalMap, prepare_scan
from coview_stream.localization.registration.register import registration_covariance
from coview_stream.localization.registration.surfaces import (
    LONGEST,
    motion_prior,
    motion_sigmas,
    register_to_cloud,
    surface_points,
)

# set by hand
_POORER = 3.0  # allowed multiple of odometry's configured drift
_FAILS = 0.1  # probability that a registration fails
_FAILED_ANGLE = math.radians(3.0)  # sigma of a failed one's angles
_FAILED = 0.15  # sigma of its position, metres per metre of motion

Variances = Callable[[float, float], Floats]
"""Variances (6,) over (rx, ry, rz, x, y, z) of odometry's random walk, by metres driven and radians turned."""


class _Reference(NamedTuple):
    """Keyframe to which the next one is registered."""

    points: Points  # (K, 3) on surfaces, sensor's axes
    normals: Floats32  # (K, 3) of the points
    T_odom_body: Pose  # (4, 4) corrected odometry
    moment: Moment | None


class FrameMotion:
    """Registration of keyframes to their predecessors, before the first fix."""

    def __init__(self, config: RegistrationConfig, distance: float) -> None:
        """Compare frames at least ``distance`` metres apart."""
        self._config = config
        self._distance = distance
        self._reference: _Reference | None = None

    def clear(self) -> None:
        """Forget the keyframe, as odometry may have jumped."""
        self._reference = None

    def is_due(self, T_odom_body: Pose) -> bool:
        """Return whether a frame is far enough from the previous keyframe."""
        if self._reference is None:
            return True
        return float(np.linalg.norm(T_odom_body[:3, 3] - self._reference.T_odom_body[:3, 3])) >= self._distance

    def refine(
        self, points: Points, T_odom_body: Pose, estimator: CalibrationEstimator, drift: Variances,
        moment: Moment | None = None,
    ) -> Pose:  # fmt: skip
        """Register a frame to the previous keyframe; return its odometry (4, 4), corrected by the result.

        ``points`` (N, 3) float32 are one per voxel, in the sensor's axes. ``T_odom_body`` (4, 4) is corrected by the
        calibration of ``estimator``, which receives the motion as a measurement. ``drift`` gives odometry's variances.
        """
        reference = self._reference
        if reference is not None:
            seen = self._registered(reference, points, T_odom_body, estimator)
            if seen is not None:
                both = reference.moment, moment
                fused = _corrected(reference.T_odom_body, T_odom_body, seen, estimator, drift, both)
                T_odom_body = orthonormal(fused)  # each keyframe is relative to the last: errors would double
        self._reference = _Reference(*surface_points(points), T_odom_body, moment)
        return T_odom_body

    def _registered(
        self, reference: _Reference, points: Points, T_odom_body: Pose, estimator: CalibrationEstimator
    ) -> tuple[Pose, Floats] | None:
        """Return the registered pose (4, 4), odometry <- body, and its covariance; None if registration fails.

        The covariance (6, 6) is over (rx, ry, rz, x, y, z), odometry's axes, without the prior.
        """
        far = float(np.linalg.norm(T_odom_body[:3, 3] - reference.T_odom_body[:3, 3]))
        if len(reference.points) < MIN_PAIRS or far > LONGEST:
            return None
        level = estimator.calibration.T_body_cloud
        then = reference.T_odom_body @ level
        target = LocalMap(
            np.ascontiguousarray(transform(then, reference.points)),
            np.ascontiguousarray(reference.normals @ then[:3, :3].T.astype(np.float32)),
        )
        scan = prepare_scan(transform(T_odom_body @ level, points), T_odom_body[:3, 3], self._config)
        if len(scan.points) < MIN_PAIRS:
            return None
        prior = motion_prior(np.eye(4), far)
        registration = register_to_cloud(scan, target, prior, self._config, T_odom_body[:3, 3])
        if registration is None:
            return None
        T = registration.T_map_source @ T_odom_body
        pairs = registration.information - self._config.inflation**2 * prior.information
        return T, registration_covariance(pairs, self._config)


def _corrected(
    before: Pose, T_odom_body: Pose, seen: tuple[Pose, Floats], estimator: CalibrationEstimator, drift: Variances,
    moments: Moments,
) -> Pose:  # fmt: skip
    """Pass a registered motion from ``before`` (4, 4) to the estimator; return the newest odometry (4, 4), fused."""
    T_registered, covariance = seen
    level = estimator.calibration.T_body_cloud
    motion, step = inverse(before) @ T_registered, inverse(before) @ T_odom_body
    far = float(np.linalg.norm(step[:3, 3]))
    variances = drift(far, abs(yaw_of(step)))
    R = before[:3, :3].T
    turned = np.block([[R, np.zeros((3, 3))], [np.zeros((3, 3)), R]])
    position, angle = motion_sigmas(far)
    least = np.array([angle] * 3 + [position] * 3)
    sigmas, there = (np.sqrt(least**2 + np.diag(C)) for C in (turned @ covariance @ turned.T, covariance))
    right = _probability_right(motion, step, variances, sigmas, estimator.calibration)
    step = estimator.measure_frames(motion, step, variances, sigmas, moments, right)
    turn = estimator.calibration.T_body_cloud @ inverse(level)
    motion = turn @ motion @ inverse(turn)
    return _fused(before @ step, before @ motion, variances, there / math.sqrt(right))


def _probability_right(motion: Pose, step: Pose, variances: Floats, noise: Floats, calibration: Calibration) -> float:
    """Return the probability that a registration succeeded, by its difference from odometry's ``step``.

    A failed one (a uniform street, a lorry that drives away) may end anywhere within its reach.
    """
    far = float(np.linalg.norm(step[:3, 3]))
    gap = np.concatenate([log_so3(motion[:3, :3] @ step[:3, :3].T), motion[:3, 3] - step[:3, 3]])
    tilt, sigma = calibration.sigma_tilt * far, calibration.sigma_heading
    constant = np.array([0.0, 0.0, calibration.sigma_turn * far, calibration.sigma_scale * far, sigma * far, tilt])
    right = _POORER**2 * variances + constant**2 + noise**2
    turn = 1.0 - math.cos(yaw_of(motion)) + abs(math.sin(yaw_of(motion)))  # share of a lean that appears as rotation
    right[:2] += (calibration.sigma_tilt * turn) ** 2
    failed = right + np.array([_FAILED_ANGLE] * 3 + [_FAILED * far] * 3) ** 2
    ratio = math.log(_FAILS / (1.0 - _FAILS)) + 0.5 * float(
        (gap**2 / right - gap**2 / failed + np.log(right) - np.log(failed)).sum()
    )
    return max(1.0 / (1.0 + math.exp(min(ratio, 50.0))), 1e-6)


def _fused(T_odometry: Pose, T_seen: Pose, variances: Floats, sigmas: Floats) -> Pose:
    """Return odometry's pose (4, 4), shifted and turned about the vertical towards the lidar's by their variances.

    ``sigmas`` (6,) are the lidar's, over (rx, ry, rz, x, y, z).
    """
    moved = T_odometry.copy()
    for axis in range(3):
        gap = float(T_seen[axis, 3] - T_odometry[axis, 3])
        moved[axis, 3] += _share(gap, float(variances[3 + axis]), float(sigmas[3 + axis] ** 2)) * gap
    turn = float(log_so3(T_seen[:3, :3] @ T_odometry[:3, :3].T)[2])
    moved[:3, :3] = rot_z(_share(turn, float(variances[2]), float(sigmas[2] ** 2)) * turn) @ T_odometry[:3, :3]
    return moved


def _share(gap: float, odometry: float, lidar: float) -> float:
    """Return the share of a gap attributed to odometry, by both variances; the lidar's has heavier tails."""
    lidar = float(heavier(gap**2 / (odometry + lidar), 1)) * lidar
    return odometry / (odometry + lidar)
