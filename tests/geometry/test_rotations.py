import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from coview_stream.geometry.transforms import exp_so3, log_so3, matrix_to_quat, nearest_rotation, quat_to_matrix, slerp

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
    np.testing.assert_allclose(exp_so3(VECTORS), Rotation.from_rotvec(VECTORS).as_matrix(), atol=1e-15)
    for vector in VECTORS[-12:]:
        np.testing.assert_allclose(exp_so3(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


def test_quaternion_round_trip():
    R = Rotation.from_rotvec(VECTORS).as_matrix()
    q = matrix_to_quat(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)
    theirs = Rotation.from_matrix(R).as_quat()
    np.testing.assert_allclose(np.abs((q * theirs).sum(axis=1)), 1.0, atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(q), R, atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(-7.0 * q), R, atol=1e-14)
    np.testing.assert_array_equal(matrix_to_quat(R[0]), q[0])
    assert matrix_to_quat(R[:0]).shape == (0, 4)
    assert quat_to_matrix(np.empty((0, 4))).shape == (0, 3, 3)


def test_log_so3_matches_scipy():
    R = Rotation.random(200, random_state=5)
    np.testing.assert_allclose(log_so3(R.as_matrix()), R.as_rotvec(), atol=1e-9)
    np.testing.assert_array_equal(log_so3(np.eye(3)), np.zeros(3))


def test_slerp_matches_scipy():
    R = Rotation.from_rotvec(VECTORS[:270]).as_matrix()
    start, end, share = R[:-1], R[1:], RNG.random(len(R) - 1)
    found = slerp(start, end, share)
    for k in range(len(start)):
        path = Slerp([0.0, 1.0], Rotation.from_matrix(R[k : k + 2]))
        np.testing.assert_allclose(found[k], path(share[k]).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(slerp(start, end, np.zeros(len(start))), start, atol=1e-15)
    np.testing.assert_allclose(slerp(start, end, np.ones(len(start))), end, atol=1e-13)
    np.testing.assert_allclose(slerp(start[3], end[3], 0.25), slerp(start[3:4], end[3:4], [0.25])[0])


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-3])
def test_nearest_rotation_is_a_rotation(noise):
    R = Rotation.from_rotvec(VECTORS).as_matrix()
    found = nearest_rotation(R + RNG.normal(size=R.shape) * noise)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(found, R, atol=10 * noise + 1e-14)
    assert (np.linalg.det(found) > 0).all()
