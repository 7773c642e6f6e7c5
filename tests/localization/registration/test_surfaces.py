"""Surfaces of clouds."""

import numpy as np

from coview_stream.localization.registration.surfaces import surface_points


def test_surface_points_have_the_normals_of_their_surfaces():
    rng = np.random.default_rng(2)
    wall = np.column_stack([np.full(4000, 3.02), rng.uniform(-5, 5, 4000), rng.uniform(0, 5, 4000)])
    bush = rng.uniform(-4.0, -1.0, (2000, 3))
    points, normals = surface_points(np.concatenate([wall, bush]).astype(np.float32))
    on_wall = points[:, 0] > 0
    assert on_wall.sum() > 3500
    assert (~on_wall).sum() < 200
    np.testing.assert_allclose(np.abs(normals[on_wall, 0]), 1.0, atol=1e-4)


def test_points_along_one_ring_are_no_surface():
    """Beyond some ten metres a cubic metre holds one ring of a sparse lidar, whose noise would choose the normals."""
    rng = np.random.default_rng(3)
    ring = np.column_stack([np.linspace(0.1, 0.9, 40), np.full(40, 5.5), np.full(40, 0.5)])
    ring += rng.normal(0.0, [0.0, 0.02, 0.005], ring.shape)
    assert not len(surface_points(ring.astype(np.float32))[0])
    two = np.concatenate([ring, ring + np.array([0.0, 0.0, 0.3])])
    assert len(surface_points(two.astype(np.float32))[0]) == len(two)
