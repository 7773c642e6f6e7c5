"""The virtual robot of the real plot: it walks on the ground, and sees nothing that something nearer hides."""

from __future__ import annotations

import numpy as np

from bench.forest.plot_walk import walk
from coview_stream.geometry.transforms import transform


def scan():
    """Flat ground of 26 m, a dense wall 9 m from the middle, and another two metres behind it."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-13, 13, (20_000, 2)), np.zeros(20_000)])
    along, up = rng.uniform(-3, 3, 30_000), rng.uniform(0, 3, 30_000)
    return np.concatenate([ground, *(np.column_stack([np.full(30_000, x), along, up]) for x in (9.0, 11.0))])


def test_walks_on_the_ground_and_sees_no_hidden_wall():
    way = walk(scan(), 1, np.radians(30.0))
    assert 37.0 < way.driven[-1] < 38.5
    np.testing.assert_allclose(way.truth[:, 2, 3], 1.2, atol=0.05)
    nearest = int(way.truth[:, 0, 3].argmax())  # in front of the walls
    seen = transform(way.truth[nearest], way.clouds[nearest])
    middle = (np.abs(seen[:, 1]) < 1.0) & (seen[:, 2] > 0.5)
    assert (np.abs(seen[middle, 0] - 9.0) < 0.2).sum() > 100
    assert (np.abs(seen[middle, 0] - 11.0) < 0.2).sum() < 0.02 * middle.sum()


def test_the_same_seed_walks_the_same_way():
    one, two = (walk(scan(), 4, np.radians(20.0)) for _ in range(2))
    np.testing.assert_array_equal(one.odometry, two.odometry)
    np.testing.assert_array_equal(one.clouds[5], two.clouds[5])
