"""Feature rasters: a map's features in the few dimensions that matter, fine and coarse, and votes of queries on them.

The score of a station and shift is the mean inner product of a query's features with the map's, over the surveyed
cells, each with the weight that the query gives it. A query that reaches beyond the map so scores as it would anywhere;
where less than ``MIN_COVERAGE`` of its weight is compared there is no score, for the mean of few cells scatters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coview_kernels import WindowImages, WindowRaster, window_products
from coview_stream.descriptors.feature_map import FeatureMap
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.localization.search.consensus import Request
from coview_stream.localization.search.learned.correlation import MIN_COVERAGE, downsample, rotate_images
from coview_stream.localization.search.learned.feature_index import FeatureIndex

WEIGHT = 7
"""Number of the dimension, of the eight of a cell, that is the query's weight, and whether the map knows the cell."""

_SAMPLE = 1024  # stations and shifts that scores are standardised by: median and MAD are good to 4 %; set by hand
_STRIDE = 7  # shifts from one of them to the next
_ENERGY = 0.995  # of the features on a map that the dimensions in which they are compared hold; set by hand
_TILES = 64  # of a map from which those are found; set by hand
_COARSE = 2  # fine cells along the edge of a coarse one
_BLOCK = 6  # edge of a coarse block over its margin: two thirds of it are answers
_BYTE = 127.0


@dataclass(frozen=True)
class StationCells:
    """Where stations (M, 3) stand on a raster of cells: their blocks have one cell or more.

    Attributes:
        first: (M, 2) row and column of the first cell in a station's block, which may lie off the raster.
        size: (M, 2) rows and columns of the block.
        shape: (2,) rows and columns of the raster.
    """

    first: Ints
    size: Ints
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.first)


