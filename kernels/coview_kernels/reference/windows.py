"""Twin of the kernel of windows."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import I8, I32


def window_products(raster: I8, images: I8, corners: I32, which: I32) -> I32:
    """Return sums (N, D) over the cells of a window; twin of :func:`coview_kernels.window_products`."""
    side = images.shape[1]
    step = np.arange(side)
    out = np.empty((len(corners), raster.shape[2]), dtype=np.int32)
    for n, ((row, column), k) in enumerate(zip(corners.tolist(), which.tolist(), strict=True)):
        window = raster[row + step[:, None], column + step].astype(np.int32)
        out[n] = (window * images[k].astype(np.int32)).sum(axis=(0, 1))
    return out
