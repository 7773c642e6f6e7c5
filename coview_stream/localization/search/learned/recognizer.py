"""Place recognizer by learned features; in a module of its own, for it imports SciPy, which takes a while."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.coview import on_ground
from coview_stream.geometry.transforms import pose_from, transform, wrap_angle, yaw_of
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.learned.matcher import FeatureMatcher, QueryFeatures
from coview_stream.localization.search.request import SearchRequest

_MAX_PER_PEAK = 2  # hypotheses, where stations lie above each other; set by hand


class LearnedRecognizer:
    """Recognizer by learned features."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, learned: FeatureMatcher) -> None:
        self.config = config
        self.learned = learned
        peaks = replace(config.consensus, mode="consensus", peaks=config.learned.peaks)
        self.consensus = Consensus(base_map.station_grid, peaks)
        self._query: QueryFeatures | None = None

    def vote(self, request: SearchRequest) -> None:
        """Compare the ground network's features around the robot with the map's."""
        if len(request.surroundings) < self.config.keyframe.min_points:
            return
        centre = on_ground(request.surroundings, request.position)
        self._query = self.learned.encode(request.surroundings, centre)
        hinted = [transform(T, request.position[None])[0, :2] for T in request.hints]
        self.consensus.vote(self.learned.vote(self._query, hinted))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the consensus' peaks on every storey that they may be on."""
        peaks = [replace(each, learned=True) for each in self.consensus.hypotheses()]
        if self._query is None or not peaks:
            return peaks
        same = [self._same_but_height(each, peaks[0], self._query) for each in peaks]
        if not all(same):
            lead = (peaks[same.index(False)].score - peaks[0].score) / math.sqrt(len(self.consensus))
            peaks = [replace(each, lead=lead * own) for each, own in zip(peaks, same, strict=True)]
        found: dict[tuple[int | None, int | None], Hypothesis] = {}
        for peak in peaks:
            for each in self._storeys(peak):
                found.setdefault((each.station, each.shift), each)
        return list(found.values())[: _MAX_PER_PEAK * self.config.learned.peaks]

    def _storeys(self, peak: Hypothesis) -> list[Hypothesis]:
        """Return a peak, and the same at the stations above and below: from above they look alike."""
        if peak.station is None:
            return [peak]
        stations = self.consensus.grid.stations
        own = stations[peak.station]
        others = np.flatnonzero((np.abs(stations[:, :2] - own[:2]) < 0.25 * self.consensus.grid.block).all(axis=1))
        rises = {int(k): float(stations[k, 2] - own[2]) for k in others if k != peak.station}
        return [peak] + [
            replace(peak, T_map_odom=pose_from(np.eye(3), np.array([0.0, 0.0, rise])) @ peak.T_map_odom, station=k)
            for k, rise in rises.items()
        ]

    def _same_but_height(self, one: Hypothesis, other: Hypothesis, query: QueryFeatures) -> bool:
        here, there = (transform(each.T_map_odom, query.centre[None])[0, :2] for each in (one, other))
        turn = abs(wrap_angle(yaw_of(one.T_map_odom) - yaw_of(other.T_map_odom)))
        rule = self.consensus.config
        return math.dist(here, there) < rule.distinct_distance and turn < rule.distinct_yaw

    def clear(self) -> None:
        """Forget all votes."""
        self.consensus.clear()
        self._query = None

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self.consensus)
