"""The pose graph gives the posterior where it is known, and refuses unusable input."""

from dataclasses import dataclass

import numpy as np
import pytest
from se3 import exp_se3

from coview_stream.errors import InputError
from coview_stream.geometry.transforms import along_body, along_map, boxminus, boxplus, exp_so3, inverse, pose_from
from coview_stream.localization.tracking.pose_graph import _RELINEARIZE, HUBER, PoseGraph


@pytest.fixture
def graph():
    return PoseGraph()


START = pose_from(exp_so3([0.1, -0.2, 2.2]), [120.0, -40.0, 7.0])
START_COVARIANCE = np.diag([0.01, 0.01, 0.03, 0.3, 0.3, 0.2]) ** 2
ODOMETRY = np.diag([0.001, 0.001, 0.002, 0.02, 0.02, 0.02]) ** 2
REGISTRATION = np.diag([0.002, 0.002, 0.004, 0.05, 0.05, 0.05]) ** 2


@dataclass(frozen=True)
class Drive:
    """``truth`` and ``seen`` have one pose more than there are ``steps``; what is not seen is None."""

    truth: list
    steps: list
    seen: list


def drive(
    keyframes, seed=0, every=3, outliers=0.0, bias=None, odometry=ODOMETRY, registration=REGISTRATION, stray=5.0
) -> Drive:
    """Steps of half a metre on a winding way; ``bias`` (6,) is added to every step of odometry."""
    rng = np.random.default_rng(seed)
    truth, steps, seen = [START], [], [None]
    for k in range(1, keyframes):
        step = exp_se3(np.array([0.004 * np.sin(k / 9), 0.002, 0.05 * np.sin(k / 20), 0.5, 0.0, 0.01]))
        truth.append(truth[-1] @ step)
        noise = rng.standard_normal(6) * np.sqrt(np.diag(odometry)) + (0.0 if bias is None else bias)
        steps.append(inverse(truth[-2]) @ boxplus(truth[-1], noise))
        gap = rng.standard_normal(6) * np.sqrt(np.diag(registration))
        gap[3:] += stray * rng.standard_normal(3) * (rng.random() < outliers)
        seen.append(boxplus(truth[-1], gap) if k % every == 0 else None)
    return Drive(truth, steps, seen)


def run(graph, drive, odometry=ODOMETRY, registration=REGISTRATION, start=START_COVARIANCE):
    """All estimates, from the first keyframe on."""
    graph.start(drive.truth[0], start)
    estimates = [graph.estimate]
    for step, seen in zip(drive.steps, drive.seen[1:], strict=True):
        graph.move(step, odometry)
        if seen is not None:
            graph.correct(seen, registration)
        estimates.append(graph.estimate)
    return estimates


def shift_errors(estimates, truth):
    """Distance (K,) of every estimate from the truth, metres."""
    return np.array([np.linalg.norm(e.T_map_body[:3, 3] - T[:3, 3]) for e, T in zip(estimates, truth, strict=True)])


def relative(A, B):
    """Largest difference of two covariances in units of the second's sigmas."""
    sigma = np.sqrt(np.diag(B))
    return float(np.abs((A - B) / np.outer(sigma, sigma)).max())


STEP = exp_se3(np.array([0.02, -0.01, 0.3, 2.0, 0.3, -0.1]))


def test_innovation_is_the_squared_distance_in_sigmas(graph):
    graph.start(START, START_COVARIANCE)
    graph.estimate.T_map_body[:] = 0.0  # a copy
    graph.move(STEP, ODOMETRY)
    T, covariance = graph.estimate
    np.testing.assert_allclose(T, START @ STEP, atol=1e-12)
    gap = np.array([0.01, 0.0, -0.02, 0.3, -0.2, 0.1])
    expected = gap @ np.linalg.solve(covariance + REGISTRATION, gap)
    assert graph.estimate.innovation(boxplus(T, gap), REGISTRATION) == pytest.approx(expected, rel=1e-6)
    assert graph.estimate.innovation(T, REGISTRATION) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(graph.estimate.T_map_body, T)


