"""Surfaces of clouds."""

from __future__ import annotations

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
