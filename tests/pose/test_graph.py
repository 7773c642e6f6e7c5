"""The graph: both backends give the posterior where it is known, and mind what they are given."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from chains import ODOMETRY, REGISTRATION, START, START_COVARIANCE, drive, relative, run, shift_errors

from coview_stream.config import GraphConfig
from coview_stream.errors import ConfigError, DependencyError, InputError
from coview_stream.geometry import exp_se3, pose_from
from coview_stream.pose.graph import make_smoother
from coview_stream.pose.graph_numpy import NumpySmoother
from coview_stream.pose.tangent import difference, shifted

HUBER = GraphConfig().huber
STEP = exp_se3(np.array([0.02, -0.01, 0.3, 2.0, 0.3, -0.1]))


# ---- one and two keyframes, where the answer is known


def test_the_prior_comes_back_as_it_was(smoother):
    C = START_COVARIANCE + 1e-3 * np.ones((6, 6))
    smoother.start(START, C)
    T, covariance = smoother.estimate
    np.testing.assert_allclose(T, START, atol=1e-12)
    assert relative(covariance, C) < 1e-9


def test_a_move_composes_and_carries_the_covariance_with_its_lever(smoother):
    """A doubt in heading becomes one in place, across the way driven."""
    heading = np.diag([1e-4, 1e-4, 0.1, 1e-3, 1e-3, 1e-3]) ** 2
    smoother.start(START, heading)
    smoother.move(STEP, ODOMETRY)
    T, covariance = smoother.estimate
    np.testing.assert_allclose(T, START @ STEP, atol=1e-12)
    way = T[:3, 3] - START[:3, 3]
    across = np.array([-way[1], way[0], 0.0])
    found = covariance[3:, 3:] - ODOMETRY[3:, 3:]
    np.testing.assert_allclose(
        found, 0.01 * np.outer(across, across) + 1e-6 * np.eye(3), rtol=1e-3, atol=1e-7
    )


def test_odometrys_covariance_lies_along_the_maps_axes(smoother):
    smoother.start(START, 1e-12 * np.eye(6))
    Q = np.diag([1e-3, 2e-3, 3e-3, 0.1, 0.2, 0.3]) ** 2
    smoother.move(STEP, Q)
    assert relative(smoother.estimate.covariance, Q) < 1e-4


def test_a_correction_fuses_as_two_gaussians_do(smoother):
    """Close to each other, so that Huber does not bite and the tangent is flat."""
    gap = np.array([0.0005, -0.0003, 0.002, 0.02, -0.01, 0.015])
    P, R = START_COVARIANCE, np.diag([0.004, 0.004, 0.01, 0.1, 0.2, 0.05]) ** 2
    smoother.start(START, P)
    smoother.correct(shifted(START, gap), R)
    expected = np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(R))
    T, covariance = smoother.estimate
    assert relative(covariance, expected) < 1e-3
    np.testing.assert_allclose(difference(T, START), expected @ np.linalg.solve(R, gap), atol=1e-5)


def test_an_outlier_pulls_no_more_than_the_kernel_allows(smoother):
    """Alone along x, the pull of k sigmas moves the mean by k P / sigma whatever the outlier's size."""
    P, R = 0.01 * np.eye(6), 1e-4 * np.eye(6)
    moved = []
    for far in (10.0, 50.0):
        smoother.start(START, P)
        smoother.correct(shifted(START, np.array([0, 0, 0, far, 0, 0])), R)
        moved.append(difference(smoother.estimate.T_map_body, START)[3])
    np.testing.assert_allclose(moved, HUBER * 0.01 / 0.01, rtol=0.02)


def test_innovation_is_the_squared_distance_in_sigmas(smoother):
    smoother.start(START, START_COVARIANCE)
    smoother.move(STEP, ODOMETRY)
    T, covariance = smoother.estimate
    gap = np.array([0.01, 0.0, -0.02, 0.3, -0.2, 0.1])
    expected = gap @ np.linalg.solve(covariance + REGISTRATION, gap)
    assert smoother.innovation(shifted(T, gap), REGISTRATION) == pytest.approx(expected, rel=1e-6)
    assert smoother.innovation(T, REGISTRATION) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(smoother.estimate.T_map_body, T)


