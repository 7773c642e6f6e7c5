"""Odometry check: frames that continue each other, and a robot that is suddenly elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import ODOM_FAR

from coview_stream.geometry.transforms import pose_from, transform
from coview_stream.localization.search.keyframes import _PATIENCE, OdometryCheck

T_LOCAL = pose_from(ODOM_FAR[:3, :3], np.zeros(3))


def frames_of(drive, T_odom_map=T_LOCAL):
    """Points and position of every frame in the odometry frame."""
    for cloud, T in zip(drive.clouds, drive.T_map_body, strict=True):
        T_odom_body = T_odom_map @ T
        yield transform(T_odom_body, cloud[::2]).astype(np.float32), T_odom_body[:3, 3]


@pytest.fixture
def frames(slow_drive):
    return list(frames_of(slow_drive))


def test_continuous_drive_does_not_contradict_odometry(frames, world_drive):
    check = OdometryCheck()
    assert not any(check.contradicts(*frame) for frame in frames)
    wide = OdometryCheck()
    assert not any(wide.contradicts(*frame) for frame in frames_of(world_drive))


def test_relocated_robot_is_reported_once_after_a_few_frames(frames, elsewhere):
    check = OdometryCheck()
    for frame in frames[:10]:
        check.contradicts(*frame)
    other, _ = list(frames_of(elsewhere))[2]
    here = frames[9][1]
    # it feels no motion: the other place's points lie around where it was
    moved = (other - other.mean(axis=0) + frames[9][0].mean(axis=0) + [25.0, 9.0, 3.0]).astype(np.float32)
    told = [check.contradicts(moved, here) for _ in range(6)]
    assert told == [k == _PATIENCE - 1 for k in range(6)]


def test_single_deviating_frame_is_ignored(frames):
    check = OdometryCheck()
    rng = np.random.default_rng(0)
    dust = rng.uniform(-3.0, 3.0, (4000, 3)).astype(np.float32) + np.float32([0.0, 0.0, 20.0])
    for k, frame in enumerate(frames):
        assert not check.contradicts(*frame)
        if k % 3 == 0:
            assert not check.contradicts(dust, frame[1])


def test_too_few_points_are_not_compared(frames):
    check = OdometryCheck()
    assert not check.contradicts(frames[0][0][:5], frames[0][1])
    for frame in frames[:3]:
        check.contradicts(*frame)
    far = frames[0][0][:100] + np.float32(500.0)
    assert not any(check.contradicts(far, frames[2][1]) for _ in range(9))


def test_odometry_jump_is_reported_and_can_be_cleared(frames):
    jump = np.float32([40.0, 0.0, 0.0])
    jumped = [(points + jump, place + jump) for points, place in frames]
    check = OdometryCheck()
    for frame in frames[:10]:
        check.contradicts(*frame)
    assert [check.contradicts(*frame) for frame in jumped[10:16]].count(True) == 1
    cleared = OdometryCheck()
    for frame in frames[:10]:
        cleared.contradicts(*frame)
    cleared.clear()
    assert not any(cleared.contradicts(*frame) for frame in jumped[10:16])
