from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coview_kernels import coview, covisibility, paper_context, reference
from coview_kernels.reference import visible


@pytest.fixture(scope="module", autouse=True)
def _kernel_for_any_number_of_grids():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(covisibility, "_MIN_BINS", 0)
        yield


@st.composite
def grids(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lead = draw(st.sampled_from([(), (1,), (4,), (0,), (2, 3)]))
    shape = (*lead, draw(st.integers(1, 12)), draw(st.integers(1, 9)))
    count = rng.integers(0, draw(st.integers(1, 6)), shape).astype(np.int32)
    # halves make ties, multiples of the ring number make slopes that are exactly equal
    height = (np.round(rng.normal(0, 3, shape) * 2) / 2).astype(np.float32)
    if draw(st.booleans()):
        height = np.broadcast_to(0.3 * np.arange(1, shape[-2] + 1)[:, None], shape).astype(np.float32)
    return height, count


@given(grids())
def test_kernel_agrees_with_numpy(grid):
    context = coview(*grid)
    assert context.dtype == np.float32
    np.testing.assert_array_equal(context, reference.coview(*grid))


@given(grids())
def test_paper_context_agrees_with_numpy(grid):
    height, count = grid
    mean = height - np.float32(0.5)
    np.testing.assert_array_equal(paper_context(height, count, mean), reference.paper_context(height, count, mean))


@given(grids())
def test_paper_context_agrees_with_equations_1_to_4_in_exact_arithmetic(grid):
    height, count = (a.reshape(-1, *a.shape[-2:]) for a in grid)
    mean = height - np.float32(0.5)
    context = paper_context(height, count, mean)
    for m, j in np.ndindex(len(height), height.shape[2]):
        i_vis = h_vis = None
        for i in range(1, height.shape[1] + 1):
            h, d = Fraction(float(height[m, i - 1, j])), int(count[m, i - 1, j])
            horizontal = d > 0 and (i_vis is None or h >= i * h_vis / i_vis)
            vertical = d > 0 and d >= Fraction(int(count[m].sum()), count[m].size)
            if horizontal:
                i_vis, h_vis = i, h
            value = mean[m, i - 1, j] if horizontal and vertical else height[m, i - 1, j] if horizontal else 0
            assert context[m, i - 1, j] == value


@given(grids())
def test_visible_agrees_with_equation_2_in_exact_arithmetic(grid):
    height, count = (a.reshape(-1, *a.shape[-2:]) for a in grid)
    seen = visible(height, count)
    for m, j in np.ndindex(len(height), height.shape[2]):
        horizon = None
        for i in range(1, height.shape[1] + 1):
            now = False
            if count[m, i - 1, j] > 0:
                slope = Fraction(float(height[m, i - 1, j])) / i
                now = horizon is None or slope > horizon
                horizon = slope if now else horizon
            assert seen[m, i - 1, j] == now


def test_dense_bins_behind_a_wall_are_visible_from_above():
    height = np.array([[5.0], [4.0], [3.0]], dtype=np.float32)
    count = np.array([[1], [7], [1]], dtype=np.int32)
    assert coview(height, count)[:, 0].tolist() == [5, 4, 0]
    assert visible(height, count)[:, 0].tolist() == [True, False, False]


def test_mean_density_counts_empty_bins():
    height = np.array([[5.0, 0.0], [4.0, 0.0]], dtype=np.float32)
    count = np.array([[3, 0], [1, 0]], dtype=np.int32)
    # mean over four bins is 1: the second bin just reaches it; over the two occupied ones it would be 2
    assert coview(height, count)[1, 0] == 4.0


@given(grids())
def test_values_of_empty_bins_are_ignored(grid):
    height, count = (a.copy() for a in grid)
    expected = coview(height, count)
    height[count == 0] = np.nan
    np.testing.assert_array_equal(coview(height, count), expected)


def test_errors_name_the_argument():
    grid = np.zeros((2, 3))
    with pytest.raises(ValueError, match="count"):
        coview(grid, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="max_height"):
        coview(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="mean_height"):
        paper_context(grid, grid, np.zeros((3, 2)))
