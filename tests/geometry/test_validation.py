"""Checks of clouds, poses and covariances."""

import numpy as np
import pytest

from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.geometry.validation import check_covariance, check_rigid, check_stamp, cloud_rows, finite_rows


def test_cloud_with_intensities_is_its_first_three_columns():
    rows = np.arange(16, dtype=np.float32).reshape(4, 4)
    np.testing.assert_array_equal(cloud_rows(rows), rows[:, :3])


@pytest.mark.parametrize(
    ("bad", "remedy"),
    [
        *((bad, "cloud") for bad in (None, np.zeros(3), np.zeros((4, 2)), [["a", "b", "c"]], [[1, 2, 3], [4]])),
        *((np.ones((20, 3), kind), "not an array of numbers") for kind in (bool, complex, "datetime64[s]")),
        (np.zeros((9, 6)), r"\(9, 6\); expected .*: give cloud\[:, :3\]$"),
        (np.zeros((3, 900)), r"give cloud\.T$"),
        (np.zeros((16, 900, 3)), r"give cloud\[\.\.\., :3\]\.reshape\(-1, 3\)$"),
    ],
)
def test_cloud_of_another_shape_or_without_numbers_is_refused_with_a_remedy(bad, remedy):
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


MOVED = np.array([[1.0, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("bad", "flaw"),
    [
        (np.eye(3), "it has shape"),
        (np.full((4, 4), np.nan), "it holds NaN"),
        (np.diag([2.0, 1, 1, 1]), "not orthonormal"),
        (np.diag([1.0, 1, -1, 1]), "it mirrors"),
        (MOVED.T, "it is transposed"),
        (MOVED + np.diag([0.0, 0, 0, 1]), "its last row is"),
    ],
)
def test_invalid_pose_is_refused_by_name_and_flaw(bad, flaw):
    with pytest.raises(InputError, match=f"T_here is not a rigid transform: .*{flaw}"):
        check_rigid(bad, "T_here")


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
