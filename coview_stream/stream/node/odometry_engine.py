"""Engine that makes odometry of the frames of robots that send none."""

from __future__ import annotations

import time
from collections.abc import Callable

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.odometry.lidar_odometry import KissRegistration, LidarOdometry, ScanRegistration
from coview_stream.stream.node.jobs import Job, OdometryJob, OdometryResult


class OdometryEngine:
    """One :class:`LidarOdometry` per robot.

    Args:
        registration: made for each robot; kiss-icp's unless a test has another.

    Raises:
        DependencyError: kiss-icp is missing, or cannot be loaded; the message says how to get it.
    """

    kernels: tuple[str, ...] = ()
    later_kernels: tuple[str, ...] = ()

    def __init__(self, registration: Callable[[LidarOdometryConfig], ScanRegistration] = KissRegistration) -> None:
        self._registration = registration
        self._robots: dict[str, tuple[int, LidarOdometry]] = {}
        self._trajectories: dict[str, tuple[int, int]] = {}  # epoch and restarts at the newest pose
        registration(LidarOdometryConfig())  # a missing library shows now rather than at the first frame

    def run(self, job: Job) -> OdometryResult:
        """Return the odometry of one frame.

        Raises:
            CloudError, RunError: it cannot be placed; the next one may be.
        """
        if not isinstance(job, OdometryJob):
            raise TypeError(f"{type(job).__name__}: the odometry engine makes odometry")
        begin = time.perf_counter()
        lidar = self._lidar(job)
        pose = lidar.step(job.points, job.times, job.stamp_ns * 1e-9)
        trajectory = job.epoch, lidar.restarts
        restarted = self._trajectories.get(job.robot) != trajectory
        self._trajectories[job.robot] = trajectory
        points = None if job.times is None else lidar.points
        return OdometryResult(pose, points, restarted, time.perf_counter() - begin)

    def forget(self, robot: str) -> None:
        """Drop a robot's odometry."""
        self._robots.pop(robot, None)
        self._trajectories.pop(robot, None)

    def prepare(self) -> None:
        """Do nothing: local maps grow with the frames."""

    def prepare_later(self) -> None:
        """Do nothing."""

    def _lidar(self, job: OdometryJob) -> LidarOdometry:
        """Return the robot's lidar odometry, which begins again with a new epoch."""
        epoch, lidar = self._robots.get(job.robot, (None, None))
        if lidar is None:
            lidar = LidarOdometry(job.config, self._registration(job.config))
        elif epoch != job.epoch:
            lidar.reset()
        self._robots[job.robot] = job.epoch, lidar
        return lidar
