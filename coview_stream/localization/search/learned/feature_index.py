"""The map's features cut into overlapping blocks, their spectra made once: one side of the dense correlation."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import fft

from coview_stream.geometry.arrays import Bools, Complexes, Floats32, Ints, Reals

BLOCK = 96
"""Edge of a block in cells: fast to transform, and two thirds of it are answers."""

MARGIN = 16
"""Cells that a query of 64 m reaches from its middle, at 2 m."""

KEPT_BYTES = 512 << 20


class FeatureIndex:
    """Features of a map on a coarse grid, ready to be correlated with queries.

    The places of a block are ``block - 2 margin`` cells on a side; with the margin around them they are transformed
    together (overlap-save). The spectra of all blocks are kept where they take ``most_bytes`` at most (75 MB per km2
    with 32 channels on cells of 2 m), else made anew for every query.
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
        most_bytes: int = KEPT_BYTES,
        workers: int = 1,
    ) -> None:
        """Cut the map and transform its blocks.

        Args:
            features: (C, H, W), row along y, column along x; float16 or float32, memory-mapped for all we care.
            corner: (2,) x and y of the lower corner of cell (0, 0), metres.
            cell: edge of a cell, metres.
            surveyed: (H, W) cells of which something is known (those with any feature that is not 0).
            block: cells of a block's edge, margins included.
            margin: cells that a query may reach from its middle.
            most_bytes: for the spectra.
            workers: threads of the transforms.

        Raises:
            ValueError: the map has no cells, the mask another shape, or the margins leave nothing of a block.
        """
        if features.ndim != 3 or not features.size:
            raise ValueError(f"features of a map are (C, H, W), not {features.shape}")
        self.channels, self.height, self.width = features.shape
        self.surveyed = (features != 0).any(axis=0) if surveyed is None else surveyed
        if self.surveyed.shape != (self.height, self.width):
            raise ValueError(f"surveyed is {self.surveyed.shape}, the features are {features.shape}")
        if block <= 2 * margin:
            raise ValueError(
                f"blocks of {block} cells with margins of {margin}: nothing is left between them"
            )
        self.corner = np.asarray(corner, dtype=np.float64)
        self.cell, self.block, self.margin, self.workers = cell, block, margin, workers
        self.places = block - 2 * margin
        """Edge of the part of a block that is answered for, cells."""
        self.blocks_down = math.ceil(self.height / self.places)
        self.blocks_across = math.ceil(self.width / self.places)
        self._features = features
        everything = np.arange(len(self))
        bins = block * (block // 2 + 1)
        kept = bins * self.channels * len(self) * 8 <= most_bytes
        self._spectra = self._transformed(everything) if kept else None
        self._whole = np.array([bool(self._cut(self.surveyed, k).all()) for k in everything])

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
            return self._transformed(blocks)
        if len(blocks) == len(self):
            return self._spectra
        return self._spectra[:, blocks]

    def surveyed_spectra(self, blocks: Ints) -> Complexes:
        """Return half spectra (bins, len(blocks), 1) of the mask of surveyed cells."""
        cut = np.stack([self._cut(self.surveyed, k) for k in blocks], axis=-1).astype(np.float32)
        return transformed(cut, self.block, self.workers)[..., None]

    def whole(self, blocks: Ints) -> Bools:
        """Which blocks have been surveyed without a gap, margin included."""
        return self._whole[blocks]

    def place_of(self, block: int | np.integer) -> tuple[slice, slice]:
        """Rows and columns of the map that a block answers for."""
        down, across = divmod(int(block), self.blocks_across)
        top, left = down * self.places, across * self.places
        return slice(top, min(top + self.places, self.height)), slice(
            left, min(left + self.places, self.width)
        )

    def blocks_near(self, xy: npt.ArrayLike, radius: float) -> Ints:
        """Blocks that answer for a cell centre within ``radius`` metres of any of some places (N, 2)."""
        cells = (np.asarray(xy, dtype=np.float64).reshape(-1, 2) - self.corner) / self.cell - 0.5
        found = []
        for block in range(len(self)):
            rows, cols = self.place_of(block)
            low, high = np.array([cols.start, rows.start]), np.array([cols.stop - 1, rows.stop - 1])
            gap = np.maximum(np.maximum(low - cells, cells - high), 0.0)
            if (np.hypot(gap[:, 0], gap[:, 1]) * self.cell <= radius).any():
                found.append(block)
        return np.array(found, dtype=np.int64)

    def _transformed(self, blocks: Ints) -> Complexes:
        out = np.empty((self.block * (self.block // 2 + 1), len(blocks), self.channels), dtype=np.complex64)
        for k, block in enumerate(blocks):  # one by one: what is in between stays small
            cut = np.ascontiguousarray(self._cut(self._features, block).transpose(1, 2, 0))
            out[:, k] = transformed(cut, self.block, self.workers)
        return out

    def _cut(self, image: npt.NDArray[np.generic], block: int | np.integer) -> Floats32:
        """Cells (..., block, block) of a block of an image (..., H, W), 0 beyond the map."""
        rows, cols = self.place_of(block)
        top, left = rows.start - self.margin, cols.start - self.margin
        out = np.zeros((*image.shape[:-2], self.block, self.block), dtype=np.float32)
        bottom, right = min(top + self.block, self.height), min(left + self.block, self.width)
        first, second = max(top, 0), max(left, 0)
        out[..., first - top : bottom - top, second - left : right - left] = image[
            ..., first:bottom, second:right
        ]
        return out


def transformed(images: Floats32, size: int, workers: int) -> Complexes:
    """Half spectra (size * (size // 2 + 1), ...) of images (h, w, ...), zeros appended up to ``size``."""
    half = fft.rfft(images, size, axis=1, workers=workers)
    whole = fft.fft(half, size, axis=0, overwrite_x=True, workers=workers)
    return np.asarray(whole.reshape(-1, *images.shape[2:]))
