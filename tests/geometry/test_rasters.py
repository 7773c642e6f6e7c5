import numpy as np
import pytest
from scipy import ndimage

from coview_stream.geometry.rasters import max_filter, min_filter


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 3), (40, 31)])
@pytest.mark.parametrize("size", [1, 3, 5])
def test_min_and_max_filter_match_scipy(shape, size):
    raster = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    raster[0, 0] = np.inf  # an unknown cell
    before = raster.copy()
    np.testing.assert_array_equal(min_filter(raster, size), ndimage.minimum_filter(raster, size=size))
    np.testing.assert_array_equal(max_filter(raster, size), ndimage.maximum_filter(raster, size=size))
    np.testing.assert_array_equal(raster, before)


@pytest.mark.parametrize("size", [0, 2, -3])
def test_even_window_size_is_refused(size):
    with pytest.raises(ValueError, match="odd"):
        min_filter(np.zeros((3, 3), np.float32), size)
