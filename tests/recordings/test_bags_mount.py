"""Recordings of a lidar that is turned against the body."""

from __future__ import annotations

import numpy as np
from bag_files import cloud, odometry, write_bag

from coview_stream.config.mount import parse_mount
from coview_stream.geometry.transforms import inverse, pose_from, transform
from coview_stream.recordings.open_run import open_run

MOUNT = parse_mount("180,10,90,0.3,-0.2,0.5")


def turned(points):
    return transform(inverse(MOUNT.T_body_sensor), points.astype(np.float64)).astype(np.float32)


def test_sweeps_of_a_recording_are_turned_before_they_are_deskewed(tmp_path):
    points = np.random.default_rng(0).uniform(-20, 20, (200, 3)).astype(np.float32)
    times = np.linspace(-0.1, 0.0, 200).astype(np.float32)
    start, tenth = 1_700_000_000_000_000_000, 100_000_000
    poses = [pose_from(np.eye(3), [k, 0.0, 0.0]) for k in range(4)]

    def bag(name, seen):
        return write_bag(
            tmp_path / name,
            {
                "/points": [cloud(start + k * tenth, seen, times) for k in (1, 2)],
                "/odom": [odometry(start + k * tenth, poses[k]) for k in range(4)],
            },
        )

    body = open_run(bag("body", points))
    sensor = open_run(bag("sensor", turned(points)), mount=MOUNT)
    assert np.abs(body.read(0).points - points).max() > 0.5  # there is something to deskew
    for here, there in zip(body, sensor, strict=True):
        assert np.allclose(here.points, there.points, atol=1e-4)
