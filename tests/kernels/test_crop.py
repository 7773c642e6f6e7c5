"""Crops: exactly those of the NumPy twin, in the same order."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds

from coview_kernels import Cut, PointGrid, crop_points, nearest, reference


def packed(rng, count):
    return rng.integers(-127, 128, (count, 3)).astype(np.int8)


def assert_same(ours, plain):
    assert (ours is None) == (plain is None)
    if ours is None:
        return
    for name in ("points", "normals"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(plain, name))
    for a, b in zip(ours.cells, plain.cells, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
@given(clouds(), st.integers(0, 2**32 - 1), st.sampled_from([2.0, 30.0, 500.0]))
def test_kernel_agrees_with_numpy(cloud, seed, radius):
    rng = np.random.default_rng(seed)
    cloud = np.where(np.abs(cloud) < 1e6, cloud, np.nan).astype(np.float32)
    ends = np.sort(rng.integers(0, len(cloud) + 1, 8)).reshape(-1, 2)  # some of the cloud, empty stretches too
    cut = Cut(*rng.uniform(-20, 20, 2).tolist(), radius)
    normals = packed(rng, len(cloud))
    ours = crop_points(cloud, normals, ends, cut)
    assert_same(ours, reference.crop_points(cloud, normals, ends.astype(np.int32), cut))
    if ours is not None:
        near = np.concatenate([cloud[begin:end] for begin, end in ends])
        near = near[np.hypot(near[:, 0] - cut.x, near[:, 1] - cut.y) < radius - 1e-3]
        near = near[np.isfinite(near).all(axis=1)]
        grid = PointGrid.sorted(ours.points, ours.cells)
        distance, index = nearest(grid, near, 1.0)
        assert not len(near) or distance.max() == 0
        np.testing.assert_array_equal(ours.points[index], near)


def test_nothing_there():
    cloud = np.zeros((3, 3), dtype=np.float32)
    normals = np.zeros((3, 3), dtype=np.int8)
    assert crop_points(cloud, normals, [[0, 3]], Cut(50.0, 0.0, 1.0)) is None
    assert crop_points(cloud, normals, [], Cut(0.0, 0.0, 1.0)) is None


def test_bad_arguments_are_named():
    cloud, normals = np.zeros((3, 3), dtype=np.float32), np.zeros((3, 3), dtype=np.int8)
    good = Cut(0.0, 0.0, 1.0)
    for arguments, name in [
        ((cloud.astype(float), normals, [[0, 3]], good), "points"),
        ((cloud, normals[:2], [[0, 3]], good), "normals"),
        ((cloud, normals, [[0, 4]], good), "spans"),
        ((cloud, normals, [[0, 3], [3, 0]], good), "spans"),
        ((cloud, normals, [[0, 3], [1, 2]], good), "once"),
        ((cloud, normals, [[0, 3]] * 1000, good), "once"),
        ((cloud, normals, [[0, 3]], good._replace(radius=0.0)), "radius"),
    ]:
        with pytest.raises(ValueError, match=name):
            crop_points(*arguments)
