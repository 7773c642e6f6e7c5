"""The engine that makes odometry of the frames of robots that send none."""

from __future__ import annotations

import time
from collections.abc import Callable

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.odometry.kiss_icp import KissRegistration, Registration
from coview_stream.odometry.lidar_odometry import LidarOdometry
from coview_stream.stream.node.jobs import Job, OdometryJob, OdometryResult


class OdometryEngine:
    """One :class:`LidarOdometry` per robot.

    Args:
        registration: made for each robot; kiss-icp's unless a test has another.

    Raises:
        DependencyError: kiss-icp is missing, or cannot be loaded; the message says how to get it.
    """

    kernels: tuple[str, ...] = ()

    def __init__(
        self, registration: Callable[[LidarOdometryConfig], Registration] = KissRegistration
    ) -> None:
        self._registration = registration
        self._robots: dict[str, tuple[int, LidarOdometry]] = {}
        self._placed: dict[str, tuple[int, int]] = {}  # generation and restarts at the newest pose
        registration(LidarOdometryConfig())  # whether there is one shows now rather than at the first frame

    def run(self, job: Job) -> OdometryResult:
        """Place one frame.

        Raises:
            CloudError, RunError: it cannot be placed; the next one may be.
        """
        if not isinstance(job, OdometryJob):
            raise TypeError(f"{type(job).__name__} is no sweep")
        begin = time.perf_counter()
        lidar = self._lidar(job)
        pose = lidar.step(job.points, job.times, job.stamp_ns * 1e-9)
        now = job.generation, lidar.restarts
        begun = self._placed.get(job.robot) != now
        self._placed[job.robot] = now
        points = None if job.times is None else lidar.points
        return OdometryResult(pose, points, begun, time.perf_counter() - begin)

    def forget(self, robot: str) -> None:
        """Drop a robot's odometry."""
        self._robots.pop(robot, None)
        self._placed.pop(robot, None)

    def prepare(self) -> None:
        """Nothing: local maps grow with the frames."""

    def _lidar(self, job: OdometryJob) -> LidarOdometry:
        generation, lidar = self._robots.get(job.robot, (None, None))
        if lidar is None:
            lidar = LidarOdometry(job.config, self._registration(job.config))
        elif generation != job.generation:
            lidar.reset()
        self._robots[job.robot] = job.generation, lidar
        return lidar
