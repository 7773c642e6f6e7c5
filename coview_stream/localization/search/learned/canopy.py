"""Canopy matcher: the heights of what stands around the robot, compared with those of the map; nothing is learned.

A robot that sees up into the crowns sees the canopy from below as a survey sees it from above. The greatest height in
each square metre is encoded by its phases at some wavelengths, so that a mean inner product of two encodings falls
with the difference of the heights, and saturates: what one side has not seen does not count for more than once.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from coview_kernels import warm_up
from coview_stream.config import LearnedConfig
from coview_stream.descriptors.birds_eye_view import CELL, SLABS, birds_eye_view
from coview_stream.descriptors.network import LOCAL_CELL
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.geometry.transforms import Points
from coview_stream.localization.search.learned.feature_vote import FeatureVote
from coview_stream.localization.search.learned.matcher import SIZE, RasterMatcher
from coview_stream.localization.search.learned.rasters import FeatureRasters

# set by hand
_WAVELENGTHS = (60.0, 20.0, 10.0)  # metres of height; of three sets the best on the real plot of docs/forest.md
_LEAST_CELLS = 50  # square metres that a query has seen, or it names no places
_WINDOW, _MARGIN = 128, 24  # metres: a map is drawn piece by piece, the ground found with a margin around them
_TOP, _RATIO = -3, round(LOCAL_CELL / CELL)


class CanopyQuery(NamedTuple):
    """Heights around a robot.

    Attributes:
        local: (D, h, w) encoded, cells of a metre along the axes of the odometry frame.
        weight: (h, w) 1 where anything was seen within reach, else 0.
        centre: (3,) in the middle, the ground below the robot; odometry frame, metres.
    """

    local: Floats32
    weight: Floats32
    centre: Floats


class CanopyMatcher(RasterMatcher):
    """A map's canopy, ready to be searched; it is drawn at the first query, or by :meth:`prepare`."""

    def __init__(self, points: Points, stations: Floats32, config: LearnedConfig, *, block: float = 2.0) -> None:
        """Prepare to search a map of points (N, 3), metres, with stations (M, 3) in blocks of ``block`` metres."""
        super().__init__(stations, config, block)
        self._points = points

    def prepare(self) -> None:
        """Draw the map, or the first query does."""
        warm_up("height_columns", "window_products")
        _ = self.cells, self._by_coarse_cell

    @cached_property
    def _drawn(self) -> tuple[FeatureRasters, Floats32]:
        """The map's encoded heights, and their mean (D,), from which all are measured."""
        corner, top, seen = map_canopy(self._points)
        ratio = round(self.config.cell / LOCAL_CELL)
        parts = (top.shape[0] // ratio, ratio, top.shape[1] // ratio, ratio)
        count = seen.reshape(parts).sum(axis=(1, 3))
        fine = (encoded(top) * seen).reshape(-1, *parts).sum(axis=(2, 4)) / np.maximum(count, 1)
        known = count > 0
        mean = fine[:, known].mean(axis=1)
        fine = np.where(known, fine - mean[:, None, None], 0.0).astype(np.float32)
        axes = np.eye(len(fine), dtype=np.float32)
        half = round(0.5 * SIZE / self.config.cell)
        return FeatureRasters.of_image(fine, known, corner, self.config.cell, half, axes), mean.astype(np.float32)

    @cached_property
    def rasters(self) -> FeatureRasters:
        """The map's heights, encoded, fine and coarse."""
        return self._drawn[0]

    def encode(self, points: Points, centre: Floats) -> CanopyQuery | None:
        """Encode a gravity-aligned cloud (N, 3) around ``centre`` (3,), on the ground; None if too little was seen."""
        size = round(SIZE / CELL)
        top, seen = _heights(points, centre[:2] - 0.5 * SIZE, (size, size))
        axis = (np.arange(len(top)) + 0.5) * LOCAL_CELL - 0.5 * SIZE
        weight = seen & (np.hypot(axis[:, None], axis[None]) <= self.config.reach)
        if weight.sum() < _LEAST_CELLS:
            return None
        return CanopyQuery(encoded(top) - self._drawn[1][:, None, None], weight.astype(np.float32), centre)

    def vote(self, query: CanopyQuery) -> FeatureVote:
        """Return a query's vote, by comparison with all of the map."""
        return self.compare(query.centre, query.local, query.weight, np.arange(len(self.index)))


def encoded(heights: Floats32) -> Floats32:
    """Encode heights (H, W), metres: (D, H, W), of unit norm in each cell."""
    phases = [2.0 * np.pi / wavelength * heights for wavelength in _WAVELENGTHS]
    waves = [wave(phase) for phase in phases for wave in (np.cos, np.sin)]
    return np.stack(waves).astype(np.float32) / np.float32(np.sqrt(len(_WAVELENGTHS)))


def map_canopy(points: Points) -> tuple[Floats, Floats32, Bools]:
    """Draw a map (N, 3): lower corner (2,), greatest heights (H, W) in cells of a metre, and which were seen."""
    edge = 4.0  # metres of the largest coarse cells
    low = np.floor(points[:, :2].min(axis=0).astype(np.float64) / edge) * edge
    across, down = (np.floor((points[:, :2].max(axis=0) - low) / edge).astype(int) + 1) * round(edge)
    top, seen = np.zeros((down, across), dtype=np.float32), np.zeros((down, across), dtype=bool)
    order = np.argsort(points[:, 1], kind="stable")
    sorted_y = points[order, 1]
    for row in range(0, down, _WINDOW):
        begin, end = np.searchsorted(sorted_y, low[1] + np.array([row - _MARGIN, row + _WINDOW + _MARGIN]))
        strip = points[order[begin:end]]
        for column in range(0, across, _WINDOW):
            corner = low + np.array([column - _MARGIN, row - _MARGIN])
            within = (strip[:, 0] >= corner[0]) & (strip[:, 0] < corner[0] + _WINDOW + 2 * _MARGIN)
            side = _RATIO * (_WINDOW + 2 * _MARGIN)
            part = _heights(strip[within], corner, (side, side))
            here = slice(row, min(row + _WINDOW, down)), slice(column, min(column + _WINDOW, across))
            inner = tuple(slice(_MARGIN, _MARGIN + each.stop - each.start) for each in here)
            top[here], seen[here] = part[0][inner], part[1][inner]
    return low, top, seen


def _heights(points: Points, corner: Floats, shape: tuple[int, int]) -> tuple[Floats32, Bools]:
    """Return the greatest heights above the ground in cells of a metre, of an image of cells of half of one."""
    image = birds_eye_view(points, corner, shape)
    parts = (shape[0] // _RATIO, _RATIO, shape[1] // _RATIO, _RATIO)
    seen = image[:-1].max(axis=0).reshape(parts).max(axis=(1, 3)) > 0
    top = image[_TOP].reshape(parts).max(axis=(1, 3)) * np.float32(SLABS[-1] / 255.0)
    return np.asarray(top, dtype=np.float32), np.asarray(seen)
