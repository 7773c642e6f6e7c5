"""Feature matcher: compares a scan's learned features with a map's at its stations and headings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from coview_kernels import warm_up
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LearnedConfig, LocalizerConfig
from coview_stream.descriptors.birds_eye_view import CELL, birds_eye_view
from coview_stream.descriptors.coview import on_ground
from coview_stream.descriptors.feature_map import TILE, FeatureMap
from coview_stream.descriptors.network import LOCAL_CELL, Features, Network, network
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.rasters import argsmallest
from coview_stream.geometry.transforms import Circle, Points, transform
from coview_stream.localization.search.consensus import Consensus, Hypothesis, yaw_of_shift
from coview_stream.localization.search.learned.correlation import correlate
from coview_stream.localization.search.learned.rasters import (
    FeatureRasters,
    FeatureVote,
    StationCells,
    TurnedQuery,
    turn_query,
)
from coview_stream.localization.search.request import SearchRequest

YAWS = 36
"""Number of compared headings, even."""

_SIZE = 64.0  # metres along the edge of a query's image
_ROUNDING = 1e-6  # cells
_MAX_PER_PEAK = 2  # hypotheses per peak, where stations lie above each other
_NAMED, _NAMED_SHARE = 128, 0.01  # coarse cells that are compared in detail: least number, share of all
_TILE_RADIUS = 0.75 * TILE * LOCAL_CELL  # metres from a tile's middle to beyond its corners


@dataclass(frozen=True)
class QueryFeatures:
    """The ground network's output around a robot."""

    features: Features  # of an image with centre in its middle, along the axes of the odometry frame
    weight: Floats32  # (h, w) of the local descriptors' cells; zero beyond the reach
    centre: Floats  # (3,) the ground below the robot, odometry frame, metres

    @property
    def place(self) -> Floats32:
        """(P,) global descriptor of unit norm: the mean of the four middle cells."""
        middle = self.features.place.shape[1] // 2
        mean = self.features.place[:, middle - 1 : middle + 1, middle - 1 : middle + 1].mean(axis=(1, 2))
        return np.asarray(mean / (np.linalg.norm(mean) + 1e-9), dtype=np.float32)


