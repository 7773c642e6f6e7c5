"""Distinct poses: the kernel equals its twin, and every pose left out has a better one near it."""

import numpy as np
import pytest

import coview_kernels as ck
from coview_kernels import launch, reference


@pytest.mark.parametrize(("size", "count"), [(1, 5), (300, 40), (300, 1000), (2000, 256)])
def test_chosen_poses_are_apart_and_all_others_near_a_better_one(size, count):
    rng = np.random.default_rng(size)
    positions, yaw = rng.uniform(-30, 30, (size, 3)) * (1, 1, 0.1) + 1e5, rng.uniform(-9, 9, size)
    chosen = ck.distinct_poses(positions, yaw, count, 6.0, 0.4)
    assert len(chosen) == min(count, len(chosen))
    assert (np.diff(chosen) > 0).all()
    apart = np.linalg.norm(positions[:, None] - positions[chosen], axis=2)
    turn = np.abs((yaw[:, None] - yaw[chosen] + np.pi) % (2 * np.pi) - np.pi)
    same = (apart < 6.0) & (turn < 0.4)
    for rank, k in enumerate(chosen):
        assert not same[k, :rank].any()
    considered = chosen[-1] if len(chosen) == count else size
    for k in np.setdiff1d(np.arange(considered), chosen):
        assert same[k, chosen < k].any()


def test_kernel_agrees_with_numpy():
    rng = np.random.default_rng(7)
    for size in (5, 900, 40):
        poses = np.column_stack([rng.integers(-9, 9, (size, 3)), np.cos(n := rng.normal(size=size)), np.sin(n)])
        expected = reference.distinct_poses((poses - [*poses[0, :3], 0, 0]).astype(np.float32), 50, 9.0, np.cos(0.5))
        np.testing.assert_array_equal(ck.distinct_poses(poses[:, :3], n, 50, 3.0, 0.5), expected)


@pytest.mark.skipif(ck.backend() == "numpy", reason="no kernels here")
@pytest.mark.parametrize("known", [True, False])
def test_launch_is_prepared_with_this_library_and_equals_a_public_call(known, monkeypatch):
    if not known:
        monkeypatch.setitem(launch.TESTED_VERSIONS, ck.backend(), ())
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.integers(-9, 9, (80, 3)), np.cos(yaw := rng.normal(size=80)), np.sin(yaw)])
    poses = (poses - [*poses[0, :3], 0, 0]).astype(np.float32)
    kept, chosen, number = np.zeros(100, np.float32), np.zeros(20, np.int32), np.zeros(1, np.int32)
    settings = len(poses), 20, 9.0, float(np.cos(0.5))
    run = launch.Launch("distinct", "distinct", poses.reshape(-1), kept, chosen, number, *settings)
    ck.shutdown()  # the next program has compiled nothing
    for _ in range(2):
        ck.submit(run)
        expected = reference.distinct_poses(poses, 20, 9.0, settings[3])
        np.testing.assert_array_equal(chosen[: number[0]], expected)
    assert run.ready() == known, "add this version to launch.TESTED_VERSIONS once its launch context is tried"


def test_errors_name_the_argument():
    assert len(ck.distinct_poses(np.zeros((0, 3)), [], 4, 1.0, 1.0)) == 0
    with pytest.raises(ValueError, match="positions has shape"):
        ck.distinct_poses(np.zeros((3, 2)), np.zeros(3), 4, 1.0, 1.0)
    with pytest.raises(ValueError, match="yaw has shape"):
        ck.distinct_poses(np.zeros((3, 3)), np.zeros(2), 4, 1.0, 1.0)
    with pytest.raises(ValueError, match="count must"):
        ck.distinct_poses(np.zeros((3, 3)), np.zeros(3), 0, 1.0, 1.0)
