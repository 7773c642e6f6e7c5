"""Odometry from lidar frames alone: each frame is registered to a local map of earlier frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np

from coview_stream.config.odometry import LidarOdometryConfig, down
from coview_stream.errors import CloudError, RunError, require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    interpolate,
    inverse,
    is_pose,
    norms,
    orthonormal,
    pose_from,
    rotation_angle,
)
from coview_stream.geometry.validation import check_stamp, cloud_rows, finite_rows, to_array
from coview_stream.odometry.buffer import Segment
from coview_stream.odometry.deskew import deskew
from coview_stream.odometry.gravity import Ground, Surfaces, find_ground, level_rotation
from coview_stream.odometry.tilt_filter import Since, TiltFilter, upright


class ScanRegistration(Protocol):
    """Registration of frames to a local map that grows with them."""

    def register(self, points: Floats, guess: Pose) -> Pose:
        """Return the pose (4, 4) of a deskewed frame (N, 3), local map <- body, from a guess nearby; add the frame."""
        ...

    def clear(self) -> None:
        """Forget the local map; the pose of the next frame is its guess."""
        ...


class KissRegistration:
    """kiss-icp's (MIT; Vizzo et al., RA-L 2023) point-to-point ICP against its voxel map, with its adaptive threshold.

    kiss-icp 1.3.0 aborts the interpreter (``SOPHUS_ENSURE failed``) if all time stamps are equal or one is not finite,
    and refers its deskewed frames to the sweep's end or middle, depending on the version. So it gets no time stamps,
    and frames that :func:`~coview_stream.odometry.deskew.deskew` has moved to the frame's stamp.
    """

    def __init__(self, config: LidarOdometryConfig) -> None:
        """Prepare kiss-icp; DependencyError if it is missing."""
        pipeline, configuration = (
            require_library(f"kiss_icp.{name}", "kiss-icp>=1.2", "lidar odometry") for name in ("kiss_icp", "config")
        )
        settings = configuration.KISSConfig()
        settings.data.min_range, settings.data.max_range = config.min_range, config.max_range
        settings.data.deskew = False
        settings.mapping.voxel_size = config.voxel
        settings.registration.max_num_threads = config.threads
        settings.registration.convergence_criterion = _CONVERGENCE
        settings.registration.max_num_iterations = _ITERATIONS
        self._make: Callable[[], Any] = partial(pipeline.KissICP, settings)
        self.clear()

    def register(self, points: Floats, guess: Pose) -> Pose:
        """See :class:`ScanRegistration`."""
        icp = self._icp
        # register_frame predicts by the last motion, without times, so this passes the guess
        icp.last_delta = inverse(icp.last_pose) @ guess
        icp.register_frame(points, np.zeros(0))
        return np.array(icp.last_pose, dtype=np.float64)

    def clear(self) -> None:
        """See :class:`ScanRegistration`."""
        self._icp = self._make()


_MIN_MOTION_SECONDS = 0.02  # shorter motions are mostly noise
_MIN_SWEEP_SECONDS = 1e-4  # shorter sweeps are instants
_MAX_SWEEP_SECONDS = 1.0  # from the stamp; points farther away in time have another clock
_CONVERGENCE, _ITERATIONS = 1e-3, 60  # step, metres and radians, below which registration ends; most iterations
_MAX_TURN_RATE = 4.0  # radians per second: registration may spin with its own prediction
_SLACK, _SLACK_ANGLE = 0.5, np.radians(20.0)  # metres and radians that a registration may move in any case
_FOUND_GRAVITY = float(np.radians(10.0))  # one sigma before the first frame, whose walls and ground reduce it
_GIVEN_GRAVITY = float(np.radians(0.5))  # one sigma of a direction from the user
_SHAKE = float(np.radians(2.0))  # one sigma of a body's tilt from one frame to the next, set by hand
_SHAKE_SECONDS = 0.1  # between these frames; a random walk over longer times


class LidarOdometry:
    """Poses of a lidar's body frame in a gravity-aligned odometry frame, from its frames alone.

    The odometry frame has z up; its origin and the heading of its x axis are the body's at the first usable frame.
    It drifts, but not in tilt where there are walls (:mod:`~coview_stream.odometry.tilt_filter`). The last motion,
    scaled to the time between stamps, predicts the next one and deskews the frame. ``docs/results.md`` has the costs;
    kiss-icp holds the interpreter lock.

    Attributes:
        config: the settings.
        ground: the plane that gave gravity's direction; None before the first frame, and with given gravity.
        points: (N, 3) float32, the finite points of the newest frame, deskewed: input of a ``Localizer``.
        restarts: number of restarts of the local map, after gaps or impossible motions; odometry lacks the motion then.
    """

    def __init__(self, config: LidarOdometryConfig | None = None, registration: ScanRegistration | None = None) -> None:
        """Start without a frame; ``registration`` replaces kiss-icp.

        Raises:
            DependencyError: kiss-icp is missing, or cannot be loaded.
        """
        self.config = config or LidarOdometryConfig()
        self._registration = registration or KissRegistration(self.config)
        self.reset()

    def reset(self) -> None:
        """Forget all frames; the next one starts another odometry frame."""
        self.ground: Ground | None = None
        self.points: Points = np.empty((0, 3), dtype=np.float32)
        self.restarts = 0
        self._pose: Pose | None = None
        self._local = np.eye(4)  # pose by registration in the local map, whose tilt drifts
        self._T_odom_local = np.eye(4)
        self._ground: Ground | None = None  # of the newest frame that had one
        self._tilt = TiltFilter(_FOUND_GRAVITY if self.config.gravity == "ground" else _GIVEN_GRAVITY)
        self._stamp = 0.0
        self._step, self._step_seconds = np.eye(4), 1.0  # last motion, and its duration
        self._registration.clear()

    def step(self, points: Points, point_times: Floats | None, stamp: float) -> Pose:
        """Add one frame; return its pose.

        Args:
            points: (N, 3) body frame (x forward, z up), metres; rows with NaN are dropped.
            point_times: (N,) seconds of the points after ``stamp`` (negative before); None for a deskewed frame. Equal
                times deskew nothing; a point whose time is not finite stays.
            stamp: seconds, later than the stamp of the previous frame.

        Returns:
            ``T_odom_body`` (4, 4) at ``stamp``.

        Raises:
            CloudError: too few points in range, another shape, no ground that gives gravity, or a motion that no robot
                makes. RunError: the stamp is not finite or not later than the previous one. After either, skip the
                frame and continue.
        """
        finite, times = _validated(points, point_times, self.config)
        check_stamp(stamp)
        if self._pose is None:
            return self._begin(finite, stamp)
        seconds = stamp - self._stamp
        if seconds <= 0:
            raise RunError(
                f"stamp {stamp:.6f} does not come after {self._stamp:.6f}, the one before; sort the frames, or "
                "begin anew where a clock did"
            )
        if seconds > self.config.max_gap:
            self._restart()
        guess = self._local @ self._predicted_motion(seconds)
        if times is not None and (sweep := self._sweep(times)) is not None:
            finite = deskew(finite, times, sweep, 0, np.eye(4))
        around = self._surfaces(finite, guess) if self.config.keep_level else None
        if around is not None:  # the body shakes, so tilt the guess by the frame's own walls and ground
            R = self._T_odom_local[:3, :3]
            tilt = self._tilt.expected(around.seen(R @ guess[:3, :3]), _SHAKE)
            guess = pose_from(R.T @ upright(tilt) @ R @ guess[:3, :3], guess[:3, 3])
        local = self._registration.register(finite.astype(np.float64), guess)
        step = inverse(self._local) @ local
        self._check_motion(step, seconds)
        if seconds >= _MIN_MOTION_SECONDS:
            self._step, self._step_seconds = step, seconds
        self._local, self._stamp, self.points = orthonormal(local), stamp, finite
        before, self._pose = self._pose, orthonormal(self._T_odom_local @ self._local)
        if around is not None:
            shake = _SHAKE * math.sqrt(max(1.0, seconds / _SHAKE_SECONDS))
            since = Since(self._pose[:2, 2] - before[:2, 2], shake)
            self._level(around, float(np.linalg.norm(step[:3, 3])), since)
        return np.array(self._pose)

    def _begin(self, points: Points, stamp: float) -> Pose:
        """Determine gravity, and place the first frame."""
        if self.config.gravity == "ground":
            ground = find_ground(points)
            if isinstance(ground, str):
                raise CloudError(
                    f"no ground to take gravity from: {ground}; start where the ground is open, or give gravity "
                    "(--gravity level, or --gravity=X,Y,Z in the body frame)"
                )
            self.ground, up = ground, ground.up
        else:
            up = -down(self.config.gravity)
        start = pose_from(level_rotation(up), np.zeros(3))
        self._local = self._registration.register(points.astype(np.float64), start)
        self._pose, self._stamp, self.points = start, stamp, points
        if self.config.keep_level:
            self._tilt.update(self._surfaces(points, start).seen(start[:3, :3]), 0.0)
        return np.array(start)

    def _surfaces(self, points: Points, T_local_body: Pose) -> Surfaces:
        around = Surfaces.around(points, (self._T_odom_local @ T_local_body)[2, :3], self._ground)
        self._ground = around.ground or self._ground
        return around

    def _level(self, around: Surfaces, metres: float, since: Since) -> None:
        """Remove registration's tilt from the newest pose, and slowly rotate the odometry frame about it."""
        assert self._pose is not None
        R, here = self._pose[:3, :3], self._pose[:3, 3]
        tilt = upright(self._tilt.update(around.seen(R), metres, since))
        turn = upright(self._tilt.turn())
        self._T_odom_local = pose_from(turn, here - turn @ here) @ self._T_odom_local
        self._pose = orthonormal(pose_from(tilt @ turn @ R, here))

    def _predicted_motion(self, seconds: float) -> Pose:
        """Extrapolate the last motion (4, 4) to ``seconds``, which may be negative."""
        return interpolate(np.eye(4), self._step, seconds / self._step_seconds)

    def _sweep(self, times: Floats) -> Segment | None:
        """Predict the motion over times (N,), seconds after the stamp; None for equal times or another clock's."""
        finite = times[np.isfinite(times)]
        if not len(finite) or np.abs(finite).max() > _MAX_SWEEP_SECONDS or np.ptp(finite) < _MIN_SWEEP_SECONDS:
            return None
        ends = float(finite.min()), float(finite.max())
        stamps = np.array([round(1e9 * t) for t in ends], dtype=np.int64)
        return Segment(stamps, np.array([self._predicted_motion(t) for t in ends]))

    def _check_motion(self, step: Pose, seconds: float) -> None:
        """Refuse a motion that no robot makes; restart the local map, which contains the frame at a wrong place."""
        far, wide = float(np.linalg.norm(step[:3, 3])), rotation_angle(step)
        allowed = _SLACK + self.config.max_speed * seconds
        if is_pose(step) and far <= allowed and wide <= max(_SLACK_ANGLE, _MAX_TURN_RATE * seconds):
            return
        self._restart()
        raise CloudError(
            f"lidar odometry lost its way: {far:.1f} m and {np.degrees(wide):.0f} deg in {seconds:.2f} s; "
            "it goes on from the frame before"
        )

    def _restart(self) -> None:
        assert self._pose is not None
        self.restarts += 1
        self._local, self._T_odom_local = self._pose, np.eye(4)
        self._registration.clear()
        self._tilt.restart()
        self._step, self._step_seconds = np.eye(4), 1.0


def _validated(points: Points, times: Floats | None, config: LidarOdometryConfig) -> tuple[Points, Floats | None]:
    """Return a copy of the finite points (N, 3) float32, and their times (N,); CloudError as in ``step``."""
    rows = cloud_rows(points)
    at = None if times is None else to_array(times, np.float64, "times")
    if at is not None and at.shape != (len(rows),):
        raise CloudError(f"cloud has {len(rows)} points and times of shape {at.shape}; give one time per point")
    finite, mask = finite_rows(rows)
    if at is not None and mask is not None:
        at = at[mask]
    with np.errstate(over="ignore"):
        ranges = norms(finite)
    usable = int(((ranges > config.min_range) & (ranges < config.max_range)).sum())
    if usable < config.min_points:
        raise CloudError(
            f"cloud has {usable} of {len(rows)} points between {config.min_range:g} and {config.max_range:g} m; "
            f"lidar odometry needs {config.min_points}: is the sensor covered, or the cloud not in its frame?"
        )
    return finite, at
