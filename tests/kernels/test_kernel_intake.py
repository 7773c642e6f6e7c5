from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds, poses, run_python

from coview_kernels import FrameIntake, backend, reference, shutdown, sieve

BINS = (20, 60, 50.0)


def assert_taken(frame, points, T, limits, bins=None, centre=None):
    expected, dropped = reference.transform_unique(points, T, *limits)
    np.testing.assert_array_equal(frame.points, expected)
    assert frame.points.dtype == np.float32
    assert frame.dropped == dropped
    if bins is None:
        assert frame.grid is None
        return
    grid, _ = reference.polar_bin(expected, T[:3, 3] if centre is None else np.array(centre), *bins)
    np.testing.assert_array_equal(frame.grid.count, grid.count)
    np.testing.assert_array_equal(frame.grid.max_height, grid.max_height)
    np.testing.assert_allclose(frame.grid.sum_height, grid.sum_height, rtol=1e-6, atol=1e-6)


@given(
    st.lists(st.tuples(clouds(), poses()), min_size=1, max_size=4),
    st.sampled_from([-1.0, 0.0, 0.1, 0.5, 2.5]),
    st.sampled_from([(0.0, np.inf), (5.0, 30.0)]),
    st.sampled_from([None, (3, 4, 20.0), BINS]),
)
def test_agrees_with_numpy_frame_after_frame(frames, voxel, limits, bins):
    take = FrameIntake(voxel, *limits, bins)
    for points, T in frames:
        assert_taken(take(points, T), points, T, (voxel, *limits), bins)


def test_the_first_point_wins():
    """Every voxel is hit again and again."""
    rng = np.random.default_rng(3)
    points = np.tile(rng.uniform(-10, 10, (5_000, 3)), (8, 1)).astype(np.float32)
    points += rng.uniform(-0.2, 0.2, points.shape).astype(np.float32)
    points[::999] = np.nan
    T = np.eye(4)
    T[:3, 3] = 3.0, -4.0, 0.5
    take = FrameIntake(0.5, 2.0, 12.0, BINS)
    for n in (40_000, 5_000, 0, 39_999):
        assert_taken(take(points[:n], T, (1, 2, 3)), points[:n], T, (0.5, 2.0, 12.0), BINS, (1.0, 2.0, 3.0))


@pytest.mark.parametrize("spread", [0.1, 3.0, 400.0])
def test_tables_grow_with_the_space_that_a_cloud_fills(spread):
    """From few cubes of 4 x 4 x 4 voxels to one for each point."""
    points = np.random.default_rng(9).normal(0, spread, (20_000, 3)).astype(np.float32)
    take = FrameIntake(0.1, bins=BINS)
    for n in (1, 20_000, 63, 64, 65):
        assert_taken(take(points[:n], np.eye(4)), points[:n], np.eye(4), (0.1,), BINS)


def test_the_farthest_voxels_within_reach():
    """16 bits an axis, around the voxel of the sensor."""
    least, most = -(1 << 15), (1 << 15) - 1
    corners = np.array(np.meshgrid(*[[least, -1, 0, most]] * 3), dtype=float).reshape(3, -1).T
    points = np.concatenate([corners + 0.25, corners + 0.75]).astype(np.float32)
    T = np.eye(4)
    for sensor in (0.0, 1000.0):
        T[:3, 3] = sensor
        take = FrameIntake(1.0)
        assert_taken(take(points, T), points, T, (1.0,))
        assert len(take(points, T).points) == 64
        for step in (least - 1, most + 1):
            far = np.append(points, np.full((1, 3), step, np.float32), axis=0)
            assert_taken(take(far, T), far, T, (1.0,))


def scan(rng, n=30_000):
    return (rng.normal(0.0, 15.0, (n, 3)) * [1.0, 1.0, 0.1]).astype(np.float32)


