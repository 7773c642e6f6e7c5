"""Walls say where up is, where the ground slopes."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.odometry.gravity import gravity_from_walls

TRUE = np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])


def wall(normal, at, seed=0):
    """Points of an upright wall; upright along TRUE, horizontal along what is square to both."""
    rng = np.random.default_rng(seed)
    n = normal - (normal @ TRUE) * TRUE
    n /= np.linalg.norm(n)
    along = np.cross(TRUE, n)
    a, b = rng.uniform(-10, 10, (2, 3000))
    return at * n + a[:, None] * along + 0.4 * b[:, None] * TRUE + rng.normal(0, 0.01, (3000, 3))


def lean(up):
    return np.degrees(np.arccos(np.clip(up @ TRUE, -1, 1)))


GROUND = np.array([-0.03, 0.02, 1.0]) / np.linalg.norm([-0.03, 0.02, 1.0])  # the normal of a slope


def test_two_walls_correct_a_slope():
    cloud = np.concatenate([wall(np.array([1.0, 0, 0]), 8.0), wall(np.array([0, 1.0, 0]), -9.0)])
    up, count = gravity_from_walls(cloud, GROUND)
    assert lean(GROUND) > 5
    assert lean(up) < 0.3
    assert count > 15
    assert np.linalg.norm(up) == pytest.approx(1.0)


def test_one_wall_corrects_across_it_and_leaves_the_rest():
    up, _ = gravity_from_walls(wall(np.array([1.0, 0, 0]), 8.0), GROUND)
    assert abs(up[0] - TRUE[0]) < 0.01
    assert abs(up[1] - GROUND[1]) < 0.01


def test_without_walls_gravity_is_unchanged():
    flat = np.random.default_rng(0).uniform([-20, -20, -1.7], [20, 20, -1.69], (5000, 3))
    up, count = gravity_from_walls(flat, GROUND)
    assert np.allclose(up, GROUND)
    assert count == 0
    assert np.allclose(gravity_from_walls(np.empty((0, 3)), GROUND)[0], GROUND)


def test_leaning_surfaces_are_outvoted_by_walls():
    cloud = [wall(np.array([1.0, 0, 0]), 8.0), wall(np.array([0, 1.0, 0]), -9.0)]
    cloud.append(wall(np.array([1.0, 0, 0.2]), -8.0)[:600] @ _turn(10.0))
    up, _ = gravity_from_walls(np.concatenate(cloud), GROUND)
    assert lean(up) < 0.6


def _turn(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
