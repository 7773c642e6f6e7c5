"""Rigid transforms: conventions, precision, and what counts as a pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
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


def test_exp_se3_rotates_then_translates():
    T = exp_se3(np.array([0, 0, np.pi / 2, 1, 0, 0]))
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 1, 0, 1], atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-4, 1.0, np.pi / 2, 3.0, np.pi])
def test_rotation_angle_is_exact_near_zero_and_pi(turn):
    assert g.rotation_angle(g.pose_from(g.rot_z(turn), [9, 9, 9])) == pytest.approx(turn, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("given_", "wrapped"), [(0, 0), (np.pi, -np.pi), (-np.pi, -np.pi), (3.5, 3.5 - 2 * np.pi), (-7, -7 + 2 * np.pi)]
)
def test_wrap_angle(given_, wrapped):
    assert g.wrap_angle(given_) == pytest.approx(wrapped)


def test_orthonormalize_removes_accumulated_rounding():
    T = exp_se3(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    tired = T.copy()
    tired[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    fresh = g.orthonormal(tired)
    np.testing.assert_allclose(fresh[:3, :3] @ fresh[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(fresh, T, atol=1e-3)


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
    found = g.norms(points), g.norms(points, origin)
    assert found[0].dtype == found[1].dtype == dtype
    np.testing.assert_allclose(found[0], np.linalg.norm(points, axis=1), rtol=1e-6)
    np.testing.assert_allclose(found[1], np.linalg.norm(points - origin, axis=1), rtol=1e-6)
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
