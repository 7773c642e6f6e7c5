"""Feature index: the map's features in overlapping blocks with their spectra, for the dense correlation."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Bools, Complexes, Floats32, Ints, Reals

BLOCK = 96
"""Edge of a block in cells: fast to transform, and two thirds of it are valid."""

MARGIN = 16
"""Cells of 2 m from the middle of a 64 m query to its edge."""

MAX_BYTES = 512 << 20
"""Memory for the spectra."""


class FeatureIndex:
    """Features of a map on a coarse grid, for correlation with queries by overlap-save.

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
        block: int = BLOCK,
        margin: int = MARGIN,
        max_bytes: int = MAX_BYTES,
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

        Raises:
            ValueError: the map has no cells, the mask another shape, or the margins leave nothing of a block.
        """
        if features.ndim != 3 or not features.size:
            raise ValueError(f"features of a map are (C, H, W), not {features.shape}")
        self.dimensions, self.height, self.width = features.shape
        self.surveyed = (features != 0).any(axis=0) if surveyed is None else surveyed
        if self.surveyed.shape != (self.height, self.width):
            raise ValueError(f"surveyed is {self.surveyed.shape}, the features are {features.shape}")
        if block <= 2 * margin:
            raise ValueError(f"blocks of {block} cells with margins of {margin}: nothing is left between them")
        self.corner = np.asarray(corner, dtype=np.float64)
        self.cell, self.block, self.margin = cell, block, margin
        self.valid = block - 2 * margin
        """Edge of the valid part of a block, cells."""
        self.blocks_down = math.ceil(self.height / self.valid)
        self.blocks_across = math.ceil(self.width / self.valid)
        self._features = features
        everything = np.arange(len(self))
        bins = block * (block // 2 + 1)
        fits = bins * self.dimensions * len(self) * 8 <= max_bytes
        self._spectra = self._block_spectra(everything) if fits else None
        self._gapless = np.array([bool(self._cut(self.surveyed, k).all()) for k in everything])

    def __len__(self) -> int:
        """Return the number of blocks."""
        return int(self.blocks_down * self.blocks_across)

    @property
    def nbytes(self) -> int:
        """Bytes of the kept spectra."""
        return 0 if self._spectra is None else int(self._spectra.nbytes)

    def spectra(self, blocks: Ints) -> Complexes:
        """Return half spectra (bins, len(blocks), C); bins are rows of the block times half its columns."""
        if self._spectra is None:
            return self._block_spectra(blocks)
        if len(blocks) == len(self):
            return self._spectra
        return self._spectra[:, blocks]

    def surveyed_spectra(self, blocks: Ints) -> Complexes:
        """Return half spectra (bins, len(blocks), 1) of the mask of surveyed cells."""
        cut = np.stack([self._cut(self.surveyed, k) for k in blocks], axis=-1).astype(np.float32)
        return half_spectra(cut, self.block)[..., None]

    def gapless(self, blocks: Ints) -> Bools:
        """Mask the blocks whose cells have all been surveyed, margin included."""
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
        for k, block in enumerate(blocks):  # one by one: intermediate arrays stay small
            cut = np.ascontiguousarray(self._cut(self._features, block).transpose(1, 2, 0))
            out[:, k] = half_spectra(cut, self.block)
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


def half_spectra(images: Floats32, size: int) -> Complexes:
    """Transform images (h, w, ...), zero-padded to ``size``, to half spectra (size * (size // 2 + 1), ...)."""
    from scipy import fft

    half = fft.rfft(images, size, axis=1)
    whole = fft.fft(half, size, axis=0, overwrite_x=True)
    return np.asarray(whole.reshape(-1, *images.shape[2:]))
