"""Displacement check: a frame that lies on the map much less than the ones before it asks for a registration."""

from __future__ import annotations

import numpy as np
import pytest
from courtyard import courtyard, local_map
from small_world import boxes, scan

from coview_stream.geometry.transforms import boxplus, pose_from, rot_z, transform
from coview_stream.localization.registration.local_map import LocalMap, LocalMaps
from coview_stream.localization.tracking import slip as module
from coview_stream.localization.tracking.slip import DisplacementCheck, share_on_map

T_MAP_ODOM = pose_from(rot_z(0.7), [2.0, -1.0, 0.4])
ELSEWHERE = boxplus(T_MAP_ODOM, np.array([0.0, 0.0, 1.0, 4.3, -3.7, 0.0]))
HERE = np.array([0.0, 0.0, 1.7])


@pytest.fixture(scope="module")
def target() -> LocalMap:
    return local_map(*courtyard())


def yard(seed=0, noise=0.02):
    """A frame of the courtyard in the odometry frame."""
    points, rng = courtyard()[0], np.random.default_rng(seed)
    some = points[rng.permutation(len(points))[:4000]] + rng.normal(0.0, noise, (4000, 3))
    return transform(np.linalg.inv(T_MAP_ODOM), some).astype(np.float32)


def shares(target, T, count=5):
    return [share_on_map(yard(seed), HERE, T, target) for seed in range(count)]


def test_share_on_map_is_one_at_the_true_pose(target):
    assert min(shares(target, T_MAP_ODOM)) > 0.98


def test_share_on_map_falls_with_displacement(target):
    off = [np.mean(shares(target, boxplus(T_MAP_ODOM, np.array([0, 0, 0, x, 0.7 * x, 0.0])))) for x in (0.0, 0.6, 5.3)]
    assert off[0] > 1.2 * off[1]
    assert off[1] > off[2]
    assert off[2] < 0.5


def test_ground_and_far_points_are_ignored(target):
    """Both are as one likes; the points between are where the map has them."""
    frame = yard()
    height = transform(T_MAP_ODOM, frame)[:, 2]
    ground = frame[height < 0.1] + np.float32([0.0, 0.0, 0.3])
    far = frame[height > 1.5] + np.float32([200.0, 0.0, 0.0])
    mixed = np.concatenate([frame[height > 1.5], ground, far])
    assert share_on_map(mixed, HERE, T_MAP_ODOM, target) > 0.98


def test_too_few_points_give_no_share(target):
    frame = yard()
    assert share_on_map(frame[:0], HERE, T_MAP_ODOM, target) is None
    assert share_on_map(frame[:50], HERE, T_MAP_ODOM, target) is None
    flat = frame[transform(T_MAP_ODOM, frame)[:, 2] < 0.1]
    assert len(flat) > 500
    assert share_on_map(flat, HERE, T_MAP_ODOM, target) is None
    check = used_to(target)
    usual = check.usual
    check.learn(flat, HERE, T_MAP_ODOM, target)
    assert check.usual == usual
    assert not check.is_displaced(flat, HERE, ELSEWHERE, target)


def used_to(target, frames=5):
    """A check that has seen the yard a few times."""
    check = DisplacementCheck()
    for k in range(frames):
        check.learn(yard(100 + k), HERE, T_MAP_ODOM, target)
    return check


def test_displaced_frame_is_detected_and_not_learned(target):
    check = used_to(target)
    usual = check.usual
    assert not any(check.is_displaced(yard(k), HERE, T_MAP_ODOM, target) for k in range(5))
    assert all(check.is_displaced(yard(k), HERE, ELSEWHERE, target) for k in range(5, 30))
    assert check.usual == usual
    assert not check.is_displaced(yard(40), HERE, T_MAP_ODOM, target)


def test_no_displacement_without_a_baseline(target):
    check = DisplacementCheck()
    assert not check.is_displaced(yard(), HERE, ELSEWHERE, target)
    assert check.usual is None


def cluttered(share, seed):
    """A frame a share of which is not on the map: parked cars, people, leaves."""
    frame, rng = yard(seed), np.random.default_rng(seed)
    height = transform(T_MAP_ODOM, frame)[:, 2]
    stray = (rng.random(len(frame)) < share) & (height > 0.5)
    frame[stray] = rng.uniform([-12.0, -12.0, 8.0], [12.0, 12.0, 20.0], (int(stray.sum()), 3))
    return frame


def test_slow_change_updates_baseline_and_sudden_change_is_detected(target):
    check, alarms = DisplacementCheck(), []
    for k, share in enumerate(np.linspace(0.0, 0.6, 40)):
        frame = cluttered(share, k)
        alarms.append(check.is_displaced(frame, HERE, T_MAP_ODOM, target))
        check.learn(frame, HERE, T_MAP_ODOM, target)
    assert not any(alarms)
    assert check.usual < 0.6
    assert used_to(target).is_displaced(cluttered(0.6, 9), HERE, T_MAP_ODOM, target)


def test_one_badly_fitting_frame_does_not_become_the_baseline(target):
    """The registration may have been believed by a hair."""
    check = used_to(target)
    before = check.usual
    check.learn(cluttered(0.6, 1), HERE, T_MAP_ODOM, target)
    assert before - 0.3 < check.usual < before
    assert check.is_displaced(cluttered(0.6, 2), HERE, T_MAP_ODOM, target)


def test_baseline_can_be_cleared(target):
    check = used_to(target)
    check.clear()
    assert check.usual is None
    assert not check.is_displaced(yard(), HERE, ELSEWHERE, target)


def test_scan_of_another_world_is_detected_as_displaced(world_map, world_drive, scene):
    T, cloud = world_drive.T_map_body[4], world_drive.clouds[4]
    around = LocalMaps(world_map, 50.0).around(T[:3, 3])
    check, other = DisplacementCheck(), scan(boxes(seed=77), T)

    def arguments(cloud):
        level = transform(pose_from(T[:3, :3], np.zeros(3)), cloud).astype(np.float32)
        return level, np.zeros(3), pose_from(np.eye(3), T[:3, 3]), around

    check.learn(*arguments(cloud))
    assert check.usual > 0.9
    assert check.is_displaced(*arguments(other))
    assert not check.is_displaced(*arguments(scan(scene, T, 5)))


def test_displacement_check_samples_a_bounded_number_of_points(target, monkeypatch):
    """It has half a millisecond at every frame, with any lidar."""
    asked = []
    inner = module.kernels.nearest
    monkeypatch.setattr(
        module.kernels, "nearest", lambda grid, points, reach: asked.append(len(points)) or inner(grid, points, reach)
    )
    share_on_map(np.concatenate([yard(k) for k in range(10)]), HERE, T_MAP_ODOM, target)
    assert asked == [module._POINTS]
