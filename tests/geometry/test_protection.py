"""Protection levels: quantiles of the error's norm under a Student-t with the covariance's shape."""

import math

import numpy as np
import pytest

from coview_stream.geometry import protection
from coview_stream.geometry.protection import OtherHeights, ProtectionLevel, axes_of, protection_level
from coview_stream.geometry.transforms import exp_so3

SHAPES = {"sphere": (1.0, 1.0, 1.0), "pancake": (1.0, 1.0, 1e-4), "needle": (1.0, 1e-4, 1e-4), "mixed": (1.0, 0.3, 0.1)}


def turned(variances):
    R = exp_so3(np.array([0.4, -0.7, 1.1]))
    return R @ np.diag(variances) @ R.T


def pose_covariance(position, angle):
    C = np.zeros((6, 6))
    C[:3, :3], C[3:, 3:] = position, angle
    return C


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("part", ["metres", "degrees"])
def test_level_is_exceeded_once_in_a_hundred_by_student_errors_of_any_shape(shape, part):
    factor, freedom = protection.TAILS[part]
    C = turned(np.array(SHAPES[shape]) * 0.05**2)
    rng = np.random.default_rng(7)
    scale = factor * np.sqrt(freedom / rng.chisquare(freedom, 200_000))
    errors = scale * np.linalg.norm(rng.multivariate_normal(np.zeros(3), C, 200_000), axis=1)
    level = protection_level(pose_covariance(C, C), risk=0.01)
    limit = level.metres if part == "metres" else math.radians(level.degrees)
    assert 0.006 < (errors > limit).mean() < 0.0125


def test_axes_count_from_a_needle_to_a_sphere():
    assert axes_of(np.diag([2.0, 0.0, 0.0])) == (2.0, 1.0)
    trace, axes = axes_of(turned([1.0, 1.0, 1.0]))
    assert (trace, axes) == (pytest.approx(3.0), pytest.approx(3.0))


def test_level_grows_with_the_covariance_with_doubt_and_with_less_risk():
    C = pose_covariance(turned([1e-4, 2e-4, 1e-5]), turned([1e-6, 1e-6, 4e-6]))
    level = protection_level(C)
    for wider in (protection_level(4 * C), protection_level(C, doubt=2.0)):
        assert wider.metres == pytest.approx(2 * level.metres)
        assert wider.degrees == pytest.approx(2 * level.degrees)
    rarer = protection_level(C, risk=1e-5)
    assert rarer.metres > level.metres
    assert rarer.degrees > level.degrees


def test_no_angle_is_above_half_a_turn():
    assert protection_level(100 * np.eye(6)).degrees == 180.0


def test_no_covariance_is_no_error():
    assert protection_level(np.zeros((6, 6))).metres == 0.0


def test_plane_and_height_have_levels_of_their_own_blocks():
    C = pose_covariance(np.diag([0.04, 0.01, 4.0]), np.zeros((3, 3)))
    level = protection_level(C)
    flat = protection_level(pose_covariance(np.diag([0.04, 0.01, 0.0]), np.zeros((3, 3))))
    upright = protection_level(pose_covariance(np.diag([0.0, 0.0, 4.0]), np.zeros((3, 3))))
    assert level.horizontal == flat.horizontal == pytest.approx(flat.metres)
    assert level.vertical == upright.vertical == pytest.approx(upright.metres)
    assert level.horizontal < 2.0 < level.vertical < level.metres


def test_json_has_all_levels():
    level = ProtectionLevel(0.12345, 1.5, 0.1, 0.05)
    assert level.to_json() == {"m": 0.1235, "deg": 1.5, "horizontal_m": 0.1, "vertical_m": 0.05}


def test_other_heights_widen_space_and_height_by_their_reach_and_not_the_plane():
    sure = protection_level(np.diag([0.01, 0.01, 0.04, 1e-4, 1e-4, 1e-4]))
    covariance = np.diag([0.01, 0.01, 0.04 + 0.09, 1e-4, 1e-4, 1e-4])
    level = protection_level(covariance, others=OtherHeights(0.09, 1.2))
    assert level.vertical == pytest.approx(sure.vertical + 1.2)
    assert level.metres == pytest.approx(sure.metres + 1.2)
    assert (level.horizontal, level.degrees) == (pytest.approx(sure.horizontal), pytest.approx(sure.degrees))