def test_empty_graph_raises(graph):
    def ask():
        return graph.estimate

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
    for call in (graph.start, graph.move, graph.correct):
        with pytest.raises(InputError, match="rigid"):
            call(broken, REGISTRATION)
        with pytest.raises(InputError, match="positive definite"):
            call(START, np.zeros((6, 6)))
    assert len(graph) == 2
    for a, b in zip(graph.estimate, before, strict=True):
        np.testing.assert_array_equal(a, b)


HONEST = np.diag([0.002, 0.002, 0.004, 0.06, 0.06, 0.06]) ** 2
RAW = HONEST / 6.0**2  # as optimistic as the inverse Hessian
BIAS = np.array([0.0, 0.0, 0.0006, 0.012, -0.008, 0.004])  # per step: odometry drifts by metres


@pytest.fixture(scope="module")
def way():
    """100 metres, a registration every metre, one in ten metres off."""
    return drive(200, seed=11, every=2, outliers=0.1, bias=BIAS, odometry=1e-2 * ODOMETRY, registration=HONEST)


@pytest.mark.parametrize(
    ("registration", "least", "most"),
    [
        (RAW, 0.0, 0.6),  # a kernel that lets go (Geman-McClure, DCS) locks the map out here
        (HONEST, 0.0, 0.35),
        (None, 2.0, np.inf),  # odometry alone
    ],
)
def test_map_is_not_locked_out_where_covariances_are_optimistic(way, registration, least, most):
    seen = way.seen if registration is not None else [None] * len(way.truth)
    drive = Drive(way.truth, way.steps, seen)
    estimates = run(PoseGraph(window=10), drive, ODOMETRY, RAW if registration is None else registration)
    assert least < shift_errors(estimates, way.truth)[20:].max() < most


# covariances of the dense solution differ along each of the map's axes
LOPSIDED_START = np.diag([0.01, 0.015, 0.03, 0.3, 0.1, 0.2]) ** 2
LOPSIDED_STEP = np.diag([0.001, 0.002, 0.002, 0.02, 0.04, 0.01]) ** 2
LOPSIDED_MATCH = np.diag([0.002, 0.004, 0.004, 0.05, 0.1, 0.03]) ** 2


def dense(way):
    """All poses at once, by derivatives from differences and full matrices; the newest pose and covariance."""
    n = len(way.truth)
    X = [START]
    for step in way.steps:
        X.append(X[-1] @ step)
    start, odometry, registration = (
        np.linalg.inv(np.linalg.cholesky(C)) for C in (LOPSIDED_START, LOPSIDED_STEP, LOPSIDED_MATCH)
    )

    def residuals(X):
        rows = [start @ boxminus(X[0], START)]
        rows += [odometry @ boxminus(X[k], X[k - 1] @ step) for k, step in enumerate(way.steps, start=1)]
        return rows + [registration @ boxminus(X[k], seen) for k, seen in enumerate(way.seen) if seen is not None]

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


@pytest.mark.slow
def test_newest_pose_equals_dense_solution(graph):
    """With an outlier of metres among the corrections; residuals here are along the map's axes, not the body's."""
    way = drive(8, seed=2, every=2)
    way.seen[4] = boxplus(way.seen[4], np.array([0, 0, 0, 3.0, -2.0, 1.0]))
    T, covariance = dense(way)
    solution = run(graph, way, LOPSIDED_STEP, LOPSIDED_MATCH, LOPSIDED_START)[-1]
    gap = np.abs(boxminus(solution.T_map_body, T))
    assert gap[:3].max() < 5e-4
    assert gap[3:].max() < 2e-3
    assert relative(solution.covariance, covariance) < 0.02


def full_isam2(way):
    """One iSAM2 that never forgets, its tangent handled here."""
    gtsam = pytest.importorskip("gtsam", reason="the oracle of this test")
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
    solution, full = run(pose_graph, way), full_isam2(way)
    gaps = np.abs([boxminus(e.T_map_body, T) for e, (T, _) in zip(solution, full, strict=True)])
    sigmas = np.sqrt([np.diag(C) for _, C in full])
    assert (gaps / sigmas).max() < 0.01
    assert gaps[:, 3:].max() < 1e-3
    covariances = np.array([np.diag(e.covariance) for e in solution])
    assert np.abs(np.sqrt(covariances) / sigmas - 1.0).max() < 0.01
    assert shift_errors(solution, way.truth)[100:].mean() < 0.15
    assert len(pose_graph) == 40
    R = solution[-1].T_map_body[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
