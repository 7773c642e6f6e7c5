"""Paths: one pose of a place for all keyframes of a search."""

import numpy as np
import pytest
from trackers import observed

from coview_kernels import Move
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.background import estimate_background, observe_around, scatter
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.paths import Paths, look_back, smoothed

ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])  # map <- odometry


@pytest.fixture(scope="module")
def scans(world_drive):
    """Frames of the small world, with odometry in a frame of its own."""
    return [
        observed(world_drive.clouds[k], inverse(ODOM) @ world_drive.T_map_body[k], voxels=False) for k in (0, 2, 4, 6)
    ]


@pytest.fixture(scope="module")
def background(world_map, scans):
    rng = np.random.default_rng(5)
    poses = scans[-1].poses(ODOM[None]) + rng.uniform([-9, -9, 0, -3], [9, 9, 0, 3], (120, 4))
    seen = scans[-1].few.look_up(world_map.field, poses, Move.FAR)
    rows = np.column_stack([seen.shares, observe_around(world_map.field, scans[-1].few, seen.poses)])
    return estimate_background(rows, scatter(rows), rows)


def paths_of(world_map, scans, T):
    """Paths of places ``T_map_odom`` (P, 4, 4)."""
    newest = scans[-1].poses(T)
    here = scans[-1].few.look_up(world_map.field, newest, Move.NONE).shares
    here = np.column_stack([here, observe_around(world_map.field, scans[-1].few, newest)])
    observed, poses = look_back(world_map.field, scans[:-1], T)
    both = np.concatenate([observed, here[:, None]], axis=1), np.concatenate([poses, newest[:, None]], axis=1)
    return Paths.of(world_map.field, scans, both[1], both[0])


def beside(x, y, degrees, scan):
    """``T_map_odom`` that puts the robot beside its true place in the map, and turned."""
    pose = scan.poses(ODOM[None]) + np.array([x, y, 0.0, np.radians(degrees)])
    return scan.transforms(pose)


@pytest.mark.parametrize(("x", "y", "degrees"), [(0.0, 0.0, 0.0), (1.6, -1.2, 0.0), (-2.0, 1.0, 1.0)])
def test_place_moves_to_the_pose_that_all_keyframes_fit(world_map, scans, background, x, y, degrees):
    paths = paths_of(world_map, scans, beside(x, y, degrees, scans[-1]))
    found = paths.settled(background)
    gap = (found.poses - scans[-1].poses(ODOM[None]))[0]
    assert np.linalg.norm(gap[:2]) < 1.0  # a step of the shifts
    assert abs(gap[3]) < np.radians(1.5)


def test_ratio_of_a_place_is_a_mean_over_its_shifts(world_map, scans, background):
    """Less than at the best shift, by no more than if the others explained nothing."""
    found = paths_of(world_map, scans, ODOM[None]).settled(background)
    best = log_likelihood_ratios(found.observed, background)
    assert best[0] - np.log(3 * 25) <= found.ratios()[0] < best[0]
    half = np.arange(25)[None] % 2 == 0
    assert np.logaddexp(found.ratios(half), found.ratios(~half)) == pytest.approx(found.ratios())


def test_places_do_not_depend_on_each_other(world_map, scans, background):
    T = np.concatenate([beside(*start, scans[-1]) for start in ((1.0, 0.0, 0.0), (-6.0, 7.0, 90.0))])
    both = paths_of(world_map, scans, T).settled(background)
    for k in range(2):
        alone = paths_of(world_map, scans, T[[k]]).settled(background)
        np.testing.assert_allclose(alone.ratios()[0], both.ratios()[k])
        np.testing.assert_allclose(alone.poses[0], both.poses[k])


def test_path_that_is_not_moved_is_observed_at_its_poses(world_map, scans):
    paths = paths_of(world_map, scans, ODOM[None])
    each = [scan.many.look_up(world_map.field, paths.poses[:, k], Move.HEIGHT).shares for k, scan in enumerate(scans)]
    seen = paths.observe(np.zeros((1, 2, 4)), many=True)
    np.testing.assert_allclose(seen[0, 0, :7], np.mean(each, axis=0)[0], rtol=1e-5)
    np.testing.assert_array_equal(seen[0, 0], seen[0, 1])


def test_one_keyframe_has_its_pose_as_path(world_map, scans):
    paths = paths_of(world_map, scans[-1:], ODOM[None])
    np.testing.assert_allclose(paths.poses[:, 0], scans[-1].poses(ODOM[None]))


def test_earlier_keyframes_are_looked_up_oldest_first(world_map, scans):
    seen, poses = look_back(world_map.field, scans[:-1], ODOM[None])
    assert seen.shape[:2] == poses.shape[:2] == (1, 3)
    for k, scan in enumerate(scans[:-1]):
        np.testing.assert_allclose(poses[0, k], scan.poses(ODOM[None])[0], atol=0.6)


def test_scatter_is_averaged_and_drift_is_followed():
    rng = np.random.default_rng(2)
    bodies = np.column_stack([2.5 * np.arange(12), np.zeros((12, 2))])
    drift = np.zeros((200, 12, 4))
    drift[:, :, 0] = 0.05 * bodies[::-1, 0]  # 5 % of the distance
    noisy = drift + np.array([1.0, 1.0, 0.0, 0.0]) * rng.normal(0.0, 0.7, drift.shape)
    assert (smoothed(noisy, bodies) - drift)[:, :, 1].std() < 0.4 * 0.7
    assert np.abs((smoothed(drift, bodies) - drift)[:, :, 0]).max() < 0.3
    np.testing.assert_allclose(smoothed(drift[:, :1] + 1.0, bodies[:1]), drift[:, :1] + 1.0)