def test_innovations_are_chi_square_if_the_covariances_are_right(backend):
    smoother = make_smoother(GraphConfig(backend=backend, window=5, restart=20))
    way = drive(400, seed=4, every=3)
    smoother.start(shifted(START, np.linalg.cholesky(START_COVARIANCE)[:, 3] * 0.5), START_COVARIANCE)
    found = []
    for step, seen in zip(way.steps, way.seen[1:], strict=True):
        smoother.move(step, ODOMETRY)
        if seen is not None:
            found.append(smoother.innovation(seen, REGISTRATION))
            smoother.correct(seen, REGISTRATION)
    assert np.mean(found) == pytest.approx(6.0, rel=0.15)


# ---- a gap, a new start, refusals


def test_without_the_map_the_covariance_grows_and_the_map_takes_it_back(smoother):
    way = drive(200, seed=9, every=1)
    for k in range(50, 150):
        way.seen[k] = None
    found = run(smoother, way)
    sigma = np.array([np.sqrt(np.trace(e.covariance[3:, 3:])) for e in found])
    assert (np.diff(sigma[50:150]) > 0).all()
    assert sigma[149] > 5 * sigma[49]
    errors = shift_errors(found, way.truth)
    assert errors[149] < 3 * sigma[149]
    assert errors[155:].max() < 0.15
    assert sigma[-1] < 1.1 * sigma[49]


def test_a_new_start_carries_nothing_over(smoother):
    way, elsewhere = drive(30, seed=10), pose_from(np.eye(3), [-50.0, 0.0, 0.0])
    run(smoother, way)
    smoother.start(elsewhere, REGISTRATION)
    assert len(smoother) == 1
    smoother.move(STEP, ODOMETRY)
    fresh = make_smoother(smoother.config)
    fresh.start(elsewhere, REGISTRATION)
    fresh.move(STEP, ODOMETRY)
    for a, b in zip(smoother.estimate, fresh.estimate, strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_empty_graph_says_so(smoother):
    def ask():
        return smoother.estimate

    smoother.start(START, START_COVARIANCE)
    smoother.clear()
    assert len(smoother) == 0
    for call in (
        ask,
        lambda: smoother.move(STEP, ODOMETRY),
        lambda: smoother.correct(START, REGISTRATION),
        lambda: smoother.innovation(START, REGISTRATION),
    ):
        with pytest.raises(RuntimeError, match="call start first"):
            call()


def test_what_cannot_be_used_is_refused_and_changes_nothing(smoother):
    smoother.start(START, START_COVARIANCE)
    smoother.move(STEP, ODOMETRY)
    before = smoother.estimate
    broken = START.copy()
    broken[0, 0] = np.nan
    for call in (smoother.start, smoother.move, smoother.correct, smoother.innovation):
        with pytest.raises(InputError, match="rigid"):
            call(broken, REGISTRATION)
        with pytest.raises(InputError, match="positive definite"):
            call(START, np.zeros((6, 6)))
    assert len(smoother) == 2
    for a, b in zip(smoother.estimate, before, strict=True):
        np.testing.assert_array_equal(a, b)


def test_changing_an_answer_does_not_change_the_graph(smoother):
    smoother.start(START, START_COVARIANCE)
    smoother.estimate.T_map_body[:] = 0.0
    smoother.move(STEP, ODOMETRY)
    np.testing.assert_allclose(smoother.estimate.T_map_body, START @ STEP, atol=1e-12)


def test_poses_stay_rigid_over_hundreds_of_moves(smoother):
    smoother.start(START, START_COVARIANCE)
    for _ in range(500):
        smoother.move(STEP, ODOMETRY)
    R = smoother.estimate.T_map_body[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


# ---- which backend


def test_where_gtsam_is_missing_numpy_takes_its_place(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert isinstance(make_smoother(), NumpySmoother)
    with pytest.raises(DependencyError, match="pip install gtsam"):
        make_smoother(GraphConfig(backend="gtsam"))


def test_the_backend_can_be_chosen(backend):
    assert isinstance(make_smoother(GraphConfig(backend="numpy")), NumpySmoother)
    wanted = isinstance(make_smoother(GraphConfig(backend=backend)), NumpySmoother)
    assert wanted == (backend == "numpy")


@pytest.mark.parametrize(
    ("name", "value"),
    [("backend", "g2o"), ("window", 1), ("restart", GraphConfig().window), ("huber", 0.0), ("huber", np.inf)],
)
def test_a_setting_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=rf"GraphConfig\.{name}"):
        GraphConfig(**{name: value})
