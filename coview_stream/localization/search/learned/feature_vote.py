"""Vote of a keyframe by learned features: scores at single stations and shifts, and where it is worth to ask for them.

The score is the mean inner product of a query's features with a map's, over the cells that the map has been surveyed
in, each with the weight that the query gives it. A query that reaches beyond the map so scores what it would score
anywhere; only where less than ``MIN_COVERAGE`` of its weight is compared there is no score, for the mean of few
cells scatters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coview_kernels import WindowImages, WindowRaster, window_products
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.localization.search.learned.correlation import MIN_COVERAGE
from coview_stream.localization.search.votes import Request

WEIGHT = 7
"""Number of the dimension, of the eight of a cell, that is the query's weight, and whether the map knows the cell."""

_SAMPLE = 1024  # stations and shifts that scores are standardised by: median and MAD are good to 4 %; set by hand
_STRIDE = 7  # shifts from one of them to the next


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
        named: tuple[Ints, Ints],
        groups: Ints,
    ) -> None:
        """Compare with a map.

        Args:
            centre: (3,) the ground below the robot, odometry frame, metres.
            raster: the map's features and whether it knows a cell, its margin half an image.
            cells: of the stations.
            images: the query at each shift, its features and its weight.
            named: stations and shifts (N,) that may be candidates.
            groups: (N,) equal numbers where only the best is one.
        """
        self.centre = centre
        self.images = images
        self._raster = raster
        self._cells = cells
        self._half = images.side // 2
        self._total = np.maximum(images.images[..., WEIGHT].sum(axis=(1, 2), dtype=np.int64), 1) * 127.0
        self._median, self._deviation = self._standard()
        self.named = self._best_of(named, groups)

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
        found = np.zeros(len(scores), dtype=np.float32)
        compared = np.isfinite(scores)
        found[compared] = (self._median - scores[compared]) * np.float32(1.0 / self._deviation)
        return found

    def at_all(self, requests: Sequence[Request[FeatureVote]]) -> list[Floats32]:
        """Return what :meth:`at` of each does, one after the other."""
        return [vote.at(stations, shifts) for vote, stations, shifts in requests]

    def scores(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return scores (K,), higher is better: of a station's block the best cell; -inf where nothing was compared."""
        found = np.full(len(stations), -np.inf, dtype=np.float32)
        known = np.flatnonzero(stations >= 0)
        first, size = self._cells.first[stations[known]], self._cells.size[stations[known]]
        for down, across in np.ndindex(*size.max(axis=0, initial=0)):
            at = first + np.array([down, across])
            inside = ((down, across) < size).all(axis=1) & ((at >= 0) & (at < self._cells.shape)).all(axis=1)
            there = known[inside]
            found[there] = np.maximum(found[there], self._products(at[inside], shifts[there]))
        return found

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

    def _best_of(self, named: tuple[Ints, Ints], groups: Ints) -> tuple[Ints, Ints]:
        """Return the best stations and shifts, one of each group and each once, best first."""
        scores = self.scores(*named)
        order = np.argsort(-scores, kind="stable")
        kept = order[: int(np.isfinite(scores).sum())]
        for number in (groups, named[0] * self.sectors + named[1]):
            _, first = np.unique(number[kept], return_index=True)
            kept = kept[np.sort(first)]
        return named[0][kept], named[1][kept]
