"""The pose graph beside other solutions: a dense one, and one that never forgets."""

from __future__ import annotations

import numpy as np
import pytest
from graph_drives import ODOMETRY, REGISTRATION, START, START_COVARIANCE, drive, relative, run, shift_errors

from coview_stream.config import GraphConfig
from coview_stream.geometry.transforms import along_body, along_map, boxminus, boxplus
from coview_stream.localization.tracking.pose_graph import _RELINEARIZE, PoseGraph

HUBER = GraphConfig().huber


# ---- against a dense solution


def dense(way, start=START_COVARIANCE):
    """All poses at once, by derivatives from differences and full matrices; the newest pose and covariance."""
    n = len(way.truth)
    X = [START]
    for step in way.steps:
        X.append(X[-1] @ step)
    whitener = {name: np.linalg.inv(np.linalg.cholesky(C)) for name, C in [("z", ODOMETRY), ("y", REGISTRATION)]}

    def residuals(X):
        rows = [np.linalg.inv(np.linalg.cholesky(start)) @ boxminus(X[0], START)]
        rows += [whitener["z"] @ boxminus(X[k], X[k - 1] @ step) for k, step in enumerate(way.steps, start=1)]
        return rows + [whitener["y"] @ boxminus(X[k], seen) for k, seen in enumerate(way.seen) if seen is not None]

    for _ in range(15):
        r = residuals(X)
        J = np.zeros((6 * len(r), 6 * n))
        for column in range(6 * n):
            h = np.zeros(6)
            h[column % 6] = 1e-5
            k = column // 6
            ahead, behind = ([*X[:k], boxplus(X[k], s * h), *X[k + 1 :]] for s in (1, -1))
            J[:, column] = (np.concatenate(residuals(ahead)) - np.concatenate(residuals(behind))) / 2e-5
        w = np.ones(len(r))
        w[n:] = [HUBER / max(HUBER, np.linalg.norm(one)) for one in r[n:]]
        W = np.repeat(w, 6)
        H = J.T @ (W[:, None] * J)
        step = -np.linalg.solve(H, J.T @ (W * np.concatenate(r)))
        X = [boxplus(T, step[6 * k : 6 * k + 6]) for k, T in enumerate(X)]
        if np.abs(step).max() < 1e-8:
            break
    return X[-1], np.linalg.inv(H)[-6:, -6:]


def test_newest_pose_equals_dense_solution(graph):
    """With an outlier of metres among the corrections; residuals here are along the map's axes, not the body's."""
    way = drive(8, seed=2, every=2)
    way.seen[4] = boxplus(way.seen[4], np.array([0, 0, 0, 3.0, -2.0, 1.0]))
    T, covariance = dense(way)
    found = run(graph, way)[-1]
    gap = np.abs(boxminus(found.T_map_body, T))
    assert gap[:3].max() < 1e-4
    assert gap[3:].max() < 2e-3
    assert relative(found.covariance, covariance) < 0.02


# ---- the window


def full_isam2(way):
    """One iSAM2 that never forgets, its tangent handled here."""
    import gtsam

    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(_RELINEARIZE)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    gaussian, robust = gtsam.noiseModel.Gaussian.Covariance, gtsam.noiseModel.Robust.Create
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    predicted, answers = START, []
    for k in range(len(way.truth)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            noise = gaussian(along_body(START_COVARIANCE, START))
            graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(START), noise))
        else:
            predicted = answers[-1][0] @ way.steps[k - 1]
            noise = gaussian(along_body(ODOMETRY, predicted))
            graph.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(way.steps[k - 1]), noise))
        if way.seen[k] is not None:
            noise = robust(kernel, gaussian(along_body(REGISTRATION, way.seen[k])))
            graph.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(way.seen[k]), noise))
        values.insert(k, gtsam.Pose3(predicted))
        isam.update(graph, values)
        # until all weights are those of the present poses
        for _ in range(20 if way.seen[k] is not None else 0):
            if not isam.update().getVariablesRelinearized():
                break
        T = isam.calculateEstimatePose3(k).matrix()
        answers.append((T, along_map(isam.marginalCovariance(k), T)))
    return answers


@pytest.mark.slow
def test_long_drive_equals_unbounded_graph():
    """To a hundredth of a sigma and a millimetre, and memory does not grow."""
    way = drive(2000, seed=6, every=10, outliers=0.05)
    pose_graph = PoseGraph()
    found, full = run(pose_graph, way), full_isam2(way)
    gaps = np.abs([boxminus(e.T_map_body, T) for e, (T, _) in zip(found, full, strict=True)])
    sigmas = np.sqrt([np.diag(C) for _, C in full])
    assert (gaps / sigmas).max() < 0.01
    assert gaps[:, 3:].max() < 1e-3
    covariances = np.array([np.diag(e.covariance) for e in found])
    assert np.abs(np.sqrt(covariances) / sigmas - 1.0).max() < 0.01
    assert shift_errors(found, way.truth)[100:].mean() < 0.15
    assert pose_graph.config.window <= len(pose_graph) <= pose_graph.config.restart


def test_graph_memory_is_bounded():
    config = GraphConfig(window=5, restart=9)
    graph, way = PoseGraph(config), drive(60, seed=7)
    lengths = []
    graph.start(START, START_COVARIANCE)
    for step, seen in zip(way.steps, way.seen[1:], strict=True):
        graph.move(step, ODOMETRY)
        if seen is not None:
            graph.correct(seen, REGISTRATION)
        lengths.append(len(graph))
    assert max(lengths) <= config.restart
    assert min(lengths[config.window :]) >= config.window


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 4, 30])
def test_short_window_keeps_the_estimate(every):
    """The past meets the future in one pose; the smoothed belief there would count things twice.

    The kernel is out of the way: what it has weighed cannot be weighed again once it is forgotten.
    """
    way = drive(80, seed=8, every=every)
    long = run(PoseGraph(GraphConfig(window=200, restart=400, huber=100.0)), way)
    short = run(PoseGraph(GraphConfig(window=3, restart=5, huber=100.0)), way)
    for a, b in zip(long, short, strict=True):
        sigma = np.sqrt(np.diag(a.covariance))
        assert (np.abs(boxminus(a.T_map_body, b.T_map_body)) < 0.05 * sigma).all()
        np.testing.assert_allclose(np.sqrt(np.diag(b.covariance)), sigma, rtol=0.03)
