"""Dense correlation of a query's features with a map's at all cells and headings, by FFT in overlapping blocks."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Bools, Complexes, Floats, Floats32, Ints, Reals

MIN_COVERAGE = 0.6
"""Least share of a query's weight on surveyed cells; at this share the scatter has grown by 1.3."""

_BLOCK = 96  # cells: fast to transform, with two thirds valid
_MARGIN = 16  # cells of 2 m from the middle of a 64 m query to its edge
_MAX_BYTES = 512 << 20  # memory for the spectra
_BATCH_BYTES = 32 << 20  # of the products transformed back together
_EPSILON = 1e-6  # smaller weights count as zero


class FeatureIndex:
    """Features of a map on a coarse grid, in overlapping blocks, for correlation by overlap-save.

    The valid part of a block is ``block - 2 margin`` cells on a side. The spectra of all blocks are kept if they fit
    into ``max_bytes`` (75 MB per km2 with 32 dimensions on cells of 2 m), else computed for every query.
    """

    def __init__(
        self,
        features: Reals,
        corner: npt.ArrayLike,
        cell: float = 2.0,
        *,
        surveyed: Bools | None = None,
        block: int = _BLOCK,
        margin: int = _MARGIN,
        max_bytes: int = _MAX_BYTES,
    ) -> None:
        """Cut the map and transform its blocks.

        Args:
            features: (C, H, W), row along y, column along x; float16 or float32, memory-mapped or not.
            corner: (2,) x and y of the lower corner of cell (0, 0), metres.
            cell: edge of a cell, metres.
            surveyed: (H, W) cells with map points (default: those with a non-zero feature).
            block: cells of a block's edge, margins included.
            margin: cells from the middle of a query to its edge, at most.
            max_bytes: limit for keeping the spectra.
        """
        self.dimensions, self.height, self.width = features.shape
        self.surveyed = (features != 0).any(axis=0) if surveyed is None else surveyed
        self.corner = np.asarray(corner, dtype=np.float64)
        self.cell, self.block, self.margin = cell, block, margin
        self.valid = block - 2 * margin
        """Edge of the valid part of a block, cells."""
        self.blocks_down = math.ceil(self.height / self.valid)
        self.blocks_across = math.ceil(self.width / self.valid)
        self._features = features
        everything = np.arange(len(self))
        fits = block * (block // 2 + 1) * self.dimensions * len(self) * 8 <= max_bytes
        self._spectra = self._block_spectra(everything) if fits else None
        self._gapless = np.array([bool(self._cut(self.surveyed, k).all()) for k in everything])

    def __len__(self) -> int:
        """Return the number of blocks."""
        return int(self.blocks_down * self.blocks_across)

    def spectra(self, blocks: Ints) -> Complexes:
        """Return half spectra (bins, len(blocks), C); bins are rows of the block times half its columns."""
        if self._spectra is None:
            return self._block_spectra(blocks)
        return self._spectra if len(blocks) == len(self) else self._spectra[:, blocks]

    def surveyed_spectra(self, blocks: Ints) -> Complexes:
        """Return half spectra (bins, len(blocks), 1) of the mask of surveyed cells."""
        cut = np.stack([self._cut(self.surveyed, k) for k in blocks], axis=-1).astype(np.float32)
        return _half_spectra(cut, self.block)[..., None]

    def gapless(self, blocks: Ints) -> Bools:
        """Return a mask of the blocks whose cells are all surveyed, margin included."""
        return self._gapless[blocks]

    def cells_of(self, block: int | np.integer) -> tuple[slice, slice]:
        """Return the map's rows and columns in the valid part of a block."""
        down, across = divmod(int(block), self.blocks_across)
        row, column = down * self.valid, across * self.valid
        return slice(row, min(row + self.valid, self.height)), slice(column, min(column + self.valid, self.width))

    def blocks_near(self, xy: npt.ArrayLike, radius: float) -> Ints:
        """Find the blocks whose valid part has a cell centre within ``radius`` metres of any position (N, 2)."""
        cells = (np.asarray(xy, dtype=np.float64).reshape(-1, 2) - self.corner) / self.cell - 0.5
        near = []
        for block in range(len(self)):
            rows, cols = self.cells_of(block)
            low, high = np.array([cols.start, rows.start]), np.array([cols.stop - 1, rows.stop - 1])
            gap = np.maximum(np.maximum(low - cells, cells - high), 0.0)
            if (np.hypot(gap[:, 0], gap[:, 1]) * self.cell <= radius).any():
                near.append(block)
        return np.array(near, dtype=np.int64)

    def _block_spectra(self, blocks: Ints) -> Complexes:
        out = np.empty((self.block * (self.block // 2 + 1), len(blocks), self.dimensions), dtype=np.complex64)
        for k, block in enumerate(blocks):  # one by one, to keep intermediate arrays small
            cut = np.ascontiguousarray(self._cut(self._features, block).transpose(1, 2, 0))
            out[:, k] = _half_spectra(cut, self.block)
        return out

    def _cut(self, image: npt.NDArray[np.generic], block: int | np.integer) -> Floats32:
        """Cut the cells (..., block, block) of a block from an image (..., H, W); 0 beyond the map."""
        rows, cols = self.cells_of(block)
        row, column = rows.start - self.margin, cols.start - self.margin
        out = np.zeros((*image.shape[:-2], self.block, self.block), dtype=np.float32)
        bottom, right = min(row + self.block, self.height), min(column + self.block, self.width)
        first, second = max(row, 0), max(column, 0)
        out[..., first - row : bottom - row, second - column : right - column] = image[..., first:bottom, second:right]
        return out


def correlate(images: Floats32, index: FeatureIndex, opposite: bool, blocks: Ints | None = None) -> Floats32:
    """Return the mean inner products of a rotated query's features with the map's, at all cells and headings.

    The mean is over surveyed cells: unsurveyed ones would count as dissimilar, and the right place at the map's edge
    would lose to a wrong one inside. A mean of few cells scatters more and would favour the rim, so a place with less
    than :data:`MIN_COVERAGE` of the weight on surveyed cells has no score: -inf, as wrong places may score below 0.

    Args:
        images: (h + 1, h + 1, K, C + 1), features times weights and the weight, from :func:`rotate_images`.
        index: of the same cells and dimensions, with a margin of at least h / 2.
        opposite: also compare the images at the opposite headings.
        blocks: blocks of the map to score (all); see :meth:`FeatureIndex.blocks_near`.

    Returns:
        (K, H, W), or (2 K, H, W) with the opposite headings last; -inf without a score. The memory order is (H, W, K):
        the headings of a cell are contiguous.

    Raises:
        ValueError: no cell has a weight.
    """
    half, turns = images.shape[0] // 2, images.shape[2]
    total = images[..., -1].sum(axis=(0, 1), dtype=np.float64).astype(np.float32)
    if not (total > _EPSILON).all():
        raise ValueError("no cell of the query has a weight")
    spectra = _half_spectra(images * (1.0 / total)[:, None], index.block)
    # each with the first row and column of the valid part of the product; correlation with an image rotated by 180
    # degrees is convolution: with the same spectra, not conjugate
    queries = [(np.conjugate(spectra), index.margin - half), (spectra, index.margin + half)][: 1 + opposite]
    headings = len(queries) * turns
    chosen = np.arange(len(index)) if blocks is None else np.unique(blocks)
    scores = np.full((index.height, index.width, headings), -np.inf, dtype=np.float32)
    per_block = 8 * len(spectra) * headings
    for group in np.array_split(chosen, max(1, -(-len(chosen) * per_block // _BATCH_BYTES))):
        if len(group):
            for (query, first), part in zip(queries, np.split(scores, len(queries), axis=2), strict=True):
                _score(part, group, index, query, first)
    return np.asarray(scores.transpose(2, 0, 1))


def _score(scores: Floats32, group: Ints, index: FeatureIndex, query: Complexes, first: int) -> None:
    """Fill in the scores (H, W, K) of the valid parts of some blocks, by a query's spectra (bins, K, C + 1)."""
    mean = _inverse(np.matmul(index.spectra(group), query[..., :-1].transpose(0, 2, 1)), index, first)
    gaps = np.flatnonzero(~index.gapless(group))
    if len(gaps):
        share = _inverse(index.surveyed_spectra(group[gaps]) * query[:, None, :, -1], index, first)
        # rounding of the transforms must not decide about a share equal to the minimum
        enough = share >= MIN_COVERAGE - 1e-5
        mean[:, :, gaps] = np.where(enough, mean[:, :, gaps] / np.maximum(share, _EPSILON), -np.inf)
    for k, block in enumerate(group):
        rows, cols = index.cells_of(block)
        scores[rows, cols] = mean[: rows.stop - rows.start, : cols.stop - cols.start, k]


def _half_spectra(images: Floats32, size: int) -> Complexes:
    """Transform images (h, w, ...), zero-padded to ``size``, to half spectra (size * (size // 2 + 1), ...)."""
    from scipy import fft  # needed by the search only

    whole = fft.fft(fft.rfft(images, size, axis=1), size, axis=0, overwrite_x=True)
    return np.asarray(whole.reshape(-1, *images.shape[2:]))


def _inverse(product: Complexes, index: FeatureIndex, first: int) -> Floats32:
    """Transform products of spectra (bins, blocks, K) back to correlations (valid, valid, blocks, K)."""
    from scipy import fft

    size, last = index.block, first + index.valid
    grid = product.reshape(size, -1, *product.shape[1:])
    rows = fft.ifft(grid, axis=0, overwrite_x=True)[first:last]
    return np.asarray(fft.irfft(rows, size, axis=1)[:, first:last])


def downsample(local: Reals, weight: Floats32 | None = None, ratio: int = 2) -> tuple[Floats32, Floats32]:
    """Average ``ratio`` x ``ratio`` cells of features (C, H, W), times their weights (H, W), and of the weights.

    Returns:
        (C, H / ratio, W / ratio), (H / ratio, W / ratio).
    """
    dimensions, height, width = local.shape
    if weight is None:
        weight = np.ones((height, width), dtype=np.float32)
    parts = (height // ratio, ratio, width // ratio, ratio)
    weighted = (local * weight).reshape(dimensions, *parts).mean(axis=(2, 4), dtype=np.float32)
    return np.asarray(weighted), np.asarray(weight.reshape(parts).mean(axis=(1, 3), dtype=np.float32))


def rotate_images(images: Floats32, yaws: Floats) -> Floats32:
    """Sample rotated images on a grid of odd size about their middle.

    Args:
        images: (C, h, h), h even, with the middle between cells. Cells more than h / 2 from it are left out, as only
            some headings would show them; 0 outside the image.
        yaws: (K,) radians, counter-clockwise from x (columns) to y (rows).

    Returns:
        (h + 1, h + 1, K, C): at [h/2 + v, h/2 + u, k] the bilinear value at R(-yaw_k) (u, v) from the middle.
    """
    dimensions, size, _ = images.shape
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1))).transpose(1, 2, 0).reshape(-1, dimensions)
    corners, shares = _corners(size, tuple(yaws.tolist()))
    out = padded.take(corners[0], axis=0) * shares[0]
    for corner, share in zip(corners[1:], shares[1:], strict=True):
        out += padded.take(corner, axis=0) * share
    return np.asarray(out.reshape(size + 1, size + 1, len(yaws), dimensions))


@lru_cache(maxsize=4)
def _corners(size: int, yaws: tuple[float, ...]) -> tuple[Ints, Floats32]:
    """Return the four cells (4, N) around the samples of a rotated image, and their weights (4, N, 1)."""
    half = size // 2
    v, u = np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1), indexing="ij")
    c, s = np.cos(yaws), np.sin(yaws)
    # a border of zero cells provides the values beyond the image
    col = u[..., None] * c + v[..., None] * s + (half + 0.5)
    row = v[..., None] * c - u[..., None] * s + (half + 0.5)
    inside = (np.hypot(u, v) <= half)[..., None]
    i, j = (np.clip(np.floor(position), 0, size).astype(np.int64) for position in (row, col))
    down, right = row - i, col - j
    at = (i * (size + 2) + j).ravel()
    shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]) * inside
    return at + np.array([[0], [1], [size + 2], [size + 3]]), shares.reshape(4, -1, 1).astype(np.float32)