class FeatureVote:
    """Vote that compares a query's features with the map's where it is asked to.

    Attributes:
        centre: (3,) as :attr:`Vote.centre`.
        images: the query, turned to each heading.
        named: stations and shifts (K,) that a coarser comparison has found.
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

        Args:
            centre: (3,) the ground below the robot, odometry frame, metres.
            raster: the map's features and whether it knows a cell, its margin half an image.
            cells: of the stations.
            images: the query at each shift, its features and its weight.
            candidates: stations and shifts (N,).
            groups: (N,) group numbers; only the best of a group stays a candidate.
        """
        self.centre = centre
        self.images = images
        self._raster = raster
        self._cells = cells
        self._half = images.side // 2
        self._total = np.maximum(images.images[..., WEIGHT].sum(axis=(1, 2), dtype=np.int64), 1) * 127.0
        self._median, self._deviation = self._standard()
        self.named = self._best_of(candidates, groups)

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return len(self.images)

    def candidates(self) -> tuple[Ints, Ints]:
        """Return the named stations and shifts (K,)."""
        return self.named

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,); 0 where nothing was compared."""
        scores = self.scores(stations, shifts)
        z_scores = np.zeros(len(scores), dtype=np.float32)
        compared = np.isfinite(scores)
        z_scores[compared] = (self._median - scores[compared]) * np.float32(1.0 / self._deviation)
        return z_scores

    def at_all(self, requests: Sequence[Request[FeatureVote]]) -> list[Floats32]:
        """Return what :meth:`at` of each does, one after the other."""
        return [vote.at(stations, shifts) for vote, stations, shifts in requests]

    def scores(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return scores (K,), higher is better: of a station's block the best cell; -inf where nothing was compared."""
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
        """Score cells (K, 2) of the raster."""
        sums = window_products(self._raster, self.images, cells - self._half, shifts)
        weight = sums[:, WEIGHT].astype(np.float32)
        enough = weight >= MIN_COVERAGE * self._total[shifts]
        mean = sums[:, :WEIGHT].sum(axis=1) / np.maximum(weight, 1.0)
        return np.where(enough, mean, -np.inf).astype(np.float32)

    def _standard(self) -> tuple[np.float32, np.float32]:
        """Return median and robust standard deviation of the scores, from stations and shifts spread evenly."""
        count = min(_SAMPLE, len(self._cells) * self.sectors)
        number = np.arange(count)
        scores = self.scores(number * len(self._cells) // max(count, 1), number * _STRIDE % self.sectors)
        scores = scores[np.isfinite(scores)]
        if not len(scores):
            return np.float32(0.0), np.float32(1.0)
        median = np.median(scores)
        return median, np.float32(1.4826 * np.median(np.abs(scores - median)) + 1e-6)

    def _best_of(self, candidates: tuple[Ints, Ints], groups: Ints) -> tuple[Ints, Ints]:
        """Return the best stations and shifts, one of each group and each once, best first."""
        scores = self.scores(*candidates)
        order = np.argsort(-scores, kind="stable")
        chosen = order[: int(np.isfinite(scores).sum())]
        for number in (groups, candidates[0] * self.sectors + candidates[1]):
            _, first = np.unique(number[chosen], return_index=True)
            chosen = chosen[np.sort(first)]
        return candidates[0][chosen], candidates[1][chosen]


@dataclass(frozen=True)
class FeatureRasters:
    """A map's features, ready to be searched.

    Attributes:
        axes: (D, C) orthonormal directions in which features are compared.
        corner: (2,) x and y of the lower corner of cell (0, 0), metres.
        cell: edge of a fine cell, metres.
        shape: fine rows and columns.
        fine: the features times 127; the last dimension is 127 where there are any.
        coarse: the features' means over cells twice as large, with their spectra.
    """

    axes: Floats32
    corner: Floats
    cell: float
    shape: tuple[int, int]
    fine: WindowRaster
    coarse: FeatureIndex

    @classmethod
    def of(cls, features: FeatureMap, cell: float, half: int) -> FeatureRasters:
        """Make them of a map, in cells of ``cell`` metres, for queries that reach ``half`` cells from their middle."""
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
    """A query turned to S headings, half a turn and more by symmetry.

    Attributes:
        images: (S, h + 1, h + 1, 8) int8 the weighted features, and the weight in the last dimension.
        coarse: (g, g, K, D + 1) float32 the same in coarse cells at some headings of the first half turn.
        headings: (K,) their numbers.
    """

    images: WindowImages
    coarse: Floats32
    headings: Ints


def turn_query(local: Floats32, weight: Floats32, rasters: FeatureRasters, ratio: int, yaws: Floats) -> TurnedQuery:
    """Turn a query to headings.

    Args:
        local: (C, H, W) features.
        weight: (H, W) of each cell.
        rasters: of the map that it is compared with.
        ratio: of its cells along the edge of a fine cell of the map.
        yaws: (S,) even in number; the second half is that of the first half a turn on.
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
    """Round to what a signed byte holds: features of norm 1 that were rounded before may come to more."""
    return np.rint(np.clip(values, -_BYTE, _BYTE))


def _pooled(values: Floats32) -> Floats32:
    """Add up squares of fine cells (C, H, W): (C, H / 2, W / 2)."""
    channels, height, width = values.shape
    parts = values.reshape(channels, height // _COARSE, _COARSE, width // _COARSE, _COARSE)
    return np.asarray(parts.sum(axis=(2, 4)))


def _halved(images: Floats32) -> Floats32:
    """Add up images (h, h, ...), h odd, in cells twice as large about the same middle cell's centre."""
    out = images
    for axis in (0, 1):
        padded = np.moveaxis(out, axis, 0)
        if len(padded) // 2 % 2:  # the middle stays in the middle of a coarse cell
            padded = np.pad(padded, [(1, 1)] + [(0, 0)] * (padded.ndim - 1))
        between = 0.5 * padded[1::2]
        coarse = padded[::2].copy()
        coarse[:-1] += between
        coarse[1:] += between
        out = np.moveaxis(coarse, 0, axis)
    return np.ascontiguousarray(out)


def principal_axes(vectors: Floats32, energy: float, most: int) -> Floats32:
    """Find the fewest orthonormal directions (D, C) that hold a share of the energy of vectors (C, N), best first.

    Inner products with the vectors change little where a query is reduced to them: what they leave out of a vector of
    unit norm is ``1 - energy`` of its square in the mean. There are ``most`` directions at most.
    """
    values, directions = np.linalg.eigh((vectors @ vectors.T).astype(np.float64))
    share = np.cumsum(values[::-1]) / max(float(values.sum()), 1e-30)
    count = min(int(np.searchsorted(share, energy)) + 1, len(values), most)
    return np.ascontiguousarray(directions[:, ::-1][:, :count].T, dtype=np.float32)
