import numpy as np
import pytest
from scipy import ndimage

from coview_stream.geometry.rasters import max_filter, min_filter


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 3), (40, 31)])
@pytest.mark.parametrize("size", [1, 3, 5])
def test_windows_are_scipys(shape, size):
    raster = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    before = raster.copy()
    np.testing.assert_array_equal(min_filter(raster, size), ndimage.minimum_filter(raster, size=size))
    np.testing.assert_array_equal(max_filter(raster, size), ndimage.maximum_filter(raster, size=size))
    np.testing.assert_array_equal(raster, before)


def test_cells_of_which_nothing_is_known_say_nothing():
    raster = np.full((5, 5), np.inf, dtype=np.float32)
    raster[2, 1] = 3.0
    np.testing.assert_array_equal(min_filter(raster, 3), ndimage.minimum_filter(raster, size=3))


@pytest.mark.parametrize("size", [0, 2, -3])
def test_a_window_has_a_middle(size):
    with pytest.raises(ValueError, match="odd"):
        min_filter(np.zeros((3, 3), np.float32), size)
