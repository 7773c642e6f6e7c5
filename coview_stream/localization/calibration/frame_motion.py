"""Motion from frame to frame by the lidar alone, before any place is known, as a measurement of sensor and odometry.

The newest keyframe is registered to the one before. With ε the tilt of the sensor that is not corrected yet, t and R
odometry's motion in the body's axes, s and w as in :mod:`coview_stream.localization.calibration.estimator`, the
registered motion differs from odometry's (hand-eye calibration, to first order) by

* t x ε + s t in position, of which the components along the way (s) and along the body's z (ε) are used: the third one
  is the heading of the sensor on the body, which is not estimated;
* (R - I) ε + w |t| z in rotation: a robot that turns sees its roll, too (eq. C4).

The same registration mends the motion itself: odometry that drifts smears the virtual scan of many keyframes. Both are
weighed by their variances; a registration that contradicts odometry counts less (in a street all along looks alike).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coview_stream.config import RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, Pose, inverse, log_so3, pose_from, rot_z, transform, yaw_of
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator, heavier
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import Prior, register

# set by hand
_SCALES = (1.5, 0.8, 0.4)  # metres: largest correspondence distances of the registration, coarse to fine
_FREE = np.array([math.radians(2.0), math.radians(2.0), math.radians(3.0), 0.05, 0.05, 0.05])
_FREE_METRE = 0.1  # sigmas by which the motion may differ from odometry's, and metres more per metre driven
_POSITION = 0.02  # sigma of a registered motion, metres
_POSITION_METRE = 0.01  # and per metre driven: as in three real runs at two to eight metres a step
_ANGLE = math.radians(0.2)  # likewise
_HEADING = math.radians(1.0)  # sigma of the heading of the sensor on the body
_POORER = 3.0  # times odometry may drift as it is known to, or configured
_FAILS = 0.1  # probability that a registration fails, and sigmas of where it comes to then: angles, and metres a metre
_FAILED_ANGLE = math.radians(3.0)
_FAILED = 0.15
_LONGEST = 12.0  # metres between two keyframes that are compared

# of surface patches; set by hand
_CELL = 1.0  # metres
_CELL_POINTS = 5
_THICKNESS = 0.15  # metres, one sigma across
_FLATTER = 2.0  # times as wide as thick

Variances = Callable[[float, float], Floats]
"""Variances (6,) over (rx, ry, rz, x, y, z) that odometry's random walk gathers in metres driven and radians turned."""


@dataclass(frozen=True)
class _Reference:
    """The keyframe that the next one is registered to.

    Attributes:
        points: (K, 3) float32 on surfaces, body frame, as they came.
        normals: (K, 3) float32 of those, same frame.
        T_odom_body: (4, 4) odometry, corrected.
    """

    points: Points
    normals: Floats32
    T_odom_body: Pose


class FrameMotion:
    """Registration of each keyframe to the one before, while no place is known."""

    def __init__(self, config: RegistrationConfig, distance: float) -> None:
        """Compare frames at least ``distance`` metres apart."""
        self._config = config
        self._distance = distance
        self._reference: _Reference | None = None

    def clear(self) -> None:
        """Forget the keyframe: odometry may have jumped."""
        self._reference = None

    def is_due(self, T_odom_body: Pose) -> bool:
        """Tell whether a frame is far enough from the one before."""
        if self._reference is None:
            return True
        return float(np.linalg.norm(T_odom_body[:3, 3] - self._reference.T_odom_body[:3, 3])) >= self._distance

    def refine(self, points: Points, T_odom_body: Pose, estimator: CalibrationEstimator, drift: Variances) -> Pose:
        """Register a frame to the one before; return its odometry, mended.

        Args:
            points: (N, 3) float32 body frame, one per voxel, as they came.
            T_odom_body: (4, 4) odometry, corrected by the estimator's calibration.
            estimator: learns from it.
            drift: of odometry.
        """
        reference = self._reference
        seen = None if reference is None else self._registered(reference, points, T_odom_body, estimator)
        if reference is not None and seen is not None:
            T_odom_body = _mended(reference.T_odom_body, T_odom_body, seen, estimator, drift)
        on_surfaces, normals = surface_points(points)
        self._reference = _Reference(on_surfaces, normals, T_odom_body)
        return T_odom_body

    def _registered(
        self, reference: _Reference, points: Points, T_odom_body: Pose, estimator: CalibrationEstimator
    ) -> Pose | None:
        """Return where the keyframe before sees this one, (4, 4) odometry <- body; None if nothing can be told."""
        far = float(np.linalg.norm(T_odom_body[:3, 3] - reference.T_odom_body[:3, 3]))
        if len(reference.points) < MIN_PAIRS or far > _LONGEST:
            return None
        level = pose_from(estimator.calibration.R_body_cloud, np.zeros(3))
        then = reference.T_odom_body @ level
        target = LocalMap(
            np.ascontiguousarray(transform(then, reference.points)),
            np.ascontiguousarray(reference.normals @ then[:3, :3].T.astype(np.float32)),
        )
        scan = prepare_scan(transform(T_odom_body @ level, points), T_odom_body[:3, 3], self._config)
        if len(scan.points) < MIN_PAIRS:
            return None
        free = _FREE + np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) * _FREE_METRE * far
        prior = Prior(np.eye(4), np.diag(free**-2.0))
        found = register(scan, np.eye(4), target, self._config, _SCALES, prior, T_odom_body[:3, 3])
        return None if found is None else found.T_map_source @ T_odom_body


