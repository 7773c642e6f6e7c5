"""What the networks see of a cloud."""

from itertools import pairwise

import numpy as np
import pytest

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS, SLABS, birds_eye_view

SHAPE = (128, 128)
CORNER = np.array([-32.0, -32.0])
TOP, SEEN, RELIEF = LAYERS - 3, LAYERS - 2, LAYERS - 1


def ground(slope: tuple[float, float] = (0.0, 0.0), step: float = 0.25) -> np.ndarray:
    at = np.arange(-31.9, 32.0, step)
    x, y = (a.ravel() for a in np.meshgrid(at, at))
    return np.column_stack([x, y, slope[0] * x + slope[1] * y]).astype(np.float32)


def pole(x: float, y: float, base: float, low: float, high: float) -> np.ndarray:
    z = np.arange(low, high, 0.1)
    return np.column_stack([np.full_like(z, x), np.full_like(z, y), base + z]).astype(np.float32)


def cell_of(x: float, y: float) -> tuple[int, int]:
    return int((y - CORNER[1]) / CELL), int((x - CORNER[0]) / CELL)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2)])
def test_pole_fills_its_cell_and_layers_on_any_slope(slope: tuple[float, float]) -> None:
    x, y = 10.1, -4.9
    base = slope[0] * x + slope[1] * y
    image = birds_eye_view(np.concatenate([ground(slope), pole(x, y, base, 0.5, 7.0)]), CORNER, SHAPE)
    row, column = cell_of(x, y)
    filled = [k for k, bounds in enumerate(pairwise(SLABS)) if bounds[1] <= 7.0]
    assert all(image[k, row, column] >= 200 for k in filled)
    others = np.delete(image[filled].reshape(len(filled), -1), row * SHAPE[1] + column, axis=1)
    assert (others > 0).mean() < 0.01
    assert image[TOP, row, column] == pytest.approx(7.0 / SLABS[-1] * 255, abs=4)
    assert (image[SEEN] > 0).mean() > 0.95


def test_image_does_not_depend_on_point_density() -> None:
    cloud = np.concatenate([ground(), pole(3.1, 3.1, 0.0, 0.5, 9.0)])
    once, often = (birds_eye_view(cloud, CORNER, SHAPE), birds_eye_view(np.repeat(cloud, 5, axis=0), CORNER, SHAPE))
    assert np.array_equal(once[:SEEN], often[:SEEN])


def test_edge_of_a_roof_is_high_above_the_ground_beside_it() -> None:
    cloud = ground()
    roof = (np.abs(cloud[:, 0]) < 8) & (np.abs(cloud[:, 1]) < 6)
    cloud[roof, 2] = 6.0
    image = birds_eye_view(cloud, CORNER, SHAPE)
    row, column = cell_of(0.1, 5.6)
    assert image[TOP, row, column] > 4.0 / SLABS[-1] * 255
    assert image[SEEN, row, column] == 0
    beside = cell_of(0.1, 7.1)
    assert image[(TOP, *beside)] < 0.5 / SLABS[-1] * 255
    assert image[(SEEN, *beside)] == 255


def test_relief_rises_over_a_ridge_and_not_over_a_slope() -> None:
    cloud = ground((0.25, 0.0))
    plain = birds_eye_view(cloud, CORNER, SHAPE)[RELIEF].astype(int)
    middle = slice(40, 88)
    assert np.abs(plain[middle, middle] - 128).max() < 12
    cloud[:, 2] += 1.5 * np.exp(-((cloud[:, 1] / 4.0) ** 2))
    ridge = birds_eye_view(cloud, CORNER, SHAPE)[RELIEF].astype(int)
    assert ridge[64, middle].mean() > 128 + 30
    assert ridge[64 + 24, middle].mean() < 128


def test_points_outside_and_empty_clouds_give_zeros() -> None:
    empty = birds_eye_view(np.empty((0, 3), dtype=np.float32), CORNER, SHAPE)
    assert empty.shape == (LAYERS, *SHAPE)
    assert not empty[:RELIEF].any()
    assert (empty[RELIEF] == 128).all()
    far = np.array([[100.0, 0.0, 1.0], [0.0, -33.0, 1.0]], dtype=np.float32)
    cloud = ground()
    assert np.array_equal(
        birds_eye_view(np.concatenate([cloud, far]), CORNER, SHAPE), birds_eye_view(cloud, CORNER, SHAPE)
    )
