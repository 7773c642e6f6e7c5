"""Checks of clouds, poses and covariances."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.errors import CloudError, InputError
from coview_stream.geometry.validation import check_covariance, check_rigid, cloud_rows, finite_rows


@pytest.mark.parametrize(
    "bad", [None, np.zeros(3), np.zeros((4, 2)), np.zeros((4, 5)), [["a", "b", "c"]], [[1, 2, 3], [4]]]
)
def test_cloud_of_another_shape_or_without_numbers_is_refused(bad):
    with pytest.raises(CloudError, match="cloud"):
        cloud_rows(bad, columns=(3, 4))


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


@pytest.mark.parametrize(
    "bad", [np.eye(5), np.full((6, 6), np.inf), np.zeros((6, 6)), np.diag([1.0, 1, 1, 1, 1, -1]), np.ones((6, 6))]
)
def test_invalid_covariance_is_refused_by_name(bad):
    with pytest.raises(InputError, match="spread"):
        check_covariance(bad, "spread")


def test_covariance_with_sigmas_of_very_different_size_is_valid():
    check_covariance(np.diag([1e-12, 1e-12, 1e-12, 1e4, 1e4, 1e4]), "spread")
