"""Motion between two clouds, registered to each other without the map and without trust in odometry.

The registration starts at odometry's motion. Where another start could explain the clouds as well (no motion, as of a
repeated scan) or the clouds fit less than usual (a turned sensor, a cloud of another time), the clouds' own fit
decides: the share of the structure that lies on the earlier cloud's surfaces. So odometry cannot hide a motion that it
lacks. In foliage few points lie on any surface, even in their own cloud, and the usual fit is relative to that share.
Motions are planar: (x, y, heading) in the level axes of the earlier body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.planar import planar_covariance, planar_motion
from coview_stream.geometry.transforms import Pose, Poses, inverse, pose_from, rot_z, transform, yaw_of
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud, prepare_scan
from coview_stream.localization.registration.register import registration_covariance, remove_prior
from coview_stream.localization.registration.surfaces import (
    motion_prior,
    motion_sigmas,
    register_to_cloud,
    surface_points,
)

_ON_SURFACE = 0.1  # metres across an earlier surface, whose thickness is 0.15 (one sigma) at most
_REACH = 1.0  # metres along the surface to its nearest point: the ring spacing of sparse lidars
_SAMPLE = 300  # points that measure the fit
_FEWEST = 40  # points of structure; fewer do not show the clouds' motion
_COARSE = 0.4  # metres, for the fit of starts before registration
_USUAL = 0.7  # share of the usual fit below which other starts are tried
_LEARNS = 0.1  # weight of a new fit in the usual one
_STARTS = 2  # best of those starts, which are registered
ALIKE = 0.03
"""Difference of fits below the resolution of counting so many points (one sigma)."""
APART = 2.0
"""Misfit above which clouds do not fit each other."""
_STAYS = 0.06  # metres: three sigmas of a motion
_NEAR_ZERO = 0.3  # metres and radians, largest motion of a copy
_SAME = 0.05  # metres, largest shift of a copied point by a lidar's noise
_UNKNOWN = 1e4  # variance of a motion that cannot be registered, m2 and rad2


class CloudMotion(NamedTuple):
    """Planar motion of the body between two clouds."""

    motion: Floats  # (3,) x, y, heading
    covariance: Floats  # (3, 3), wide along a tunnel
    fit: float  # share of the structure on the earlier surfaces
    usual: float  # expected fit, by earlier motions and the share of structure on the scan's own surfaces
    surfaces: float  # number of the scan's points on its own surfaces
    T: Pose | None  # (4, 4) in the axes of the earlier body; None if registration fails
    same: float | None = None  # share of unmoved structure points, for a motion near zero

    @property
    def misfit(self) -> float:
        """Factor by which the clouds fit worse than usual."""
        return (self.usual + ALIKE) / (self.fit + ALIKE)


class CloudMotionMeter:
    """Meter of the motion between clouds, with memory of their usual fit."""

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._usual: float | None = None  # share of a scan's structure on its own surfaces that is on earlier ones

    def measure(
        self, before: RawScan, now: RawScan, calibration: Calibration, guess: Floats | None = None
    ) -> CloudMotion | None:
        """Return the motion between two scans; None where there is too little to register.

        ``guess`` (3,) is another motion to start from, beside odometry's.
        """
        here = np.zeros(3)
        target = LocalMap(*surface_points(before.levelled(calibration) - before.position.astype(np.float32)))
        scan_points = now.levelled(calibration) - now.position.astype(np.float32)
        scan = prepare_scan(scan_points, here, self._config)
        if len(target.points) < MIN_PAIRS or int(scan.above.sum()) < _FEWEST:
            return None  # bare ground looks alike everywhere
        target.prepare()
        # in odometry's axes, about the body: odometry's motion has no rotation there
        odometry = pose_from(np.eye(3), now.position - before.position)
        turned = before.T_odom_body[:3, :3] @ now.T_odom_body[:3, :3].T
        none = pose_from(turned, here)
        found = [self._registered(scan, target, odometry)]
        if guess is not None:
            turn = guess[2] - planar_motion(before.T_odom_body, now.T_odom_body)[2]
            shift = rot_z(yaw_of(before.T_odom_body)) @ [guess[0], guess[1], odometry[2, 3]]
            found.append(self._registered(scan, target, pose_from(rot_z(turn), shift)))
        if fit_of(scan, target, none) > max(fit for *_, fit in found):
            still = self._registered(scan, target, none)
            # rings coincide where nothing moves, too; but a copy stays where it started
            if still[0] is not None and float(np.linalg.norm(still[0][:3, 3])) < _STAYS:
                found.append(still)
        flat = fit_of(scan, LocalMap(*surface_points(scan_points)), np.eye(4))
        surfaces = flat * int(scan.above.sum())
        if max(fit for *_, fit in found) < _USUAL * flat * (self._usual or 0.0):
            starts = _starts(odometry)
            fits = np.array([fit_of(scan, target, T, _COARSE) for T in starts])
            found += [self._registered(scan, target, starts[k]) for k in np.argsort(-fits)[:_STARTS]]
        best = max(found[1:], key=lambda each: each[2], default=found[0])
        if best[2] <= found[0][2] + 2.0 * ALIKE:
            best = found[0]
        if best[0] is None:
            usual = flat * (self._usual or 0.0)
            fit = fit_of(scan, target, odometry)
            unknown = CloudMotion(np.zeros(3), _UNKNOWN * np.eye(3), fit, usual, surfaces, None)
            # clouds with too few surface points to register say nothing
            return unknown if unknown.misfit > APART and surfaces >= MIN_PAIRS else None
        if self._usual is None:
            self._usual = min(1.0, best[2] / max(flat, ALIKE))  # no surfaces fit a cloud better than its own
        usual = flat * self._usual
        self._usual += _LEARNS * (best[2] - usual)
        T_now = pose_from(best[0][:3, :3] @ now.T_odom_body[:3, :3], before.position + best[0][:3, 3])
        motion, covariance = _in_plane(T_now, best[1], before.T_odom_body)
        same: float | None = None
        if float(np.abs(motion).max()) < _NEAR_ZERO:
            rows = _some_structure(scan)
            points = before.levelled(calibration) - before.position.astype(np.float32)
            grid = kernels.PointGrid(points)
            same = float((kernels.nearest(grid, transform(none, scan.points[rows]), _SAME)[0] < _SAME).mean())
        return CloudMotion(motion, covariance, best[2], usual, surfaces, inverse(before.T_odom_body) @ T_now, same)

    def _registered(
        self, scan: RegistrationCloud, target: LocalMap, T_start: Pose
    ) -> tuple[Pose | None, Floats, float]:
        """Return pose (4, 4), covariance (6, 6) and fit of a registration; no pose if it fails."""
        prior = motion_prior(T_start, float(np.linalg.norm(T_start[:3, 3])))
        registration = register_to_cloud(scan, target, prior, self._config, np.zeros(3))
        if registration is None:
            return None, np.eye(6), 0.0
        try:
            T, information = remove_prior(registration, prior, self._config)
            covariance = registration_covariance(information, self._config)
        except InputError:
            return None, np.eye(6), 0.0
        # along a tunnel the clouds show nothing, and stay at the start
        return T, covariance, fit_of(scan, target, T)


def fit_of(scan: RegistrationCloud, target: LocalMap, T: Pose, across: float = _ON_SURFACE) -> float:
    """Return the share of the scan's structure on the target's surfaces at a pose; 0 without structure."""
    rows = _some_structure(scan)
    if not len(rows):
        return 0.0
    points = transform(T, scan.points[rows])
    distance, nearest = kernels.nearest(target.grid, points, _REACH)
    seen = distance < _REACH
    gaps = points[seen] - target.points[nearest[seen]]
    return float((np.abs((gaps * target.normals[nearest[seen]]).sum(axis=1)) < across).sum() / len(points))


def _some_structure(scan: RegistrationCloud) -> Ints:
    """Return rows of about 300 points of a scan's structure."""
    rows = np.flatnonzero(scan.above)
    return rows[:: max(1, len(rows) // _SAMPLE)]


def _starts(odometry: Pose) -> Poses:
    """Return motions (K, 4, 4) to try: parts of odometry's, also backwards, turned by all angles, and to all sides."""
    poses = [pose_from(np.eye(3), share * odometry[:3, 3]) for share in (-2.0, -1.0, -0.5, 0.5, 1.5, 2.0)]
    poses += [pose_from(rot_z(np.radians(angle)), odometry[:3, 3]) for angle in range(-175, 181, 5) if angle]
    for radius in (0.75, 1.5, 2.25, 3.0, 4.0, 5.0):
        for angle in np.arange(0.0, 2.0 * np.pi, 0.75 / radius):
            side = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
            poses.append(pose_from(np.eye(3), odometry[:3, 3] + side))
    return np.stack(poses)


def _in_plane(T_now: Pose, covariance: Floats, T_before: Pose) -> tuple[Floats, Floats]:
    """Return a pose (4, 4) after another and its covariance (6, 6) as a planar motion and its (3, 3)."""
    motion = planar_motion(T_before, T_now)
    position, angle = motion_sigmas(float(np.linalg.norm(motion[:2])))
    return motion, planar_covariance(covariance, T_before) + np.diag([position, position, angle]) ** 2
