"""Scores of lidar odometry: what shakes, what leans, and what is another frame only."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy.lidar_odometry import scored
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z


@pytest.fixture
def truth():
    return np.array([pose_from(rot_z(0.05 * k), [0.5 * k, 0.0, 1.0]) for k in range(40)])


def test_another_heading_and_origin_are_no_error(truth):
    scores = scored(pose_from(rot_z(1.0), [3.0, 4.0, 5.0]) @ truth, truth)
    assert scores.frames == 40
    assert max(scores.tilt, scores.yaw, scores.step, scores.lean, scores.most_lean) < 1e-6


def test_leaning_frame_leans_and_does_not_shake(truth):
    scores = scored(pose_from(exp_so3([np.radians(2.0), 0.0, 0.0]), np.zeros(3)) @ truth, truth)
    assert scores.lean == pytest.approx(2.0)
    assert scores.tilt < 1e-6


def test_frames_that_shake_in_pitch_shake_in_nothing_else(truth):
    shaken = truth.copy()
    shaken[1::2, :3, :3] = shaken[1::2, :3, :3] @ exp_so3([0.0, np.radians(1.0), 0.0])
    scores = scored(shaken, truth)
    assert scores.tilt == pytest.approx(np.sqrt(0.5), abs=0.01)  # of roll, none, and of pitch
    assert scores.yaw < 0.06
    assert scores.lean == pytest.approx(0.5, abs=0.01)
