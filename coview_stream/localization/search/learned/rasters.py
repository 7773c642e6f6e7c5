"""Feature rasters: a map's features in their principal dimensions, fine and coarse, and votes of queries on them.

The score of a station and shift is the weighted mean inner product of a query's features with the map's over the
surveyed cells. With less than ``MIN_COVERAGE`` of the weight compared there is no score, as a mean of few cells
scatters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coview_kernels import WindowImages, WindowRaster, window_products
from coview_stream.descriptors.feature_map import FeatureMap
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.localization.search.learned.correlation import MIN_COVERAGE, FeatureIndex, downsample, rotate_images

WEIGHT = 7
"""The last of a cell's eight dimensions: the query's weight, or whether the map has the cell."""

_SAMPLE = 1024  # scores for the estimate of median and MAD, to 4 %
_STRIDE = 7  # shifts between two samples
_ENERGY = 0.995  # share of the features' energy in the principal dimensions
_TILES = 64  # sampled for the principal dimensions
_COARSE = 2  # fine cells along the edge of a coarse one
_BLOCK = 6  # ratio of a coarse block's edge to its margin: two thirds are valid
_BYTE = 127.0


@dataclass(frozen=True)
class StationCells:
    """Blocks of cells around M stations on a raster."""

    first: Ints  # (M, 2) row and column of a block's first cell, which may lie off the raster
    size: Ints  # (M, 2) rows and columns of the block
    shape: tuple[int, int]  # (2,) rows and columns of the raster

    def __len__(self) -> int:
        return len(self.first)


class FeatureVote:
    """Vote of one query by its learned features.

    Attributes:
        centre: (3,) the ground below the robot, odometry frame, metres.
    """

    def __init__(
        self,
        centre: Floats,
        raster: WindowRaster,
        cells: StationCells,
        images: WindowImages,
        candidates: tuple[Ints, Ints],
        groups: Ints,
    ) -> None:
        """Compare with a map.

        ``raster`` has the map's features and mask of cells, with a margin of half an image, ``images`` the query's
        features and weight at all shifts. Of ``candidates``, stations and shifts (N,), only the best of each group (N,)
        remains.
        """
        self.centre = centre
        self._images = images
        self._raster = raster
        self._cells = cells
        self._half = images.side // 2
        self._total = np.maximum(images.images[..., WEIGHT].sum(axis=(1, 2), dtype=np.int64), 1) * 127.0
        # median and robust standard deviation of the scores, from an even sample of stations and shifts
        number = np.arange(min(_SAMPLE, len(cells) * self.sectors))
        sample = self.scores(number * len(cells) // max(len(number), 1), number * _STRIDE % self.sectors)
        sample = sample[np.isfinite(sample)]
        self._median, self._deviation = np.float32(0.0), np.float32(1.0)
        if len(sample):
            self._median = np.median(sample)
            self._deviation = np.float32(1.4826 * np.median(np.abs(sample - self._median)) + 1e-6)
        self._named = self._best_of(candidates, groups)

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return len(self._images)

    def candidates(self) -> tuple[Ints, Ints]:
        """Return the named stations and shifts (K,), best first."""
        return self._named

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,); 0 where nothing was compared."""
        scores = self.scores(stations, shifts)
        z_scores = np.zeros(len(scores), dtype=np.float32)
        compared = np.isfinite(scores)
        z_scores[compared] = (self._median - scores[compared]) * np.float32(1.0 / self._deviation)
        return z_scores

    def at_all(self, requests: Sequence[tuple[FeatureVote, Ints, Ints]]) -> list[Floats32]:
        """Return :meth:`at` of each request."""
        return [vote.at(stations, shifts) for vote, stations, shifts in requests]

    def scores(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return the scores (K,) of the best cells in the stations' blocks, higher is better; -inf without any."""
        best = np.full(len(stations), -np.inf, dtype=np.float32)
        rows = np.flatnonzero(stations >= 0)
        first, size = self._cells.first[stations[rows]], self._cells.size[stations[rows]]
        for down, across in np.ndindex(*size.max(axis=0, initial=0)):
            at = first + np.array([down, across])
            inside = ((down, across) < size).all(axis=1) & ((at >= 0) & (at < self._cells.shape)).all(axis=1)
            there = rows[inside]
            best[there] = np.maximum(best[there], self._products(at[inside], shifts[there]))
        return best

    def _products(self, cells: Ints, shifts: Ints) -> Floats32:
        """Return the scores (K,) of raster cells (K, 2) at shifts (K,)."""
        sums = window_products(self._raster, self._images, cells - self._half, shifts)
        weight = sums[:, WEIGHT].astype(np.float32)
        enough = weight >= MIN_COVERAGE * self._total[shifts]
        mean = sums[:, :WEIGHT].sum(axis=1) / np.maximum(weight, 1.0)
        return np.where(enough, mean, -np.inf).astype(np.float32)

    def _best_of(self, candidates: tuple[Ints, Ints], groups: Ints) -> tuple[Ints, Ints]:
        """Return the best distinct stations and shifts, one per group, best first."""
        scores = self.scores(*candidates)
        order = np.argsort(-scores, kind="stable")
        chosen = order[: int(np.isfinite(scores).sum())]
        for number in (groups, candidates[0] * self.sectors + candidates[1]):
            _, first = np.unique(number[chosen], return_index=True)
            chosen = chosen[np.sort(first)]
        return candidates[0][chosen], candidates[1][chosen]


@dataclass(frozen=True)
class FeatureRasters:
    """Fine and coarse rasters of a map's features."""

    axes: Floats32  # (D, C) orthonormal principal directions
    corner: Floats  # (2,) x and y of the lower corner of cell (0, 0), metres
    cell: float  # edge of a fine cell, metres
    shape: tuple[int, int]  # fine rows and columns
    fine: WindowRaster  # features times 127; the last dimension is 127 in cells with features
    coarse: FeatureIndex  # mean features over cells twice as large, with their spectra

    @classmethod
    def of(cls, features: FeatureMap, cell: float, half: int) -> FeatureRasters:
        """Return a map's rasters with cells of ``cell`` metres, for queries of ``half`` cells from middle to edge."""
        axes = principal_axes(features.sample(_TILES), _ENERGY, WEIGHT)
        fine, corner = features.coarse(cell, axes)
        filled = np.asarray((fine != 0).any(axis=0))
        raster = np.zeros((*filled.shape, WEIGHT + 1), dtype=np.int8)
        raster[..., : len(axes)] = _bytes(_BYTE * fine).transpose(1, 2, 0)
        raster[..., WEIGHT] = _BYTE * filled
        count = _pooled(filled[None].astype(np.float32))
        coarse = _pooled(fine) / np.maximum(count, 1.0)
        margin = -(-half // _COARSE)
        block = _BLOCK * margin
        index = FeatureIndex(coarse, corner, _COARSE * cell, surveyed=count[0] > 0, block=block, margin=margin)
        return cls(axes, corner, cell, filled.shape, WindowRaster(raster, half), index)


@dataclass(frozen=True)
class TurnedQuery:
    """A query at S headings."""

    images: WindowImages  # (S, h + 1, h + 1, 8) int8 weighted features, and the weight in the last dimension
    coarse: Floats32  # (g, g, K, D + 1) float32 in coarse cells at some headings of the first half turn
    headings: Ints  # (K,) numbers of the coarse headings


def turn_query(local: Floats32, weight: Floats32, rasters: FeatureRasters, ratio: int, yaws: Floats) -> TurnedQuery:
    """Rotate a query's features (C, H, W) with cell weights (H, W) to headings ``yaws`` (S,).

    ``ratio`` is the number of query cells along the edge of a fine map cell. S is even, and the second half of the
    headings is opposite to the first.
    """
    reduced, shares = downsample(np.tensordot(rasters.axes, local, 1), weight, ratio)
    half = len(yaws) // 2
    turned = rotate_images(np.concatenate([reduced, shares[None]]), yaws[:half])
    side, dimensions = len(turned), len(rasters.axes)
    images = np.zeros((2 * half, side, side, WEIGHT + 1), dtype=np.int8)
    scaled = _bytes(turned * np.float32(_BYTE / max(float(turned[..., -1].max()), 1e-9))).transpose(2, 0, 1, 3)
    images[:half, ..., :dimensions], images[:half, ..., WEIGHT] = scaled[..., :-1], scaled[..., -1]
    images[half:] = images[:half, ::-1, ::-1]
    stride = 2 if half >= 12 else 1  # 20 degrees are enough for coarse cells
    return TurnedQuery(WindowImages(images), _halved(turned[:, :, ::stride]), np.arange(0, half, stride))


def _bytes(values: Floats32) -> Floats32:
    """Round to the range of a signed byte, which features of norm 1 may exceed by rounding."""
    return np.rint(np.clip(values, -_BYTE, _BYTE))


def _pooled(values: Floats32) -> Floats32:
    """Add up squares of fine cells (C, H, W): (C, H / 2, W / 2)."""
    channels, height, width = values.shape
    parts = values.reshape(channels, height // _COARSE, _COARSE, width // _COARSE, _COARSE)
    return np.asarray(parts.sum(axis=(2, 4)))


def _halved(images: Floats32) -> Floats32:
    """Add up images (h, h, ...), h odd, in cells twice as large, with the same central point."""
    out = images
    for axis in (0, 1):
        padded = np.moveaxis(out, axis, 0)
        if len(padded) // 2 % 2:  # keep the middle in the middle of a coarse cell
            padded = np.pad(padded, [(1, 1)] + [(0, 0)] * (padded.ndim - 1))
        between = 0.5 * padded[1::2]
        coarse = padded[::2].copy()
        coarse[:-1] += between
        coarse[1:] += between
        out = np.moveaxis(coarse, 0, axis)
    return np.ascontiguousarray(out)


def principal_axes(vectors: Floats32, energy: float, most: int) -> Floats32:
    """Return the fewest orthonormal directions (D, C), at most ``most``, with the share ``energy`` of vectors (C, N).

    They omit ``1 - energy`` of the vectors' mean square. The best come first.
    """
    values, directions = np.linalg.eigh((vectors @ vectors.T).astype(np.float64))
    share = np.cumsum(values[::-1]) / max(float(values.sum()), 1e-30)
    count = min(int(np.searchsorted(share, energy)) + 1, len(values), most)
    return np.ascontiguousarray(directions[:, ::-1][:, :count].T, dtype=np.float32)
