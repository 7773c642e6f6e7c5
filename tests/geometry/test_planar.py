"""Planar motions are those of poses."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from coview_stream.geometry.planar import (
    between,
    compose,
    inverted,
    planar_covariance,
    planar_motion,
    planar_pose,
    smoothly_between,
    spatial,
)
from coview_stream.geometry.transforms import inverse


@pytest.fixture
def motions():
    return np.random.default_rng(3).normal(0.0, [5.0, 5.0, 1.5], (2, 40, 3))


def test_motions_compose_as_poses_do(motions):
    a, b = motions
    for k in range(len(a)):
        expected = spatial(a[k]) @ spatial(b[k])
        assert spatial(compose(a, b)[k]) == pytest.approx(expected)
        assert spatial(inverted(a)[k]) == pytest.approx(inverse(spatial(a[k])))
        assert between(a[k], b[k]) == pytest.approx(planar_motion(spatial(a[k]), spatial(b[k])))
        assert planar_pose(expected) == pytest.approx(compose(a[k], b[k]))


def test_motions_between_every_two_poses(motions):
    a, b = motions
    every = between(a[:, None], b[None, :7])
    assert every.shape == (40, 7, 3)
    assert every[11, 5] == pytest.approx(between(a[11], b[5]))
    assert compose(a[11], every[11, 5])[:2] == pytest.approx(b[5][:2])


def test_a_covariance_turns_into_the_axes_of_the_pose():
    covariance = np.diag([9.0, 9.0, 0.1, 1.0, 4.0, 9.0])
    covariance[3, 2] = covariance[2, 3] = 0.2  # the map's x, with the heading
    left = planar_covariance(covariance, spatial(np.array([5.0, 6.0, np.pi / 2])))
    assert left == pytest.approx(np.array([[4.0, 0.0, 0.0], [0.0, 1.0, -0.2], [0.0, -0.2, 0.1]]))


def test_smoothly_between_is_hermites_cubic():
    rng = np.random.default_rng(4)
    stamps, poses = np.cumsum(rng.uniform(0.01, 1.0, 30)), rng.normal(size=(30, 3))
    at = np.array([stamps[0], 0.3 * stamps[3] + 0.7 * stamps[4], stamps[7], stamps[-1]])
    expected = CubicHermiteSpline(stamps, poses, np.gradient(poses, stamps, axis=0))(at)
    np.testing.assert_allclose(smoothly_between(at, stamps, poses), expected, atol=1e-12)