def test_a_steady_stream_allocates_no_arrays():
    rng = np.random.default_rng(4)
    frames = [scan(rng) for _ in range(5)]
    take = FrameIntake(0.3, 0.5, 80.0, BINS)
    T = np.eye(4)
    if backend() == "numpy":
        pytest.skip("NumPy allocates")
    for frame in frames:
        take(frame, T)
    homes = {take(frame, T).points.__array_interface__["data"][0] for frame in frames}
    assert len(homes) == 1
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for k in range(100):
            T[0, 3] = k
            taken = take(frames[k % 5], T)
        _, peak = tracemalloc.get_traced_memory()
        gc.collect()  # launches of quadrants leave cycles
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(taken.points) > 10_000
    # a frame has 360 kB; views, numbers and the job in the queue are all there is, and 20 kB of a quadrants launch
    assert peak - before < 32_000
    assert after - before < 8_000


def test_what_is_kept_from_a_frame_is_overwritten_by_the_next():
    rng = np.random.default_rng(5)
    take = FrameIntake(0.3)
    if backend() == "numpy":
        pytest.skip("NumPy returns arrays of its own")
    first = take(scan(rng), np.eye(4)).points
    kept = first.copy()
    take(scan(rng), np.eye(4))
    assert not np.array_equal(first, kept)


def test_more_frames_than_a_key_can_count(monkeypatch):
    monkeypatch.setattr(sieve, "_GENERATIONS", 4)
    rng = np.random.default_rng(6)
    take = FrameIntake(0.5)
    for _ in range(10):
        points = scan(rng, 3_000)
        assert_taken(take(points, np.eye(4)), points, np.eye(4), (0.5,))


def test_voxels_far_from_the_sensor_agree_too():
    T = np.eye(4)
    T[0, 3] = 1e6  # the sensor may be anywhere, its points are what must be near it
    near = np.array([[1, 0, 0], [1, 0, 0], [70, 0, 0]], dtype=np.float32)
    take = FrameIntake(0.5)
    assert_taken(take(near, T), near, T, (0.5,))
    far = np.array([[1e6, 0, 0], [1e6, 0, 0], [-1e30, 0, 0], [0, 0, 0]], dtype=np.float32)
    assert_taken(take(far, T), far, T, (0.5,))
    assert_taken(take(near, T), near, T, (0.5,))


def test_more_sectors_than_the_kernel_tells_apart():
    points = scan(np.random.default_rng(7), 2_000)
    bins = (2, 4_000, 30.0)
    assert_taken(FrameIntake(0.5, bins=bins)(points, np.eye(4)), points, np.eye(4), (0.5,), bins)


def test_goes_on_after_a_shutdown():
    points = scan(np.random.default_rng(8), 2_000)
    take = FrameIntake(0.5, bins=BINS)
    for _ in range(2):
        assert_taken(take(points, np.eye(4)), points, np.eye(4), (0.5,), BINS)
        shutdown()


@pytest.mark.parametrize("name", ["quadrants", "numpy"])
def test_other_backends_agree(name):
    done = run_python(
        "import numpy as np; from coview_kernels import FrameIntake, reference\n"
        "take = FrameIntake(0.5, 1.0, 30.0, (20, 60, 50.0)); rng = np.random.default_rng(1)\n"
        "for _ in range(3):\n"
        "    points = rng.normal(0, 10, (9000, 3)).astype(np.float32); frame = take(points, np.eye(4))\n"
        "    expected = reference.transform_unique(points, np.eye(4), 0.5, 1.0, 30.0)[0]\n"
        "    assert np.array_equal(frame.points, expected)\n"
        "    grid = reference.polar_bin(expected, np.zeros(3), 20, 60, 50.0)[0]\n"
        "    assert np.array_equal(frame.grid.max_height, grid.max_height)",
        COVIEW_KERNELS=name,
    )
    if "unset it" in done.stderr:
        pytest.skip(f"{name} is not installed")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "name"),
    [((np.nan,), "voxel"), ((1.0, -1.0), "r_min"), ((1.0, 0.0, 9.0, (0, 4, 5.0)), "rings")],
)
def test_bad_limits_are_named(arguments, name):
    with pytest.raises(ValueError, match=name):
        FrameIntake(*arguments)


def test_bad_frames_are_named():
    take = FrameIntake(1.0)
    with pytest.raises(ValueError, match="points"):
        take(np.zeros((3, 2)), np.eye(4))
    with pytest.raises(ValueError, match="T has"):
        take(np.zeros((3, 3)), np.eye(3))
    with pytest.raises(ValueError, match="centre"):
        take(np.zeros((3, 3)), np.eye(4), (0, 0, np.inf))
