"""Learned features as a source of hypotheses; apart from the others, for it brings half of SciPy along."""

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

_MOST = 2  # times as many hypotheses as peaks, where stations lie above each other


class LearnedRecognizer:
    """Votes by learned features; its peaks are made exact by keypoints of the newest keyframe that voted."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, learned: FeatureMatcher) -> None:
        self.config = config
        self.learned = learned
        peaks = replace(config.consensus, mode="consensus", peaks=config.learned.peaks)
        self.consensus = Consensus(base_map.stations, base_map.config.block, peaks)
        self._view: QueryFeatures | None = None

    def vote(self, query: SearchRequest) -> None:
        """Compare what the ground network sees around the robot with the map's features."""
        if len(query.surroundings) < self.config.keyframe.min_points:
            return
        centre = on_ground(query.surroundings, query.position)
        self._view = self.learned.view(query.surroundings, centre)
        suggested = [transform(T, query.position[None])[0, :2] for T in query.suggested]
        self.consensus.vote(centre, {"learned": self.learned.distances(self._view, suggested)})

    def hypotheses(self) -> list[Hypothesis]:
        """Return the consensus' peaks on every storey that they may be on, each moved to where keypoints agree."""
        peaks = [replace(each, learned=True) for each in self.consensus.hypotheses()]
        if self._view is None or not peaks:
            return peaks
        same = [self._same_but_height(each, peaks[0], self._view) for each in peaks]
        if not all(same):
            lead = (peaks[same.index(False)].score - peaks[0].score) / math.sqrt(len(self.consensus))
            peaks = [replace(each, lead=lead * own) for each, own in zip(peaks, same, strict=True)]
        found: dict[tuple[int | None, int | None], Hypothesis] = {}
        for peak in peaks:
            for each in self._storeys(peak):
                found.setdefault((each.station, each.shift), each)
        named = list(found.values())[: _MOST * self.config.learned.peaks]
        return self.learned.sharpened(named, self._view)

    def _storeys(self, peak: Hypothesis) -> list[Hypothesis]:
        """Return a peak, and its likes at the stations above and below: from above they look the same."""
        if peak.station is None:
            return [peak]
        stations, own = self.consensus.stations, self.consensus.stations[peak.station]
        others = np.flatnonzero(
            (np.abs(stations[:, :2] - own[:2]) < 0.25 * self.consensus.grid.block).all(axis=1)
        )
        rises = {int(k): float(stations[k, 2] - own[2]) for k in others if k != peak.station}
        return [peak] + [
            replace(
                peak, T_map_odom=pose_from(np.eye(3), np.array([0.0, 0.0, rise])) @ peak.T_map_odom, station=k
            )
            for k, rise in rises.items()
        ]

    def _same_but_height(self, one: Hypothesis, other: Hypothesis, view: QueryFeatures) -> bool:
        here, there = (transform(each.T_map_odom, view.centre[None])[0, :2] for each in (one, other))
        turn = abs(wrap_angle(yaw_of(one.T_map_odom) - yaw_of(other.T_map_odom)))
        rule = self.consensus.config
        return math.dist(here, there) < rule.distinct_distance and turn < rule.distinct_yaw

    def clear(self) -> None:
        """Forget all votes."""
        self.consensus.clear()
        self._view = None

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self.consensus)
