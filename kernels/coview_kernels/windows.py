"""Products of small images with windows of a raster: a correlation at given places.

Cells hold eight signed bytes, whose products are summed separately, as one of them may be the weight in a mean of the
others. A window of 33 x 33 cells takes a microsecond; for all places at once a Fourier transform is faster.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import I8, I32, as_int32
from coview_kernels.launch import Launch
from coview_kernels.warm_up import compiled_by

DIMENSIONS = 8
"""Numbers in a cell."""

_LANES = 32  # as in _ti_windows.py
_MAX_CELLS = (2**31 - 1) // (128 * 128)  # so that an int32 holds the sum of products


class WindowImages:
    """K images (K, h, h, 8) of signed bytes, prepared for comparison with windows of a raster.

    Attributes:
        padded: (K, h, stride) int8, rows of whole registers.
        spans: (h, 2) int32 first register of each row that any image uses, and the register after the last.

    Raises:
        ValueError: the shape or type is wrong.
    """

    def __init__(self, images: I8) -> None:
        if images.ndim != 4 or images.shape[1] != images.shape[2] or images.shape[3] != DIMENSIONS:
            raise ValueError(f"images have shape {images.shape}, expected (K, h, h, {DIMENSIONS})")
        if images.dtype != np.int8 or not 0 < images.shape[1] ** 2 <= _MAX_CELLS:
            raise ValueError(
                f"images of {images.dtype} with {images.shape[1]} cells a side, expected int8 and 1 to 362"
            )
        count, side = images.shape[:2]
        stride = -(-side * DIMENSIONS // _LANES) * _LANES
        self.padded = np.zeros((count, side, stride), dtype=np.int8)
        self.padded[..., : side * DIMENSIONS] = images.reshape(count, side, -1)
        used = np.asarray((self.padded != 0).reshape(count, side, -1, _LANES).any(axis=(0, 3)))
        first, last = used.argmax(axis=1), used.shape[1] - used[:, ::-1].argmax(axis=1)
        self.spans = np.stack([first, np.where(used.any(axis=1), last, 0)], axis=1).astype(np.int32)

    def __len__(self) -> int:
        return len(self.padded)

    @property
    def side(self) -> int:
        """Cells h along an image's edge."""
        return int(self.padded.shape[1])

    @property
    def images(self) -> I8:
        """Images (K, h, h, 8) without the padding of the registers."""
        return self.padded[..., : self.side * DIMENSIONS].reshape(len(self), self.side, self.side, DIMENSIONS)


class WindowRaster:
    """A raster (H, W, 8) of signed bytes, prepared for windows that reach up to ``margin`` cells beyond it.

    Attributes:
        flat: int8, the raster with a margin of zeros, row by row, followed by zeros.
        margin: cells.

    Raises:
        ValueError: the shape or type is wrong, or the raster has more than 2 GB.
    """

    def __init__(self, raster: I8, margin: int) -> None:
        if raster.ndim != 3 or raster.shape[2] != DIMENSIONS or raster.dtype != np.int8:
            raise ValueError(f"a raster of {raster.dtype} {raster.shape}, expected int8 (H, W, {DIMENSIONS})")
        height, width = (n + 2 * margin for n in raster.shape[:2])
        if height * width * DIMENSIONS >= 2**31 - _LANES:
            raise ValueError(f"a raster of {height} x {width} cells is too large")
        # the images' padding is multiplied with the bytes behind the last row
        self.flat = np.zeros(height * width * DIMENSIONS + _LANES, dtype=np.int8)
        self.margin = margin
        self._shape = height, width
        self.padded[margin : height - margin, margin : width - margin] = raster

    @property
    def padded(self) -> I8:
        """Raster (H + 2 margin, W + 2 margin, 8) with its margin."""
        height, width = self._shape
        return self.flat[:-_LANES].reshape(height, width, DIMENSIONS)


def window_products(raster: WindowRaster, images: WindowImages, corners: npt.ArrayLike, which: npt.ArrayLike) -> I32:
    """Sum the products of images with windows of a raster, separately for each of the eight dimensions.

    Args:
        raster: the raster.
        images: K images.
        corners: (N, 2) row and column of a window's first cell in the raster or its margin.
        which: (N,) image of each window.

    Returns:
        (N, 8) int32.

    Raises:
        ValueError: a shape is wrong, a window leaves the margin, or there is no such image.
    """
    at, image = as_int32("corners", corners, None, 2), as_int32("which", which, None)
    at = np.ascontiguousarray(at + np.int32(raster.margin))
    if len(at) != len(image):
        raise ValueError(f"{len(at)} corners and {len(image)} images")
    if not len(at):
        return np.zeros((0, DIMENSIONS), dtype=np.int32)
    if at.min() < 0 or (at.max(axis=0) + images.side > raster.padded.shape[:2]).any():
        raise ValueError("a window leaves the raster's margin")
    if image.min() < 0 or image.max() >= len(images):
        raise ValueError(f"images {image.min()} to {image.max()} of {len(images)}")
    return runtime.dispatch_here(
        _launch.ready,
        lambda: _native(raster, images, at, image),
        lambda: reference.window_products(raster.padded, images.images, at, image),
    )


_BYTES, _WHOLES = np.zeros(1, dtype=np.int8), np.zeros(1, dtype=np.int32)
_launch = Launch("windows", "products", _BYTES, 0, _BYTES, 0, _WHOLES, _WHOLES, _WHOLES, _WHOLES)
"""One launch for all calls, as only one call of native code runs at a time."""


def _native(raster: WindowRaster, images: WindowImages, at: I32, which: I32) -> I32:
    width = raster.padded.shape[1]
    first = (at[:, 0] * width + at[:, 1]) * DIMENSIONS
    out = np.zeros((len(at), DIMENSIONS), dtype=np.int32)
    arguments = (
        raster.flat, width * DIMENSIONS, images.padded.reshape(-1), images.padded.shape[2], images.spans.reshape(-1),
        first, which, out.reshape(-1),
    )  # fmt: skip
    for index, value in enumerate(arguments):
        _launch.put(index, value)
    _launch()
    return out


def _compile() -> None:
    cell = np.zeros((1, 1, 1, DIMENSIONS), dtype=np.int8)
    window_products(WindowRaster(cell[0], 0), WindowImages(cell), np.zeros((1, 2)), np.zeros(1))


compiled_by("window_products", _compile)