class FeatureMatcher:
    """Matcher of queries with a map's learned features, shared by all searches of the map.

    The network and the spectra are loaded at the first query, or by :meth:`prepare`.
    """

    def __init__(self, features: FeatureMap, stations: Floats32, config: LearnedConfig, *, block: float = 2.0) -> None:
        """Search a map whose stations (M, 3) are in the middle of blocks of ``block`` metres.

        Raises:
            MapError: the features were computed with other weights than the installed ones.
            InputError: there are no weights.
        """
        features.check()
        self.features = features
        self.stations = stations
        self.config = config
        self._block = block

    @cached_property
    def network(self) -> Network:
        """The ground encoder; one thread is enough for 64 m."""
        return network("ground", 1)

    @cached_property
    def rasters(self) -> FeatureRasters:
        """The map's features in their principal dimensions, fine and coarse."""
        return FeatureRasters.of(self.features, self.config.cell, round(0.5 * _SIZE / self.config.cell))

    @cached_property
    def cells(self) -> StationCells:
        """Fine cells of the stations' blocks; a block smaller than a cell has the cell of its station."""
        xy = (self.stations[:, :2].astype(np.float64) - self.rasters.corner) / self.rasters.cell
        half = 0.5 * self._block / self.rasters.cell
        first, last = (np.ceil(xy + side - 0.5 - _ROUNDING).astype(np.int64) for side in (-half, half))
        first = np.where(last > first, first, np.floor(xy).astype(np.int64))
        size = np.maximum(last - first, 1)
        return StationCells(first[:, ::-1], size[:, ::-1], self.rasters.shape)

    @cached_property
    def _by_coarse_cell(self) -> tuple[Ints, Ints]:
        """Stations in the order of their coarse cells, and the first row of each cell (cells + 1,)."""
        index = self.rasters.coarse
        xy = (self.stations[:, :2].astype(np.float64) - index.corner) / index.cell
        column, row = np.floor(xy).astype(np.int64).T
        inside = (column >= 0) & (column < index.width) & (row >= 0) & (row < index.height)
        cell = np.where(inside, row * index.width + column, -1)
        order = np.argsort(cell, kind="stable")
        return order, np.searchsorted(cell[order], np.arange(index.height * index.width + 1))

    @cached_property
    def _feature_blocks(self) -> Ints:
        """Blocks of the index with any features."""
        return self.rasters.coarse.blocks_near(self.features.tile_centres, _TILE_RADIUS)

    @property
    def dense(self) -> bool:
        """Whether the map is small enough to search all cells."""
        return self.features.tile_area <= self.config.dense_area

    def prepare(self) -> None:
        """Load the network and compute the map's spectra ahead of the first query.

        Raises:
            InputError: the weights cannot be loaded.
        """
        import scipy.ndimage  # noqa: F401  # takes a quarter of a second, otherwise at the first image

        warm_up("height_columns", "window_products")
        _ = self.network, self._feature_blocks if self.dense else self.rasters, self.cells, self._by_coarse_cell

    def encode(self, points: Points, centre: Floats) -> QueryFeatures:
        """Encode a gravity-aligned cloud (N, 3) around ``centre`` (3,) on the ground below the robot.

        Raises:
            InputError: as :meth:`prepare`.
        """
        size = round(_SIZE / CELL)
        features = self.network(birds_eye_view(points, centre[:2] - 0.5 * _SIZE, (size, size)))
        axis = (np.arange(len(features.sigma)) + 0.5) * LOCAL_CELL - 0.5 * _SIZE
        inside = np.hypot(axis[:, None], axis[None]) <= self.config.reach
        return QueryFeatures(features, np.where(inside, 1.0 / features.sigma, 0.0).astype(np.float32), centre)

    def vote(self, query: QueryFeatures, near: npt.ArrayLike = (), area: Circle | None = None) -> FeatureVote:
        """Return a query's vote; shift n means yaw -2 pi n / S.

        Its candidates come from a correlation of coarse cells at some headings, on a large map only around the tiles
        most similar to the query and around ``near`` (N, 2), metres. All candidates lie within ``area``, if given.
        """
        ratio = round(self.config.cell / LOCAL_CELL)
        yaws = yaw_of_shift(np.arange(YAWS), YAWS)
        turned = turn_query(query.features.local, query.weight, self.rasters, ratio, yaws)
        index = self.rasters.coarse
        blocks = self._feature_blocks if self.dense else self._similar_blocks(query, near, area)
        if self.dense and area is not None:
            blocks = np.intersect1d(blocks, index.blocks_near((area.x, area.y), area.radius))
        coarse = correlate(turned.coarse, index, opposite=True, blocks=blocks)
        candidates, groups = self._named(coarse, turned)
        if area is not None:
            within = area.holds(self.stations[candidates[0]])
            candidates, groups = (candidates[0][within], candidates[1][within]), groups[within]
        return FeatureVote(query.centre, self.rasters.fine, self.cells, turned.images, candidates, groups)

    def _named(self, coarse: Floats32, turned: TurnedQuery) -> tuple[tuple[Ints, Ints], Ints]:
        """Return stations and shifts (N,) in the cells and about the headings of the best scores (2 K, H, W).

        A cell counts once per half turn, with its best heading. The last array (N,) numbers cells and half turns.
        """
        order, begin = self._by_coarse_cell
        halves = coarse.reshape(2, len(turned.headings), -1)
        heading = halves.argmax(axis=1)
        best = np.take_along_axis(halves, heading[:, None], axis=1)[:, 0]
        best[:, begin[1:] == begin[:-1]] = -np.inf  # cells without stations
        count = max(_NAMED, int(_NAMED_SHARE * np.isfinite(best).sum()))
        chosen = argsmallest(-best.ravel(), count)
        chosen = chosen[np.isfinite(best.ravel()[chosen])]
        half, cell = np.divmod(chosen, best.shape[1])
        shift = turned.headings[heading.ravel()[chosen]] + half * (YAWS // 2)
        # all stations of a chosen cell, at its heading and those halfway to the next
        number = begin[cell + 1] - begin[cell]
        group = np.repeat(np.arange(len(chosen)), number)
        station = order[np.arange(len(group)) - np.repeat(np.cumsum(number) - number, number) + begin[cell][group]]
        step = int(turned.headings[1] - turned.headings[0])
        off = np.arange(-(step // 2), step // 2 + 1)
        shifts = (shift[group, None] + off) % YAWS
        return (np.repeat(station, len(off)), shifts.ravel()), np.repeat(group, len(off))

    def _similar_blocks(self, query: QueryFeatures, near: npt.ArrayLike, area: Circle | None) -> Ints:
        """Return the index blocks around ``near`` (N, 2) and the tiles most similar to the query, within ``area``."""
        similarity = self.features.place.astype(np.float32) @ query.place
        tile = np.floor(self.features.place_at / (TILE * LOCAL_CELL)).astype(np.int64)
        tiles_at, number = np.unique(tile, axis=0, return_inverse=True)
        best = np.full(len(tiles_at), -np.inf, dtype=np.float32)
        np.maximum.at(best, number.reshape(-1), similarity)
        if area is not None:
            reached = replace(area, radius=area.radius + _TILE_RADIUS)
            met = reached.holds((tiles_at + 0.5) * (TILE * LOCAL_CELL))
            tiles_at, best = tiles_at[met], best[met]
        chosen = tiles_at[np.argsort(-best, kind="stable")[: self.config.shortlist]]
        tiles = (chosen + 0.5) * (TILE * LOCAL_CELL)
        middles = np.vstack([tiles, np.asarray(near, dtype=np.float64).reshape(-1, 2)])
        return self.rasters.coarse.blocks_near(middles, _TILE_RADIUS)


class LearnedRecognizer:
    """Recognizer by learned features."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, learned: FeatureMatcher) -> None:
        self.config = config
        self.learned = learned
        self.consensus = Consensus(base_map.station_grid, replace(config.consensus, peaks=config.learned.peaks))

    def vote(self, request: SearchRequest) -> None:
        """Compare the ground network's features around the robot with the map's."""
        if len(request.surroundings) < self.config.keyframe.min_points:
            return
        centre = on_ground(request.surroundings, request.position)
        query = self.learned.encode(request.surroundings, centre)
        hinted = [transform(T, request.position[None])[0, :2] for T in request.hints]
        self.consensus.vote(self.learned.vote(query, hinted, request.area))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the consensus' peaks on all storeys below and above them, which look alike from above."""
        grid, peaks = self.consensus.grid, self.consensus.hypotheses()
        places: dict[tuple[int | None, int | None], Hypothesis] = {}
        own = np.array([peak.station for peak in peaks], dtype=np.int64)
        for peak, middle, stations in zip(peaks, own, grid.levels_at(grid.stations[own]).T.tolist(), strict=True):
            places.setdefault((peak.station, peak.shift), replace(peak, learned=True))
            for station in stations:
                if station < 0 or (station, peak.shift) in places:
                    continue
                T = peak.T_map_odom.copy()
                T[2, 3] += float(grid.stations[station, 2] - grid.stations[middle, 2])
                places[station, peak.shift] = replace(peak, T_map_odom=T, station=station, learned=True)
        return list(places.values())[: _MAX_PER_PEAK * self.config.learned.peaks]

    def clear(self) -> None:
        """Forget all votes."""
        self.consensus.clear()
