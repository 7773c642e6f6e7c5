"""Recordings without odometry: their clouds make it, and are deskewed by it."""

from __future__ import annotations

import numpy as np
import pytest
from bag_files import cloud, odometry, write_bag

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import RunError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.odometry.lidar_odometry import LidarOdometry
from coview_stream.recordings.open_run import open_run

START = 1_700_000_000_000_000_000
STEP = pose_from(rot_z(0.05), [0.6, 0.0, 0.0])  # in 0.1 s
STAMPS = [START + k * 100_000_000 for k in range(6)]
WORLD = np.random.default_rng(5).uniform(-30, 30, (400, 3))


class Steady:
    """A registration that knows how the robot drives."""

    def __init__(self):
        self.count = 0

    def register(self, points, guess):
        self.count += 1
        return np.linalg.matrix_power(STEP, self.count - 1)

    def clear(self):
        pass


def lidar():
    return LidarOdometry(LidarOdometryConfig(gravity="level", keep_level=False), Steady())


def sweep(k):
    """Each point as seen at its own time, up to 0.1 s before the stamp."""
    times = np.linspace(-0.1, 0.0, len(WORLD))
    before, here = (np.linalg.matrix_power(STEP, n)[:3, 3] for n in (k - 1, k))
    points = np.empty_like(WORLD)
    for i, share in enumerate(times / 0.1 + 1.0):
        T = pose_from(rot_z(0.05 * (k - 1 + share)), (1 - share) * before + share * here)
        points[i] = transform(inverse(T), WORLD[i : i + 1])[0]
    return cloud(STAMPS[k], points.astype(np.float32), times.astype(np.float32))


def test_bag_without_odometry_gets_lidar_odometry_and_deskewed_clouds(tmp_path):
    bag = write_bag(tmp_path / "bag", {"/points": [sweep(k) for k in range(6)]})
    run = open_run(bag, "kiss-icp", lidar=lidar())
    assert np.allclose(run.stamps, np.array(STAMPS) / 1e9)
    for k, frame in enumerate(run):
        assert np.allclose(frame.T_odom_body, np.linalg.matrix_power(STEP, k))
        if k:
            truth = transform(inverse(frame.T_odom_body), WORLD)
            assert np.abs(frame.points - truth).max() < 0.02


def test_odometry_topic_is_ignored_with_lidar_odometry(tmp_path):
    elsewhere = [odometry(ns, pose_from(np.eye(3), [500.0, 0, 0])) for ns in STAMPS]
    bag = write_bag(tmp_path / "bag", {"/points": [sweep(k) for k in range(6)], "/odom": elsewhere})
    assert np.abs(open_run(bag, "kiss-icp", lidar=lidar()).poses[:, :3, 3]).max() < 10
    with pytest.raises(RunError, match="odometry-topic"):
        open_run(bag, "kiss-icp", odometry_topic="/odom", lidar=lidar())


def test_frames_of_covered_sensor_are_skipped(tmp_path):
    dark = cloud(STAMPS[5], np.full((50, 3), 0.1, np.float32))
    bag = write_bag(tmp_path / "bag", {"/points": [*(sweep(k) for k in range(5)), dark]})
    run = open_run(bag, "kiss-icp", lidar=lidar())
    assert len(run) == 5
    assert "could not place 1 of 6 frames" in run.notes[0]
