"""A query in cells, made coarser and turned about its middle."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


def coarser(local: npt.NDArray[np.floating], weight: F32 | None = None, ratio: int = 2) -> tuple[F32, F32]:
    """Mean of ``ratio`` x ``ratio`` cells of features (C, H, W), each times its weight (H, W), and of the weights.

    Returns:
        (C, H / ratio, W / ratio), (H / ratio, W / ratio): what :func:`~.correlation.correlate` takes.

    Raises:
        ValueError: the ratio does not divide the sides, or the weights have another shape.
    """
    channels, height, width = local.shape
    if height % ratio or width % ratio:
        raise ValueError(f"{height} x {width} cells cannot be taken together {ratio} by {ratio}")
    if weight is None:
        weight = np.ones((height, width), dtype=np.float32)
    if weight.shape != (height, width):
        raise ValueError(f"weights {weight.shape} for {height} x {width} cells")
    parts = (height // ratio, ratio, width // ratio, ratio)
    weighted = (local * weight).reshape(channels, *parts).mean(axis=(2, 4), dtype=np.float32)
    return np.asarray(weighted), np.asarray(weight.reshape(parts).mean(axis=(1, 3), dtype=np.float32))


def turned(images: F32, yaws: F64) -> F32:
    """Sample images on a grid of odd size about their middle, turned by each heading.

    Args:
        images: (C, h, h), h even: the middle lies between cells. What is farther from it than h / 2 cells is left
            out, as it would be there at some headings only; beyond the image is 0.
        yaws: (K,) radians, counter-clockwise from x (columns) to y (rows).

    Returns:
        (h + 1, h + 1, K, C): at [h/2 + v, h/2 + u, k] the bilinear value at R(-yaw_k) (u, v) from the middle.

    Raises:
        ValueError: the images are not square, or have an odd number of cells.
    """
    channels, size, width = images.shape
    if size != width or size % 2:
        raise ValueError(f"a query of {size} x {width} cells: it has to be square, its sides even")
    half = size // 2
    v, u = np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1), indexing="ij")
    c, s = np.cos(yaws), np.sin(yaws)
    # one more cell of zeros on every side takes the values beyond the image
    col = u[..., None] * c + v[..., None] * s + (half + 0.5)
    row = v[..., None] * c - u[..., None] * s + (half + 0.5)
    inside = np.hypot(u, v) <= half
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1))).transpose(1, 2, 0).reshape(-1, channels)
    i, j = (np.clip(np.floor(each), 0, size).astype(np.intp) for each in (row, col))
    down, right = (row - i).astype(np.float32)[..., None], (col - j).astype(np.float32)[..., None]
    at = i * (size + 2) + j
    out = padded[at] * ((1 - down) * (1 - right))
    out += padded[at + 1] * ((1 - down) * right)
    out += padded[at + size + 2] * (down * (1 - right))
    out += padded[at + size + 3] * (down * right)
    out *= inside[..., None, None]
    return np.asarray(out)
