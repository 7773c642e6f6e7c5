"""Rigid transforms: conventions, precision, and what counts as a pose."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from se3 import exp_se3

from coview_stream.geometry import transforms as g

angle = st.floats(-3.1, 3.1)
metre = st.floats(-1e3, 1e3)
twist = st.tuples(angle, st.floats(-1.5, 1.5), angle, metre, metre, metre).map(np.array)


@given(twist)
@settings(max_examples=50, deadline=None)
def test_inverse_composes_to_identity(xi):
    T = exp_se3(xi)
    np.testing.assert_allclose(g.inverse(T) @ T, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(g.inverse(T), np.linalg.inv(T), atol=1e-8)


@given(twist)
@settings(max_examples=50, deadline=None)
def test_tum_pose_round_trip(xi):
    T = exp_se3(xi)
    row = g.pose_to_tum(T)
    np.testing.assert_allclose(row[:3], xi[3:])
    np.testing.assert_allclose(g.pose_from_tum(row), T, atol=1e-9)
    np.testing.assert_allclose(g.pose_from_tum(row * [1, 1, 1, 3, 3, 3, 3]), T, atol=1e-9)


def test_yaw_is_counter_clockwise_and_read_back():
    np.testing.assert_allclose(g.rot_z(np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    for yaw in (-3.0, -0.4, 0.0, 1.0, 3.0):
        assert g.yaw_of(g.pose_from(g.rot_z(yaw), [5, 6, 7])) == pytest.approx(yaw)


def test_tum_quaternion_order_is_x_y_z_w():
    row = g.pose_to_tum(g.pose_from(g.rot_z(np.pi / 2), [1, 2, 3]))
    np.testing.assert_allclose(np.abs(row), [1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


def test_transform_maps_source_to_target_in_dtype_of_points():
    T_map_body = g.pose_from(g.rot_z(np.pi / 2), [10, 20, 30])
    for dtype in (np.float32, np.float64):
        moved = g.transform(T_map_body, np.array([[1, 0, 0], [0, 2, 1]], dtype))
        np.testing.assert_allclose(moved, [[10, 21, 30], [8, 20, 31]], atol=1e-5)
        assert moved.dtype == dtype
    assert g.transform(T_map_body, np.empty((0, 3), np.float32)).shape == (0, 3)


@pytest.mark.parametrize("count", [g._ROWS - 1, g._ROWS, 2 * g._ROWS + 1])
def test_transform_of_many_points_is_that_of_all_at_once(count: int):
    T = g.pose_from(g.rot_z(0.7), [400.0, 2.0, 3.0])
    points = np.random.default_rng(0).uniform(-80.0, 80.0, (count, 3))
    np.testing.assert_allclose(g.transform(T, points), points @ T[:3, :3].T + T[:3, 3], rtol=1e-12, atol=1e-10)
    near = g.transform(T, points.astype(np.float32))
    assert near.dtype == np.float32
    np.testing.assert_allclose(near, g.transform(T, points), atol=1e-3)
    assert 9 * g._ROWS < 262_144  # products from which OpenBLAS starts threads


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-4, 1.0, np.pi / 2, 3.0, np.pi])
def test_rotation_angle_is_exact_near_zero_and_pi(turn):
    assert g.rotation_angle(g.pose_from(g.rot_z(turn), [9, 9, 9])) == pytest.approx(turn, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("given_", "wrapped"), [(0, 0), (np.pi, -np.pi), (-np.pi, -np.pi), (3.5, 3.5 - 2 * np.pi), (-7, -7 + 2 * np.pi)]
)
def test_wrap_angle(given_, wrapped):
    assert g.wrap_angle(given_) == pytest.approx(wrapped)


def test_is_pose_accepts_only_rigid_transforms():
    good = exp_se3(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    assert g.is_pose(good)
    mirrored, scaled, infinite = good @ np.diag([1.0, 1, -1, 1]), good.copy(), good.copy()
    scaled[:3, :3] *= 1.01
    infinite[1, 3] = np.inf
    for bad in (mirrored, scaled, infinite, good[:3], np.zeros((4, 4))):
        assert not g.is_pose(bad)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_norms_equal_numpy_and_keep_the_input(dtype):
    points = np.random.default_rng(1).normal(0, 30, (500, 3)).astype(dtype)
    before, origin = points.copy(), np.array([3.0, -2.0, 1.0], dtype)
    result = g.norms(points), g.norms(points, origin)
    assert result[0].dtype == result[1].dtype == dtype
    np.testing.assert_allclose(result[0], np.linalg.norm(points, axis=1), rtol=1e-6)
    np.testing.assert_allclose(result[1], np.linalg.norm(points - origin, axis=1), rtol=1e-6)
    np.testing.assert_array_equal(points, before)
    assert g.norms(points[:0]).shape == (0,)


def test_interpolation_turns_at_a_constant_rate_and_extrapolates():
    start, end = g.pose_from(g.rot_z(0.2), [1, 2, 3]), g.pose_from(g.rot_z(0.6), [3, 2, 1])
    shares = np.array([-0.5, 0.0, 0.25, 1.0])
    several = g.interpolate(np.tile(start, (4, 1, 1)), np.tile(end, (4, 1, 1)), shares)
    for share, T in zip(shares, several, strict=True):
        expected = g.pose_from(g.rot_z(0.2 + 0.4 * share), [1 + 2 * share, 2, 3 - 2 * share])
        np.testing.assert_allclose(T, expected, atol=1e-12)
        np.testing.assert_allclose(g.interpolate(start, end, share), expected, atol=1e-12)


RNG = np.random.default_rng(3)
VECTORS = np.concatenate(
    [
        RNG.normal(size=(200, 3)),
        RNG.normal(size=(50, 3)) * 1e-7,
        RNG.normal(size=(20, 3)) * 1e-12,
        np.zeros((1, 3)),
        np.pi * np.eye(3),
        (np.pi - 1e-9) * np.eye(3),
        -np.pi * np.eye(3)[::-1],
        (np.pi / np.sqrt(2)) * np.array([[1.0, 1, 0], [0, -1, 1], [1, 0, -1]]),
    ]
)


def test_exp_so3_matches_scipy():
    np.testing.assert_allclose(g.exp_so3(VECTORS), Rotation.from_rotvec(VECTORS).as_matrix(), atol=1e-15)
    for vector in VECTORS[-12:]:
        np.testing.assert_allclose(g.exp_so3(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


def test_quaternion_round_trip():
    R = Rotation.from_rotvec(VECTORS).as_matrix()
    q = g.matrix_to_quat(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)
    theirs = Rotation.from_matrix(R).as_quat()
    np.testing.assert_allclose(np.abs((q * theirs).sum(axis=1)), 1.0, atol=1e-14)
    np.testing.assert_allclose(g.quat_to_matrix(q), R, atol=1e-14)
    np.testing.assert_allclose(g.quat_to_matrix(-7.0 * q), R, atol=1e-14)
    np.testing.assert_array_equal(g.matrix_to_quat(R[0]), q[0])
    assert g.matrix_to_quat(R[:0]).shape == (0, 4)
    assert g.quat_to_matrix(np.empty((0, 4))).shape == (0, 3, 3)


def test_log_so3_matches_scipy():
    R = Rotation.random(200, random_state=5)
    np.testing.assert_allclose(g.log_so3(R.as_matrix()), R.as_rotvec(), atol=1e-9)
    for single in R:
        np.testing.assert_allclose(g.log_so3(single.as_matrix()), single.as_rotvec(), atol=1e-9)
    np.testing.assert_array_equal(g.log_so3(np.eye(3)), np.zeros(3))


def test_slerp_matches_scipy():
    R = Rotation.from_rotvec(VECTORS[:270]).as_matrix()
    start, end, share = R[:-1], R[1:], RNG.random(len(R) - 1)
    result = g.slerp(start, end, share)
    for k in range(len(start)):
        path = Slerp([0.0, 1.0], Rotation.from_matrix(R[k : k + 2]))
        np.testing.assert_allclose(result[k], path(share[k]).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(g.slerp(start, end, np.zeros(len(start))), start, atol=1e-15)
    np.testing.assert_allclose(g.slerp(start, end, np.ones(len(start))), end, atol=1e-13)
    np.testing.assert_allclose(g.slerp(start[3], end[3], 0.25), g.slerp(start[3:4], end[3:4], [0.25])[0])


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-3])
def test_nearest_rotation_is_a_rotation(noise):
    R = Rotation.from_rotvec(VECTORS).as_matrix()
    result = g.nearest_rotation(R + RNG.normal(size=R.shape) * noise)
    np.testing.assert_allclose(result @ np.swapaxes(result, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(result, R, atol=10 * noise + 1e-14)
    assert (np.linalg.det(result) > 0).all()


T = g.pose_from(g.exp_so3([0.4, -0.7, 1.9]), [300.0, -200.0, 12.0])


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
    gaps = np.array([g.boxminus(T @ exp_se3(xi), T) for xi in draws[:4000]])
    predicted = g.along_map(body, T)
    sigma = np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(np.cov(gaps.T) / np.outer(sigma, sigma), predicted / np.outer(sigma, sigma), atol=0.06)


def test_body_and_map_axes_conversions_are_inverse():
    C = random_covariance(3)
    np.testing.assert_allclose(g.along_body(g.along_map(C, T), T), C, atol=1e-16)
    assert np.abs(g.along_map(C, T) - C).max() > 1e-5


def test_gtsam_tangent_is_the_body_tangent():
    gtsam = pytest.importorskip("gtsam", reason="the oracle of this test")
    xi = np.array([0.02, -0.01, 0.03, 0.1, 0.2, -0.1])
    pose = gtsam.Pose3(T)
    np.testing.assert_allclose(pose.retract(xi).matrix(), T @ exp_of(xi), atol=1e-9)
    np.testing.assert_allclose(pose.localCoordinates(pose.retract(xi)), xi, atol=1e-12)
    np.testing.assert_allclose(g.adjoint(T), pose.AdjointMap(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.029, 0.031, 0.3, 2.5, 3.1])
def test_logarithm_of_a_pose_and_its_derivative(angle):
    xi = np.array([0.48 * angle, -0.64 * angle, 0.6 * angle, 1.0, 2.0, -3.0])
    T = exp_of(xi)
    found, D = g.log_se3(np.stack([T, T]))
    np.testing.assert_allclose(found[1], xi, atol=1e-8)
    for column in range(6):
        step = 1e-5 * np.eye(6)[column]
        ahead, behind = (g.log_se3(T @ exp_of(sign * step))[0] for sign in (1, -1))
        np.testing.assert_allclose(D[1][:, column], (ahead - behind) / 2e-5, atol=2e-6)
        np.testing.assert_allclose(g.moved(T, 0.1 * step), T @ exp_of(0.1 * step), atol=1e-11)
    np.testing.assert_allclose(g.relative(T, T @ exp_of(step)), exp_of(step), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 2.5, np.pi - 1e-6])
def test_boxplus_and_boxminus_are_inverse(angle):
    step = np.array([0.0, 0.6 * angle, -0.8 * angle, 1.0, 2.0, -3.0])
    np.testing.assert_allclose(g.boxminus(g.boxplus(T, step), T), step, atol=1e-9)
