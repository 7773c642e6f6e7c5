"""Keyframes every few metres, with all points since, in fixed memory; and the check that frames continue each other."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from small_world import ODOM_FAR

from coview_stream.config import KeyframeConfig
from coview_stream.geometry.transforms import pose_from, rot_z, transform
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.registration.clouds import voxelized
from coview_stream.localization.search.keyframes import _PATIENCE, KeyframeBuffer, OdometryCheck

CONFIG = KeyframeConfig(distance=2.0, capacity=4, voxel=0.25)


def at(x, yaw=0.0):
    return pose_from(rot_z(yaw), [x, 0.0, 1.5])


def cloud(seed, count=200):
    return np.random.default_rng(seed).uniform([2, -9, -1], [9, 9, 3], (count, 3)).astype(np.float32)


def add(buffer, points, T_odom_body, stamp):
    return buffer.add(RawScan(voxelized(points, T_odom_body, buffer.config), T_odom_body), stamp)


def points_of(keyframe):
    return keyframe.scan.levelled(Calibration())


def test_keyframe_every_configured_distance():
    buffer = KeyframeBuffer(CONFIG)
    made = [add(buffer, cloud(k), at(0.5 * k), 0.1 * k) is not None for k in range(10)]
    assert np.flatnonzero(made).tolist() == [0, 4, 8]
    assert [k.stamp for k in buffer.keyframes] == pytest.approx([0.0, 0.4, 0.8])


def test_keyframe_points_are_in_the_odometry_frame_beyond_min_range():
    buffer = KeyframeBuffer(KeyframeConfig(range_min=1.0))
    keyframe = add(buffer, np.array([[3.0, 1.0, 0.5], [0.3, 0.0, 0.0]], np.float32), at(10.0, np.pi / 2), 0.0)
    np.testing.assert_allclose(points_of(keyframe), [[9.0, 3.0, 2.0]], atol=1e-5)
    np.testing.assert_allclose(keyframe.position, [10.0, 0.0, 1.5])


def test_points_between_keyframes_go_into_the_next_one():
    buffer = KeyframeBuffer(CONFIG)
    add(buffer, cloud(0), at(0.0), 0.0)
    assert add(buffer, np.array([[5.0, 5, 5]], np.float32), at(1.0), 0.1) is None
    waiting = buffer.recent(1)
    keyframe = add(buffer, np.array([[-5.0, 5, 5]], np.float32), at(2.5), 0.2)
    for points in (points_of(keyframe), waiting):
        assert np.abs(points - [6.0, 5.0, 6.5]).sum(axis=1).min() < 1e-4
    assert len(points_of(keyframe)) == 2


def test_newest_points_come_first_so_that_thinning_keeps_them():
    """Odometry has drifted by a centimetre at every frame: the newest sees the corner where it is from its own pose."""
    buffer, drifted = KeyframeBuffer(CONFIG), [9.01, 9.02, 9.03]
    for x, metres in zip(drifted, (0.0, 1.0, 2.5), strict=True):
        buffer.add(RawScan(np.array([[x, 0.1, 0.1]], np.float32), at(metres)), metres)
    assert len(buffer.keyframes) == 2
    np.testing.assert_allclose(points_of(buffer.keyframes[-1])[:, 0], drifted[-1:])  # of two frames in one voxel
    np.testing.assert_allclose(buffer.recent(2)[:, 0], [9.03, 9.01])
    buffer.add(RawScan(np.array([[9.04, 0.1, 0.1]], np.float32), at(3.0)), 3.0)  # no keyframe yet
    np.testing.assert_allclose(buffer.recent(2)[:, 0], [9.04, 9.03, 9.01])


def test_keyframe_buffer_keeps_its_capacity():
    buffer = KeyframeBuffer(CONFIG)
    for k in range(9):
        add(buffer, cloud(k), at(2.0 * k), float(k))
    assert [k.stamp for k in buffer.keyframes] == [5.0, 6.0, 7.0, 8.0]
    assert len(buffer.recent(2)) == sum(len(points_of(k)) for k in list(buffer.keyframes)[-2:])


def test_standing_still_uses_bounded_memory():
    """From 200,000 points on, frames are one."""
    buffer = KeyframeBuffer(CONFIG)
    for k in range(60):
        add(buffer, cloud(k % 3, 10_000), at(0.0), float(k))
    assert len(buffer.recent(1)) < 220_000 < 60 * len(voxelized(cloud(0, 10_000), at(0.0), CONFIG))


def test_virtual_scan_gathers_points_around_keyframe():
    buffer = KeyframeBuffer(CONFIG)
    for k in range(4):
        add(buffer, cloud(k), at(5.0 * k), float(k))
    centre = np.array([15.0, 0.0, 1.5])
    scan = buffer.virtual_scan(centre, 8.0, 0.5)
    everything = np.concatenate([points_of(k) for k in buffer.keyframes])
    near = everything[np.hypot(*(everything[:, :2] - centre[:2]).T) < 8.0]
    voxels = np.unique(np.floor(near / 0.5), axis=0)
    assert len(scan) == len(voxels)
    assert np.hypot(*(scan[:, :2] - centre[:2]).T).max() < 8.0


def test_virtual_scan_is_of_the_newest_keyframes_in_parts():
    config = KeyframeConfig(distance=2.0, capacity=6, voxel=0.25)  # three parts of two keyframes each
    buffer = KeyframeBuffer(config)
    centre, kept = np.zeros(3), []
    for k in range(9):
        corner = np.array([[0.125, 0.125 + 2.0 * k, 0.125 + k % 2]], np.float32)
        buffer.add(RawScan(corner, at(2.0 * k)), float(k))
        kept.append({int(y // 2) for y in buffer.virtual_scan(centre, 99.0, 0.25)[:, 1]})
    assert kept[:6] == [set(range(k + 1)) for k in range(6)]
    assert kept[6:] == [{2, 3, 4, 5, 6}, {2, 3, 4, 5, 6, 7}, {4, 5, 6, 7, 8}]


def test_points_beyond_reach_are_dropped():
    buffer = KeyframeBuffer(CONFIG, reach=10.0)
    behind = np.array([[-8.0, 0.0, 0.0], [1.0, 0.0, 0.0]], np.float32)
    buffer.add(RawScan(behind, at(0.0)), 0.0)
    buffer.add(RawScan(np.array([[6.0, 0.0, 0.0]], np.float32), at(5.0)), 1.0)
    scan = buffer.virtual_scan(np.array([5.0, 0.0, 1.5]), 99.0, 0.25)
    np.testing.assert_array_equal(np.sort(scan[:, 0]), [1.0, 6.0])
    np.testing.assert_array_equal(buffer.recent(2), [[6.0, 0.0, 0.0], *behind])


def test_clear_drops_all_keyframes():
    buffer = KeyframeBuffer(CONFIG)
    add(buffer, cloud(0), at(0.0), 0.0)
    add(buffer, cloud(1), at(1.0), 0.1)
    buffer.clear()
    assert len(buffer.recent(5)) == 0
    # the next frame is a keyframe wherever it is, and alone
    keyframe = add(buffer, cloud(2), at(1.0), 0.2)
    assert len(buffer.virtual_scan(np.zeros(3), 99.0, 0.25)) == len(points_of(keyframe))


def test_keyframes_are_levelled_by_the_newest_calibration():
    """Whatever was known when a frame was taken: read again, all lie as if it had been known from the beginning."""
    known = [Calibration(pitch=np.radians(pitch)) for pitch in (0.0, 0.7, 2.6)]
    leaning, straight = (KeyframeBuffer(KeyframeConfig(distance=1.0)) for _ in range(2))
    began_anew = []
    for k, present in enumerate(known):
        T, ahead, points = at(1.5 * k, 0.3 * k), at(1.5 * k + 0.4, 0.3 * k), cloud(k, 300)
        for buffer, level in ((leaning, present), (straight, known[-1])):
            scans = [RawScan(transform(pose, level.level(points)), pose, level) for pose in (T, ahead)]
            began_anew.append(buffer.add(scans[0], float(k)).begins_anew)
            assert buffer.add(scans[1], k + 0.5) is None
    assert began_anew == [False] * 4 + [True, False]
    apart = cKDTree(straight.recent(3)).query(leaning.recent(3))[0]
    assert np.median(apart) < 0.01
    everything = [buffer.virtual_scan(np.zeros(3), 99.0, 0.25) for buffer in (leaning, straight)]
    assert np.median(cKDTree(everything[1]).query(everything[0])[0]) < 0.01
    assert len(leaning.recent(1)) == pytest.approx(len(straight.recent(1)), rel=0.1)


def test_earlier_keyframes_are_read_as_they_were_by_the_newest_calibration():
    """Their submaps reach no further than they did then, and all are levelled as if the lean had been known."""
    known = [Calibration(pitch=np.radians(pitch)) for pitch in (0.0, 0.0, 2.6)]
    leaning, straight = (KeyframeBuffer(KeyframeConfig(distance=1.0)) for _ in range(2))
    then, newest = [], cloud(0)
    for k, present in enumerate(known):
        newest[:] = cloud(k)  # a caller may write all clouds into one array
        for buffer, level in ((leaning, present), (straight, known[-1])):
            points = transform(at(1.5 * k), level.level(cloud(k, 300)))
            keyframe = buffer.add(RawScan(points, at(1.5 * k), level), float(k), newest)
        then.append(straight.recent(2))
    assert keyframe.begins_anew is False
    earlier = leaning.at_earlier(2)
    assert [each.stamp for each, _ in earlier] == [0.0, 1.0]
    for (each, submap), expected, k in zip(earlier, then, range(2), strict=False):
        np.testing.assert_array_equal(each.frame, cloud(k))
        assert len(submap) == pytest.approx(len(expected), rel=0.1)
        assert np.median(cKDTree(expected).query(submap)[0]) < 0.01


def frames_of(drive):
    """Points and position of every frame in the odometry frame, about its origin."""
    for cloud, T in zip(drive.clouds, drive.T_map_body, strict=True):
        T_odom_body = pose_from(ODOM_FAR[:3, :3], np.zeros(3)) @ T
        yield transform(T_odom_body, cloud[::2]).astype(np.float32), T_odom_body[:3, 3]


@pytest.fixture
def frames(slow_drive):
    return list(frames_of(slow_drive))


def test_continuous_drive_does_not_contradict_odometry(frames, world_drive):
    check = OdometryCheck()
    assert not any(check.contradicts(*frame) for frame in frames)
    wide = OdometryCheck()
    assert not any(wide.contradicts(*frame) for frame in frames_of(world_drive))


@pytest.mark.parametrize("cleared", [False, True])
@pytest.mark.parametrize("what", ["robot", "odometry"])
def test_moved_robot_or_jumped_odometry_is_reported_once_unless_cleared(frames, elsewhere, what, cleared):
    check = OdometryCheck()
    for frame in frames[:10]:
        check.contradicts(*frame)
    if what == "robot":
        other, here = list(frames_of(elsewhere))[2][0], frames[9][1]
        # it feels no motion: the other place's points lie around where it was
        moved = other - other.mean(axis=0) + frames[9][0].mean(axis=0) + [25.0, 9.0, 3.0]
        after = [(moved.astype(np.float32), here)] * 6
    else:
        jump = np.float32([40.0, 0.0, 0.0])
        after = [(points + jump, place + jump) for points, place in frames[10:16]]
    if cleared:
        check.clear()
    alarms = [check.contradicts(*frame) for frame in after]
    assert alarms.count(True) == (not cleared)
    assert alarms[_PATIENCE - 1] or cleared


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
