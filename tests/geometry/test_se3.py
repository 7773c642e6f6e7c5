"""The two tangents name the same motions, those of gtsam."""

from __future__ import annotations

import numpy as np
import pytest
from se3 import exp_se3

from coview_stream.geometry.transforms import adjoint, along_body, along_map, boxminus, boxplus, exp_so3, pose_from

T = pose_from(exp_so3([0.4, -0.7, 1.9]), [300.0, -200.0, 12.0])


def random_covariance(seed=0, scale=0.01):
    A = np.random.default_rng(seed).standard_normal((6, 8)) * scale
    return A @ A.T


def exp_of(xi):
    """The exponential by its definition, sixty times squared."""
    A = np.zeros((4, 4))
    A[:3, :3] = np.array([[0, -xi[2], xi[1]], [xi[2], 0, -xi[0]], [-xi[1], xi[0], 0]])
    A[:3, 3] = xi[3:]
    M = np.eye(4) + A / 2**20 + 0.5 * (A @ A) / 2**40
    for _ in range(20):
        M = M @ M
    return M


@pytest.mark.slow
def test_body_axes_covariance_matches_sampled_motions():
    """Samples drawn in the body's tangent scatter along the map's axes as the converted covariance says."""
    body = random_covariance()
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(6), body, 20_000)
    gaps = np.array([boxminus(T @ exp_se3(xi), T) for xi in draws[:4000]])
    predicted = along_map(body, T)
    sigma = np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(np.cov(gaps.T) / np.outer(sigma, sigma), predicted / np.outer(sigma, sigma), atol=0.06)


def test_body_and_map_axes_conversions_are_inverse():
    C = random_covariance(3)
    np.testing.assert_allclose(along_body(along_map(C, T), T), C, atol=1e-16)
    assert np.abs(along_map(C, T) - C).max() > 1e-5


def test_gtsam_tangent_is_the_body_tangent():
    import gtsam

    xi = np.array([0.02, -0.01, 0.03, 0.1, 0.2, -0.1])
    pose = gtsam.Pose3(T)
    np.testing.assert_allclose(pose.retract(xi).matrix(), T @ exp_of(xi), atol=1e-9)
    np.testing.assert_allclose(pose.localCoordinates(pose.retract(xi)), xi, atol=1e-12)
    np.testing.assert_allclose(adjoint(T), pose.AdjointMap(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 2.5, np.pi - 1e-6])
def test_boxplus_and_boxminus_are_inverse(angle):
    step = np.array([0.0, 0.6 * angle, -0.8 * angle, 1.0, 2.0, -3.0])
    np.testing.assert_allclose(boxminus(boxplus(T, step), T), step, atol=1e-9)


def test_adjoint_moves_increment_to_the_other_side():
    xi = np.array([0.1, -0.05, 0.2, 0.5, 0.3, -0.4])
    np.testing.assert_allclose(T @ exp_of(xi), exp_of(adjoint(T) @ xi) @ T, atol=1e-6)
