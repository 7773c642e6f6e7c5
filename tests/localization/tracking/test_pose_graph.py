"""The pose graph gives the posterior where it is known, and refuses what it cannot use."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from graph_drives import ODOMETRY, REGISTRATION, START, START_COVARIANCE, drive, relative, run, shift_errors
from se3 import exp_se3

from coview_stream.config import GraphConfig
from coview_stream.errors import ConfigError, DependencyError, InputError
from coview_stream.geometry.transforms import boxminus, boxplus, pose_from
from coview_stream.localization.tracking.pose_graph import PoseGraph

HUBER = GraphConfig().huber
STEP = exp_se3(np.array([0.02, -0.01, 0.3, 2.0, 0.3, -0.1]))


# ---- one and two keyframes, where the answer is known


def test_prior_is_the_first_estimate(graph):
    C = START_COVARIANCE + 1e-3 * np.ones((6, 6))
    graph.start(START, C)
    T, covariance = graph.estimate
    np.testing.assert_allclose(T, START, atol=1e-12)
    assert relative(covariance, C) < 1e-9


def test_move_composes_pose_and_propagates_covariance(graph):
    """A doubt in heading becomes one in place, across the way driven."""
    heading = np.diag([1e-4, 1e-4, 0.1, 1e-3, 1e-3, 1e-3]) ** 2
    graph.start(START, heading)
    graph.move(STEP, ODOMETRY)
    T, covariance = graph.estimate
    np.testing.assert_allclose(T, START @ STEP, atol=1e-12)
    way = T[:3, 3] - START[:3, 3]
    across = np.array([-way[1], way[0], 0.0])
    found = covariance[3:, 3:] - ODOMETRY[3:, 3:]
    np.testing.assert_allclose(found, 0.01 * np.outer(across, across) + 1e-6 * np.eye(3), rtol=1e-3, atol=1e-7)


def test_odometry_covariance_is_along_map_axes(graph):
    graph.start(START, 1e-12 * np.eye(6))
    Q = np.diag([1e-3, 2e-3, 3e-3, 0.1, 0.2, 0.3]) ** 2
    graph.move(STEP, Q)
    assert relative(graph.estimate.covariance, Q) < 1e-4


def test_correction_fuses_as_two_gaussians(graph):
    """Close to each other, so that Huber does not bite and the tangent is flat."""
    gap = np.array([0.0005, -0.0003, 0.002, 0.02, -0.01, 0.015])
    P, R = START_COVARIANCE, np.diag([0.004, 0.004, 0.01, 0.1, 0.2, 0.05]) ** 2
    graph.start(START, P)
    graph.correct(boxplus(START, gap), R)
    expected = np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(R))
    T, covariance = graph.estimate
    assert relative(covariance, expected) < 1e-3
    np.testing.assert_allclose(boxminus(T, START), expected @ np.linalg.solve(R, gap), atol=1e-5)


def test_huber_kernel_bounds_the_pull_of_an_outlier(graph):
    """Alone along x, the pull of k sigmas moves the mean by k P / sigma for any size of the outlier."""
    P, R = 0.01 * np.eye(6), 1e-4 * np.eye(6)
    moved = []
    for far in (10.0, 50.0):
        graph.start(START, P)
        graph.correct(boxplus(START, np.array([0, 0, 0, far, 0, 0])), R)
        moved.append(boxminus(graph.estimate.T_map_body, START)[3])
    np.testing.assert_allclose(moved, HUBER * 0.01 / 0.01, rtol=0.02)


def test_innovation_is_the_squared_distance_in_sigmas(graph):
    graph.start(START, START_COVARIANCE)
    graph.move(STEP, ODOMETRY)
    T, covariance = graph.estimate
    gap = np.array([0.01, 0.0, -0.02, 0.3, -0.2, 0.1])
    expected = gap @ np.linalg.solve(covariance + REGISTRATION, gap)
    assert graph.estimate.innovation(boxplus(T, gap), REGISTRATION) == pytest.approx(expected, rel=1e-6)
    assert graph.estimate.innovation(T, REGISTRATION) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(graph.estimate.T_map_body, T)


def test_innovations_are_chi_square_with_true_covariances():
    graph = PoseGraph(GraphConfig(window=5, restart=20))
    way = drive(400, seed=4, every=3)
    graph.start(boxplus(START, np.linalg.cholesky(START_COVARIANCE)[:, 3] * 0.5), START_COVARIANCE)
    found = []
    for step, seen in zip(way.steps, way.seen[1:], strict=True):
        graph.move(step, ODOMETRY)
        if seen is not None:
            found.append(graph.estimate.innovation(seen, REGISTRATION))
            graph.correct(seen, REGISTRATION)
    assert np.mean(found) == pytest.approx(6.0, rel=0.15)


# ---- a gap, a new start, refusals


def test_covariance_grows_on_odometry_and_shrinks_with_corrections(graph):
    way = drive(200, seed=9, every=1)
    for k in range(50, 150):
        way.seen[k] = None
    found = run(graph, way)
    sigma = np.array([np.sqrt(np.trace(e.covariance[3:, 3:])) for e in found])
    assert (np.diff(sigma[50:150]) > 0).all()
    assert sigma[149] > 5 * sigma[49]
    errors = shift_errors(found, way.truth)
    assert errors[149] < 3 * sigma[149]
    assert errors[155:].max() < 0.15
    assert sigma[-1] < 1.1 * sigma[49]


def test_restart_carries_nothing_over(graph):
    way, elsewhere = drive(30, seed=10), pose_from(np.eye(3), [-50.0, 0.0, 0.0])
    run(graph, way)
    graph.start(elsewhere, REGISTRATION)
    assert len(graph) == 1
    graph.move(STEP, ODOMETRY)
    fresh = PoseGraph(graph.config)
    fresh.start(elsewhere, REGISTRATION)
    fresh.move(STEP, ODOMETRY)
    for a, b in zip(graph.estimate, fresh.estimate, strict=True):
        np.testing.assert_array_equal(a, b)


def test_empty_graph_raises(graph):
    def ask():
        return graph.estimate

    graph.start(START, START_COVARIANCE)
    graph.clear()
    assert len(graph) == 0
    for call in (
        ask,
        lambda: graph.move(STEP, ODOMETRY),
        lambda: graph.correct(START, REGISTRATION),
        lambda: graph.estimate.innovation(START, REGISTRATION),
    ):
        with pytest.raises(RuntimeError, match="call start first"):
            call()


def test_invalid_input_is_refused_and_changes_nothing(graph):
    graph.start(START, START_COVARIANCE)
    graph.move(STEP, ODOMETRY)
    before = graph.estimate
    broken = START.copy()
    broken[0, 0] = np.nan
    for call in (graph.start, graph.move, graph.correct, before.innovation):
        with pytest.raises(InputError, match="rigid"):
            call(broken, REGISTRATION)
        with pytest.raises(InputError, match="positive definite"):
            call(START, np.zeros((6, 6)))
    assert len(graph) == 2
    for a, b in zip(graph.estimate, before, strict=True):
        np.testing.assert_array_equal(a, b)


def test_returned_estimate_is_a_copy(graph):
    graph.start(START, START_COVARIANCE)
    graph.estimate.T_map_body[:] = 0.0
    graph.move(STEP, ODOMETRY)
    np.testing.assert_allclose(graph.estimate.T_map_body, START @ STEP, atol=1e-12)


def test_poses_stay_rigid_over_hundreds_of_moves(graph):
    graph.start(START, START_COVARIANCE)
    for _ in range(500):
        graph.move(STEP, ODOMETRY)
    R = graph.estimate.T_map_body[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


# ---- gtsam and the configuration


def test_missing_gtsam_is_named_with_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(DependencyError, match=r"pip install 'coview-stream\[node\]'"):
        PoseGraph()


@pytest.mark.parametrize(
    ("name", "value"), [("window", 1), ("restart", GraphConfig().window), ("huber", 0.0), ("huber", np.inf)]
)
def test_graph_config_out_of_range_is_refused(name, value):
    with pytest.raises(ConfigError, match=rf"GraphConfig\.{name}"):
        GraphConfig(**{name: value})