def _mended(before: Pose, T_odom_body: Pose, seen: Pose, estimator: CalibrationEstimator, drift: Variances) -> Pose:
    """Teach the estimator a registered motion; return the newest frame's odometry (4, 4), mended by both.

    Args:
        before: (4, 4) odometry of the keyframe before.
        T_odom_body: (4, 4) odometry of the newest, corrected by the estimator's calibration.
        seen: (4, 4) where the keyframe before sees the newest.
        estimator: learns from it.
        drift: of odometry.
    """
    level = estimator.calibration.R_body_cloud
    motion, step = inverse(before) @ seen, inverse(before) @ T_odom_body
    far = float(np.linalg.norm(step[:3, 3]))
    variances = drift(far, abs(yaw_of(step)))
    position = math.hypot(_POSITION, _POSITION_METRE * far)
    right = _probability_right(motion, step, variances, estimator.calibration, position)
    sigmas = position / math.sqrt(right), _ANGLE / math.sqrt(right)
    step = estimator.measure_frames(motion, step, variances, *sigmas)
    motion = _turned(motion, estimator.calibration.R_body_cloud @ level.T)
    return _fused(before @ step, before @ motion, variances, *sigmas)


def surface_points(points: Points) -> tuple[Points, Floats32]:
    """Return the points (K, 3) of a cloud (N, 3) whose cubic metre holds a piece of surface, and its normals (K, 3)."""
    cell = np.floor(points / np.float32(_CELL)).astype(np.int64)
    cell -= cell.min(axis=0) if len(cell) else 0
    size = cell.max(axis=0) + 1 if len(cell) else np.ones(3, dtype=np.int64)
    _, which, count = np.unique(
        (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_inverse=True, return_counts=True
    )
    exact = points.astype(np.float64)
    off = exact - (_sums(exact, which, len(count)) / count[:, None])[which]
    moments = _sums((off[:, :, None] * off[:, None, :]).reshape(-1, 9), which, len(count)) / count[:, None]
    variances, axes = np.linalg.eigh(moments.reshape(-1, 3, 3))
    thin = np.maximum(variances[:, 0], 0.0)
    flat = (count >= _CELL_POINTS) & (thin < _THICKNESS**2) & (variances[:, 1] > _FLATTER**2 * thin)
    kept = flat[which]
    return points[kept], axes[:, :, 0][which[kept]].astype(np.float32)


def _sums(values: Floats, which: Ints, count: int) -> Floats:
    """Add up, (count, K), the rows of values (N, K) that go to each of ``count`` cells."""
    columns = [np.bincount(which, column, minlength=count) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.empty((count, 0))


def _turned(motion: Pose, R: Floats) -> Pose:
    """Return a motion (4, 4) of a body whose axes are turned by ``R`` (3, 3)."""
    return pose_from(R @ motion[:3, :3] @ R.T, R @ motion[:3, 3])


def _probability_right(motion: Pose, step: Pose, variances: Floats, known: Calibration, position: float) -> float:
    """Return how probable it is that a registration has not failed, by how it differs from odometry's ``step``.

    One that fails (a street all along looks alike, and a lorry drives away) may come to anything within its reach.
    """
    far = float(np.linalg.norm(step[:3, 3]))
    gap = np.concatenate([log_so3(motion[:3, :3] @ step[:3, :3].T), motion[:3, 3] - step[:3, 3]])
    tilt = known.sigma_tilt * far
    constant = np.array([0.0, 0.0, known.sigma_turn * far, known.sigma_scale * far, _HEADING * far, tilt])
    seen = np.array([_ANGLE] * 3 + [position] * 3)
    right = _POORER**2 * variances + constant**2 + seen**2
    turn = 1.0 - math.cos(yaw_of(motion)) + abs(math.sin(yaw_of(motion)))  # by which a lean shows in rotation
    right[:2] += (known.sigma_tilt * turn) ** 2
    failed = right + np.array([_FAILED_ANGLE] * 3 + [_FAILED * far] * 3) ** 2
    ratio = math.log(_FAILS / (1.0 - _FAILS)) + 0.5 * float(
        (gap**2 / right - gap**2 / failed + np.log(right) - np.log(failed)).sum()
    )
    return max(1.0 / (1.0 + math.exp(min(ratio, 50.0))), 1e-6)


def _fused(T_odometry: Pose, T_seen: Pose, variances: Floats, position: float, angle: float) -> Pose:
    """Return odometry's pose (4, 4), moved and turned about the vertical towards where the lidar sees it."""
    moved = T_odometry.copy()
    for axis in range(3):
        gap = float(T_seen[axis, 3] - T_odometry[axis, 3])
        moved[axis, 3] += _share(gap, float(variances[3 + axis]), position**2) * gap
    turn = float(log_so3(T_seen[:3, :3] @ T_odometry[:3, :3].T)[2])
    moved[:3, :3] = rot_z(_share(turn, float(variances[2]), angle**2) * turn) @ T_odometry[:3, :3]
    return moved


def _share(gap: float, odometry: float, seen: float) -> float:
    """Return the share of a gap by which odometry is off, by both variances; the lidar's have heavier tails."""
    seen = float(heavier(gap**2 / (odometry + seen), 1)) * seen
    return odometry / (odometry + seen)
