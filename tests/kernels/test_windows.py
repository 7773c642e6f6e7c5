"""Products of images with windows of a raster: the kernel, its twin and a plain correlation agree."""

import numpy as np
import pytest
from scipy.signal import correlate

from coview_kernels import WindowImages, WindowRaster, reference, window_products

MARGIN = 3


def scene(seed: int, count: int = 4, side: int = 6) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    raster, images = (rng.integers(-127, 128, shape).astype(np.int8) for shape in ((11, 14, 8), (count, side, side, 8)))
    return raster, images


@pytest.mark.parametrize("side", [1, 4, 6, 7])
def test_products_are_a_correlation_at_the_places_asked_for(side: int) -> None:
    raster, images = scene(side, side=side)
    images[:, 0] = 0  # a row without anything
    images[:, -1, : side // 2] = 0
    padded = np.pad(raster, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0))).astype(np.int64)
    corners = np.argwhere(np.ones(np.array(padded.shape[:2]) - side + 1)) - MARGIN
    which = np.arange(len(corners)) % len(images)
    found = window_products(WindowRaster(raster, MARGIN), WindowImages(images), corners, which)
    for d in range(8):
        each = np.stack([correlate(padded[..., d], image[..., d].astype(np.int64), "valid") for image in images])
        np.testing.assert_array_equal(found[:, d], each[which, corners[:, 0] + MARGIN, corners[:, 1] + MARGIN])


def test_kernel_equals_its_twin() -> None:
    raster, images = scene(1, count=36, side=9)
    rng = np.random.default_rng(2)
    corners, which = rng.integers(-MARGIN, 6, (500, 2)).astype(np.int32), rng.integers(0, 36, 500).astype(np.int32)
    known, prepared = WindowRaster(raster, MARGIN), WindowImages(images)
    np.testing.assert_array_equal(prepared.images, images)
    twin = reference.window_products(known.padded, images, corners + MARGIN, which)
    np.testing.assert_array_equal(window_products(known, prepared, corners, which), twin)


def test_wrong_arguments_are_refused() -> None:
    raster, images = scene(0)
    known, prepared = WindowRaster(raster, MARGIN), WindowImages(images)
    for corner, image in (((-4, 0), 0), ((0, 12), 0), ((0, 0), 4), ((0, 0), -1)):
        with pytest.raises(ValueError, match=r"window leaves|images"):
            window_products(known, prepared, [corner], [image])
    with pytest.raises(ValueError, match="2 corners and 1 images"):
        window_products(known, prepared, [(0, 0), (1, 1)], [0])
    with pytest.raises(ValueError, match="int8"):
        WindowRaster(raster.astype(np.int16), MARGIN)
    with pytest.raises(ValueError, match="expected"):
        WindowImages(images[..., :4])
    assert window_products(known, prepared, np.zeros((0, 2)), np.zeros(0)).shape == (0, 8)
