"""Checks of clouds, poses and covariances."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.geometry.validation import check_covariance, check_rigid, check_stamp, cloud_rows, finite_rows


@pytest.mark.parametrize(
    "bad", [None, np.zeros(3), np.zeros((4, 2)), np.zeros((4, 5)), [["a", "b", "c"]], [[1, 2, 3], [4]]]
)
def test_cloud_of_another_shape_or_without_numbers_is_refused(bad):
    with pytest.raises(CloudError, match="cloud"):
        cloud_rows(bad)


def test_cloud_with_intensities_is_its_first_three_columns():
    rows = np.arange(16, dtype=np.float32).reshape(4, 4)
    np.testing.assert_array_equal(cloud_rows(rows), rows[:, :3])


@pytest.mark.parametrize(
    ("bad", "remedy"),
    [
        (np.zeros((9, 6)), r"\(9, 6\); expected .*: give cloud\[:, :3\]$"),
        (np.zeros((3, 900)), r"give cloud\.T$"),
        (np.zeros((16, 900, 3)), r"give cloud\[\.\.\., :3\]\.reshape\(-1, 3\)$"),
    ],
)
def test_cloud_of_another_shape_is_refused_with_what_to_give(bad, remedy):
    with pytest.raises(CloudError, match=remedy):
        cloud_rows(bad)


def test_finite_rows_are_a_copy_with_the_mask():
    rows = np.arange(12, dtype=np.float32).reshape(4, 3)
    copy, mask = finite_rows(rows)
    assert mask is None
    assert not np.shares_memory(copy, rows)
    rows[1, 2] = np.inf
    finite, mask = finite_rows(rows)
    assert mask.tolist() == [True, False, True, True]
    np.testing.assert_array_equal(finite, rows[mask])


@pytest.mark.parametrize("bad", [np.eye(3), np.full((4, 4), np.nan), np.diag([2.0, 1, 1, 1])])
def test_invalid_pose_is_refused_by_name(bad):
    with pytest.raises(InputError, match="T_here"):
        check_rigid(bad, "T_here")


def test_transposed_pose_is_refused_and_called_so():
    T = np.eye(4)
    T[:3, 3] = 5.0, 6.0, 7.0
    with pytest.raises(InputError, match="T_here is no rigid transform: it is transposed"):
        check_rigid(T.T, "T_here")
    T[3, 0] = 1.0
    with pytest.raises(InputError, match="its last row is"):
        check_rigid(T, "T_here")


@pytest.mark.parametrize("bad", [np.ones((20, 3), bool), np.ones((20, 3), complex), np.ones((20, 3), "datetime64[s]")])
def test_cloud_of_no_real_numbers_is_refused(bad):
    with pytest.raises(CloudError, match="not an array of numbers"):
        cloud_rows(bad)


@pytest.mark.parametrize(
    ("stamp", "says"),
    [
        (1_795_000_000_000_000_000, "milli- or nanoseconds"),
        (1.795e12, "milli- or nanoseconds"),
        (np.datetime64("2026-11-23T10:00:00"), "not numeric"),
        (True, "not numeric"),
        ("12.5", "not numeric"),
        (float("nan"), "finite"),
        (10.0, "is that of the frame before"),
        (9.5, "is before that of the frame before"),
    ],
)
def test_stamp_that_is_not_in_seconds_or_not_later_is_refused(stamp, says):
    with pytest.raises(RunError, match=says):
        check_stamp(stamp, newest=10.0)


def test_stamps_of_any_clock_in_seconds_are_taken():
    for stamp in (0, -3.0, np.float32(12.5), np.int64(13), 1_795_000_000.25):
        check_stamp(stamp)
    check_stamp(10.01, newest=10.0)


@pytest.mark.parametrize(
    "bad", [np.eye(5), np.full((6, 6), np.inf), np.zeros((6, 6)), np.diag([1.0, 1, 1, 1, 1, -1]), np.ones((6, 6))]
)
def test_invalid_covariance_is_refused_by_name(bad):
    with pytest.raises(InputError, match="spread"):
        check_covariance(bad, "spread")


def test_covariance_with_sigmas_of_very_different_size_is_valid():
    check_covariance(np.diag([1e-12, 1e-12, 1e-12, 1e4, 1e4, 1e4]), "spread")
