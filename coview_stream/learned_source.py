"""Learned features as a source of hypotheses; apart from the others, for it brings half of SciPy along."""

from __future__ import annotations

import math
from dataclasses import replace

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.place.consensus import Consensus, Hypothesis
from coview_stream.place.descriptor import ground_below
from coview_stream.place.learned.votes import LearnedMap, View
from coview_stream.query import Query


class Learned:
    """Votes by learned features; its peaks are made exact by keypoints of the newest keyframe that voted."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, learned: LearnedMap) -> None:
        self.config = config
        self.learned = learned
        peaks = replace(config.consensus, mode="consensus", peaks=config.learned.peaks)
        self.consensus = Consensus(base_map.stations, base_map.config.block, peaks)
        self._view: View | None = None

    def vote(self, query: Query) -> None:
        """Compare what the ground network sees around the robot with the map's features."""
        if len(query.surroundings) < self.config.keyframe.min_points:
            return
        centre = query.position.copy()
        centre[2] = ground_below(query.surroundings, query.position)
        self._view = self.learned.view(query.surroundings, centre)
        self.consensus.vote(centre, {"learned": self.learned.distances(self._view)})

    def hypotheses(self) -> list[Hypothesis]:
        """Return the consensus' peaks, each moved to where keypoints agree."""
        found = [replace(each, learned=True) for each in self.consensus.hypotheses()]
        if len(found) > 1:
            lead = (found[1].score - found[0].score) / math.sqrt(len(self.consensus))
            found[0] = replace(found[0], lead=lead)
        if self._view is None or not self.config.learned.sharpen:
            return found
        return self.learned.sharpened(found, self._view)

    def clear(self) -> None:
        """Forget all votes."""
        self.consensus.clear()
        self._view = None

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self.consensus)
