"""Planted poses are recovered among many wrong pairs, and nothing is made of nothing."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.config.search import LearnedMatchConfig
from coview_stream.geometry.transforms import wrap_angle
from coview_stream.localization.search.learned.consistent_pairs import consistency_graph, maximum_clique
from coview_stream.localization.search.learned.keypoint_registration import fit_rigid_2d, refine_by_keypoints
from coview_stream.localization.search.learned.keypoints import Keypoints

CONFIG = LearnedMatchConfig()


def rms(found):
    return np.sqrt(np.mean(found.residuals**2))


def turn(yaw):
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def paired(rng, count, share, noise=0.3):
    """Pairs of points of which ``share`` are right; the pose (x, y, yaw), and which are."""
    here = rng.uniform(-30, 30, (count, 2))
    pose = (*rng.uniform(-500, 500, 2), rng.uniform(-np.pi, np.pi))
    right = np.arange(count) < round(share * count)
    there = here @ turn(pose[2]).T + rng.normal(0, noise, here.shape)
    there[~right] = rng.uniform(-30, 30, ((~right).sum(), 2))
    return here, there + pose[:2], pose, right


@pytest.mark.parametrize(("count", "share"), [(200, 0.1), (200, 0.2), (300, 0.05), (400, 0.05), (400, 0.2)])
def test_planted_pose_is_recovered_among_wrong_pairs(count, share):
    for seed in range(3):
        here, there, pose, right = paired(np.random.default_rng(seed), count, share)
        clique = maximum_clique(consistency_graph(here, there, CONFIG), CONFIG.nodes)
        chosen = clique.members
        assert clique.exact
        assert right[chosen].mean() >= 0.9
        assert right[chosen].sum() >= 0.7 * right.sum()
        found = fit_rigid_2d(here[chosen], there[chosen])
        assert np.hypot(found.x - pose[0], found.y - pose[1]) < 0.3
        assert abs(wrap_angle(found.yaw - pose[2])) < np.radians(1.0)
        assert rms(found) < 0.8


def test_pairwise_consistency_matches_definition():
    here = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 1.5], [0.0, 20.0]])
    there = np.array([[5.0, 5.0], [5.0, 15.5], [3.0, 9.0], [5.0, 30.0]])
    weights = consistency_graph(here, there, CONFIG)
    assert weights.dtype == np.float32
    np.testing.assert_array_equal(weights, weights.T)
    assert not weights.diagonal().any()
    assert weights[0, 1] == pytest.approx(np.exp(-(0.5**2) / (2 * CONFIG.spread**2)), rel=1e-5)
    assert weights[0, 2] == 0  # too close in the scan
    assert weights[0, 3] == 0  # 20 m against 25 m
    close = np.array([[0.0, 0.0], [0.0, 2.5]]), np.array([[0.0, 0.0], [1.9, 0.0]])
    assert not consistency_graph(*close, CONFIG).any()  # too close in the map
    assert not consistency_graph(*close[::-1], CONFIG).any()  # in the scan
    assert consistency_graph(here[:0], there[:0], CONFIG).shape == (0, 0)
    with pytest.raises(ValueError, match="pairs of points"):
        consistency_graph(here, there[1:], CONFIG)


def test_rigid_fit_is_exact_without_noise_and_follows_weights():
    rng = np.random.default_rng(0)
    here = rng.uniform(-20, 20, (30, 2))
    there = here @ turn(-2.5).T + (700.0, -90.0)
    found = fit_rigid_2d(here, there)
    assert (found.x, found.y, found.yaw) == pytest.approx((700.0, -90.0, -2.5))
    assert found.residuals.max() < 1e-9
    there[:5] += 30.0
    weights = np.ones(30)
    weights[:5] = 0.0
    apart = fit_rigid_2d(here, there, weights)
    assert (apart.x, apart.y, apart.yaw) == pytest.approx((700.0, -90.0, -2.5))
    np.testing.assert_allclose(apart.residuals[:5], np.hypot(30, 30))
    assert rms(fit_rigid_2d(here, there)) > 5.0
    two = fit_rigid_2d(here[:2], here[:2] + 1.0)
    assert (two.x, two.y, two.yaw) == pytest.approx((1.0, 1.0, 0.0))


def test_rigid_fit_of_too_few_pairs_is_refused():
    points = np.zeros((3, 2))
    for wrong in (
        lambda: fit_rigid_2d(points[:1], points[:1]),
        lambda: fit_rigid_2d(points, points[:2]),
        lambda: fit_rigid_2d(points, points, np.array([1.0, 0.0, 0.0])),
        lambda: fit_rigid_2d(points, points, np.array([1.0, 1.0, -1.0])),
    ):
        with pytest.raises(ValueError, match=r"points|weights"):
            wrong()


def views(rng, pose, shared=40, own=160, alike=0.35, noise=0.3):
    """A query's and a map's keypoints: ``shared`` points with similar descriptors, ``own`` of each view alone."""

    def unit(values):
        return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)

    here = rng.uniform(-20, 20, (shared + own, 2))
    there = rng.uniform(-60, 60, (shared + 3 * own, 2)) + pose[:2]
    there[:shared] = here[:shared] @ turn(pose[2]).T + pose[:2] + rng.normal(0, noise, (shared, 2))
    one, other = unit(rng.normal(size=(len(here), 32))), unit(rng.normal(size=(len(there), 32)))
    other[:shared] = unit(one[:shared] + alike * rng.normal(size=(shared, 32)))
    query = Keypoints(here, one, np.full(len(here), 0.5, np.float32))
    return query, Keypoints(there, other, np.full(len(there), 0.5, np.float32))


@pytest.mark.parametrize("seed", range(4))
def test_rough_place_is_refined_to_a_pose(seed):
    rng = np.random.default_rng(seed)
    pose = (*rng.uniform(-300, 300, 2), rng.uniform(-np.pi, np.pi))
    query, known = views(rng, pose)
    start = (pose[0] + 3.0, pose[1] - 2.0, pose[2] + 0.15)
    found = refine_by_keypoints(query, known, start)
    assert found is not None
    assert np.hypot(found.x - pose[0], found.y - pose[1]) < 0.25
    assert abs(wrap_angle(found.yaw - pose[2])) < np.radians(1.0)
    assert len(found.residuals) >= 20
    assert rms(found) < 0.7
    again = refine_by_keypoints(query, known, start)
    assert (again.x, again.y, again.yaw) == (found.x, found.y, found.yaw)


@pytest.mark.parametrize("off", [(9.0, 0.0, 0.0), (0.0, 0.0, 0.6), (0.0, 0.0, np.pi)])
def test_pose_too_far_from_start_is_discarded(off):
    pose = (10.0, 20.0, 0.5)
    query, known = views(np.random.default_rng(1), pose)
    start = tuple(np.add(pose, off))
    config = LearnedMatchConfig(min_inliers=10)
    assert refine_by_keypoints(query, known, start, config) is None


def test_mirrored_keypoints_do_not_match():
    pose = (0.0, 0.0, 0.0)
    query, known = views(np.random.default_rng(2), pose, own=0)
    assert refine_by_keypoints(query, known, pose) is not None
    mirrored = Keypoints(known.xy * (1.0, -1.0), known.descriptors, known.sigma)
    config = LearnedMatchConfig(min_inliers=12, max_shift=50.0, max_turn=4.0)
    assert refine_by_keypoints(query, known, pose, config) is not None
    assert refine_by_keypoints(query, mirrored, pose, config) is None


def test_chance_agreement_is_not_accepted():
    found = []
    for seed in range(12):
        query, known = views(np.random.default_rng(seed), (0.0, 0.0, 0.0), shared=0)
        found.append(refine_by_keypoints(query, known, (0.0, 0.0, 0.0)))
    assert found == [None] * 12


def test_empty_keypoints_give_no_pose():
    query, known = views(np.random.default_rng(3), (0.0, 0.0, 0.0))
    none = np.zeros(0, dtype=np.int64)
    for one, other in (
        (query.select(none), known),
        (query, known.select(none)),
        (query.select(none), known.select(none)),
    ):
        assert refine_by_keypoints(one, other, (0.0, 0.0, 0.0)) is None
    assert refine_by_keypoints(query, known, (1000.0, 0.0, 0.0)) is None
