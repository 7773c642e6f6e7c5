"""A graph solved at once gives gtsam's poses and covariances."""

import numpy as np
import pytest
from se3 import exp_se3

from coview_stream.geometry.transforms import exp_so3, log_se3, pose_from, relative
from coview_stream.localization.tracking.batch_graph import BatchGraph, Constraint

KERNEL = 3.0


def random_graph(seed, nodes=24, loops=10, outliers=0.2):
    """Poses to begin at, odometry, and what is under a kernel: loops and poses on the map, some of them far off."""
    rng = np.random.default_rng(seed)
    steps = [pose_from(exp_so3([0.05, -0.02, 0.3] * rng.standard_normal(3)), [3.0, 0.2, 0.1]) for _ in range(nodes)]
    truth = [pose_from(exp_so3(rng.standard_normal(3)), [200.0, -50.0, 5.0])]
    for step in steps[1:]:
        truth.append(truth[-1] @ step)

    def spread(scale):
        A = rng.standard_normal((6, 6)) * np.array([0.01] * 3 + [0.1] * 3)[:, None] * scale
        return A @ A.T + np.diag([1e-6] * 3 + [1e-4] * 3) * scale**2

    def measured(source, target, covariance, off):
        T = truth[source] if target < 0 else relative(truth[target], truth[source])
        L = np.linalg.cholesky(covariance)
        xi = L @ rng.standard_normal(6) * (20.0 if off else 1.0)
        return Constraint(source, target, T @ exp_se3(xi), covariance)

    odometry = [measured(k, k - 1, spread(0.3), False) for k in range(1, nodes)]
    pairs = [(a, b) for a, b in rng.integers(0, nodes, (loops, 2)).tolist() if a != b]
    pairs += [(k, -1) for k in range(0, nodes, 5)]
    robust = [measured(a, b, spread(1.0), rng.random() < outliers) for a, b in pairs]
    start = [T @ exp_se3(rng.standard_normal(6) * ([0.02] * 3 + [0.3] * 3)) for T in truth]
    return np.array(start), odometry, robust


def by_gtsam(start, odometry, robust, kind):
    gtsam = pytest.importorskip("gtsam", reason="the oracle of this test")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    kernel = getattr(gtsam.noiseModel.mEstimator, kind).Create(KERNEL)
    for c in [*odometry, *robust]:
        noise = gtsam.noiseModel.Gaussian.Covariance(c.covariance)
        if any(c is each for each in robust):
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        T = gtsam.Pose3(c.T)
        if c.target < 0:
            graph.add(gtsam.PriorFactorPose3(c.source, T, noise))
        else:
            graph.add(gtsam.BetweenFactorPose3(c.target, c.source, T, noise))
    for k, T in enumerate(start):
        values.insert(k, gtsam.Pose3(T))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(500)
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, values)
    nodes = range(len(start))
    return np.array([values.atPose3(k).matrix() for k in nodes]), [marginals.marginalCovariance(k) for k in nodes]


def solved(start, odometry, robust, kind):
    graph = BatchGraph(start)
    graph.add(odometry)
    graph.add(robust, (kind, KERNEL))
    return graph.solve(), graph.covariances()


@pytest.mark.parametrize("kind", ["Huber", "Cauchy"])
@pytest.mark.parametrize("seed", range(3))
def test_random_graphs_are_solved_as_by_gtsam(seed, kind):
    case = random_graph(seed)
    poses, covariances = solved(*case, kind)
    expected, spreads = by_gtsam(*case, kind)
    for ours, theirs in zip(covariances, spreads, strict=True):
        sigma = np.sqrt(np.diag(theirs))
        assert np.abs((ours - theirs) / np.outer(sigma, sigma)).max() < 1e-4
    assert np.abs(log_se3(relative(expected, poses))[0]).max() < 1e-6


def test_two_measurements_of_one_node_are_weighed_by_their_covariances():
    at = [pose_from(np.eye(3), [x, 0.0, 0.0]) for x in (0.0, 1e-3)]
    graph = BatchGraph(np.array([at[1]]))
    graph.add([Constraint(0, -1, at[0], 4.0 * np.eye(6)), Constraint(0, -1, at[1], np.eye(6))])
    np.testing.assert_allclose(graph.solve()[0], pose_from(np.eye(3), [0.8e-3, 0.0, 0.0]), atol=1e-9)
    np.testing.assert_allclose(graph.covariances()[0], 0.8 * np.eye(6), atol=1e-6)


def test_empty_graph_is_solved():
    assert BatchGraph(np.empty((0, 4, 4))).solve().shape == (0, 4, 4)
