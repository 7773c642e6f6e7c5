from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coview_kernels import normal_equations, trim


def exp(xi):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(xi[:3]).as_matrix()
    T[:3, 3] = xi[3:]
    return T


def about(centre, T):
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = centre, -centre
    return there @ T @ back


@pytest.mark.parametrize("plane", [True, False])
def test_gradient_and_curvature_are_those_of_the_cost(plane):
    rng = np.random.default_rng(5)
    source = rng.normal(0, 10, (50, 3)).astype(np.float32)
    T = about(np.array([500.0, -300.0, 20.0]), exp(np.array([0.1, -0.2, 0.7, 3, 4, 5])))
    moved = source @ T[:3, :3].T + T[:3, 3]
    target = (moved + rng.normal(0, 0.3, moved.shape)).astype(np.float32)
    normals = rng.normal(size=(50, 3)).astype(np.float32) if plane else None
    weights = rng.random(50).astype(np.float32)
    centre = moved.mean(axis=0)

    def cost_at(xi):
        return normal_equations(source, target, normals, weights, about(centre, exp(xi)) @ T, centre)[2]

    H, b, cost = normal_equations(source, target, normals, weights, T, centre)
    assert cost == pytest.approx(cost_at(np.zeros(6)))
    steps = 1e-5 * np.eye(6)
    gradient = np.array([(cost_at(s) - cost_at(-s)) / 2e-5 for s in steps])
    np.testing.assert_allclose(2 * b, gradient, rtol=1e-4, atol=1e-4)
    # away from the optimum the second derivative has another term; compare H on a perfect match
    exact = (source @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    H, _, _ = normal_equations(source, exact, normals, weights, T, centre)
    direction = np.array([1e-3, -2e-3, 1e-3, 2e-3, 1e-3, -1e-3])
    value = normal_equations(source, exact, normals, weights, about(centre, exp(direction)) @ T, centre)[2]
    assert value == pytest.approx(direction @ H @ direction, rel=0.02)


@pytest.mark.parametrize("plane", [True, False])
def test_solves_a_small_displacement_far_from_the_origin(plane):
    rng = np.random.default_rng(6)
    source = rng.normal(0, 15, (500, 3)).astype(np.float32)
    truth = exp(np.array([0, 0, 1.0, 900.0, -700.0, 30.0]))
    target = (source @ truth[:3, :3].T + truth[:3, 3]).astype(np.float32)
    normals = rng.normal(size=(500, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32) if plane else None
    T = truth @ exp(np.array([0.02, -0.03, 0.05, 0.4, -0.3, 0.2]))
    for _ in range(5):
        centre = (source @ T[:3, :3].T + T[:3, 3]).mean(axis=0)
        H, b, _ = normal_equations(source, target, normals, np.ones(500), T, centre)
        T = about(centre, exp(-np.linalg.solve(H, b))) @ T
    np.testing.assert_allclose(T, truth, atol=2e-4)


def test_empty_and_one_point():
    H, b, cost = normal_equations(
        np.empty((0, 3)), np.empty((0, 3)), None, np.empty(0), np.eye(4), np.zeros(3)
    )
    assert not H.any()
    assert not b.any()
    assert cost == 0.0
    one = np.array([[1.0, 2.0, 3.0]])
    up = np.array([[0.0, 0.0, 1.0]])
    H, b, cost = normal_equations(one, one - [[5, 5, 0.5]], up, [2.0], np.eye(4), np.zeros(3))
    J = np.array([2.0, -1.0, 0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(H, 2 * np.outer(J, J))
    np.testing.assert_allclose(b, 2 * 0.5 * J)
    assert cost == pytest.approx(0.5)


@given(
    st.lists(st.floats(0, 9, width=32) | st.sampled_from([np.nan, np.inf]), max_size=40), st.floats(0.01, 1.0)
)
def test_trim_keeps_the_smallest(distances, keep):
    d = np.array(distances, dtype=np.float32)
    weights = trim(d, keep)
    finite = np.isfinite(d)
    kept = weights == 1
    assert set(np.unique(weights)) <= {0.0, 1.0}
    assert kept.sum() == min(finite.sum(), max(1, int(keep * len(d))))
    assert not (kept & ~finite).any()
    rest = finite & ~kept
    if kept.any() and rest.any():
        assert d[kept].max() <= d[rest].min()


def test_bad_arguments_are_named():
    cloud = np.zeros((2, 3))
    with pytest.raises(ValueError, match="target"):
        normal_equations(cloud, cloud[:1], None, np.ones(2), np.eye(4), np.zeros(3))
    with pytest.raises(ValueError, match="weights"):
        normal_equations(cloud, cloud, None, np.ones(3), np.eye(4), np.zeros(3))
    with pytest.raises(ValueError, match="centre"):
        normal_equations(cloud, cloud, None, np.ones(2), np.eye(4), [0, 0, np.inf])
    for keep in (0.0, 1.1, np.nan):
        with pytest.raises(ValueError, match="keep"):
            trim(np.ones(3), keep)
