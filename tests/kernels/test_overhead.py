"""Clouds from above: the kernels equal their twins, and count what can be counted by hand."""

import numpy as np
import pytest

from coview_kernels import OverheadGrid, height_columns, lowest_heights, offsets_near, reference

GRID = OverheadGrid(-3.0, 5.0, 0.5, (12, 16))
COARSE = OverheadGrid(-3.0, 5.0, 2.0, (3, 4))
BOUNDS = (0.5, 8.0, 0.4)


def cloud(count: int = 5000) -> np.ndarray:
    """Points in and around the grid, some of them on edges of cells."""
    points = np.random.default_rng(0).uniform([-5, 3, -1], [7, 13, 9], (count, 3)).astype(np.float32)
    points[: count // 10] = np.round(2 * points[: count // 10]) / 2
    return points


def test_kernels_equal_their_twins() -> None:
    points = cloud()
    ground = np.random.default_rng(1).normal(size=COARSE.shape).astype(np.float32)
    np.testing.assert_array_equal(lowest_heights(points, GRID), reference.lowest_heights(points, GRID))
    for ours, twin in zip(
        offsets_near(points, COARSE, ground, 0.8), reference.offsets_near(points, COARSE, ground, 0.8), strict=True
    ):
        np.testing.assert_array_equal(ours, twin)
    given = points, GRID, ground, 4, 0.25, BOUNDS
    for ours, twin in zip(height_columns(*given), reference.height_columns(*given), strict=True):
        np.testing.assert_array_equal(ours, twin)


def test_points_of_one_cell_by_hand() -> None:
    points = np.array([[-2.9, 5.1, 1.1], [-2.6, 5.4, 3.3], [-2.7, 5.2, 1.0], [-2.8, 5.3, 20.0], [50.0, 5.0, -9.0]])
    lowest = lowest_heights(points, GRID)
    assert lowest[0, 0] == 1.0
    assert np.isinf(lowest).sum() == lowest.size - 1
    count, total = offsets_near(points, COARSE, np.full(COARSE.shape, 1.0, np.float32), 0.5)
    assert (count[0, 0], count.sum()) == (2, 2)
    assert total[0, 0] == pytest.approx(0.1, abs=1e-6)
    occupied, top, seen = height_columns(points, GRID, np.full(COARSE.shape, 1.0, np.float32), 4, 0.25, BOUNDS)
    assert occupied.shape == (32, 12 * 16)
    np.testing.assert_array_equal(np.argwhere(occupied), [[9, 0]])  # 2.3 m above the ground
    assert (top[0], top.sum()) == (8.0, 8.0)
    assert (seen[0], seen.sum()) == (1, 1)


def test_ground_is_interpolated_between_cells_and_constant_beyond_them() -> None:
    ground = np.tile(np.arange(4, dtype=np.float32), (3, 1))  # rises by half a metre a metre
    x = np.array([-2.9, -2.0, -1.0, 0.5, 4.9])
    points = np.column_stack([x, np.full(5, 8.0), np.full(5, 5.0)])
    top = height_columns(points, GRID, ground, 4, 0.25, BOUNDS)[1]
    np.testing.assert_allclose(top[top > 0], [5.0, 5.0, 4.5, 3.75, 2.0], atol=1e-6)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="points"):
        lowest_heights(np.zeros((4, 2)), GRID)
    with pytest.raises(ValueError, match="level"):
        offsets_near(np.zeros((4, 3)), COARSE, np.zeros((4, 4), np.float32), 0.5)
    assert np.isinf(lowest_heights(np.zeros((0, 3)), GRID)).all()
    for ground, ratio, bounds in (
        (np.zeros((0, 0), np.float32), 40, BOUNDS),
        (np.zeros(COARSE.shape, np.float32), 4, (0.5, 8.1, 0.4)),
    ):
        with pytest.raises(ValueError, match="levels of"):
            height_columns(np.zeros((4, 3)), GRID, ground, ratio, 0.25, bounds)


def test_height_just_below_the_bound_is_of_the_highest_level() -> None:
    step, most = 0.3, 0.3 * 40
    highest = np.nextafter(np.float32(most), np.float32(0))
    points = np.array([[0.0, 8.0, highest]], dtype=np.float32)
    given = points, GRID, np.zeros(COARSE.shape, np.float32), 4, step, (0.0, most, 0.4)
    for columns in (height_columns, reference.height_columns):
        occupied = columns(*given)[0]
        assert len(occupied) == 40
        assert occupied[39].sum() == 1
