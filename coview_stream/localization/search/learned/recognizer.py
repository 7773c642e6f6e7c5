"""Place recognizer by learned features; in a module of its own, for it imports SciPy, which takes a while."""

from __future__ import annotations

from dataclasses import replace

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.coview import on_ground
from coview_stream.geometry.transforms import transform
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.learned.matcher import FeatureMatcher
from coview_stream.localization.search.request import SearchRequest

_MAX_PER_PEAK = 2  # hypotheses, where stations lie above each other; set by hand


class LearnedRecognizer:
    """Recognizer by learned features."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, learned: FeatureMatcher) -> None:
        self.config = config
        self.learned = learned
        peaks = replace(config.consensus, mode="consensus", peaks=config.learned.peaks)
        self.consensus = Consensus(base_map.station_grid, peaks)

    def vote(self, request: SearchRequest) -> None:
        """Compare the ground network's features around the robot with the map's."""
        if len(request.surroundings) < self.config.keyframe.min_points:
            return
        centre = on_ground(request.surroundings, request.position)
        query = self.learned.encode(request.surroundings, centre)
        hinted = [transform(T, request.position[None])[0, :2] for T in request.hints]
        self.consensus.vote(self.learned.vote(query, hinted, request.area))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the consensus' peaks on every storey that they may be on: from above these look alike."""
        found: dict[tuple[int | None, int | None], Hypothesis] = {}
        for peak in self.consensus.hypotheses():
            for each in self._storeys(replace(peak, learned=True)):
                found.setdefault((each.station, each.shift), each)
        return list(found.values())[: _MAX_PER_PEAK * self.config.learned.peaks]

    def _storeys(self, peak: Hypothesis) -> list[Hypothesis]:
        """Return a peak, and the same at the stations above and below."""
        grid = self.consensus.grid
        storeys = [] if peak.station is None else grid.storeys(peak.station)
        if len(storeys) < 2:
            return [peak]
        out = [peak]
        for station in storeys:
            if station != peak.station:
                T = peak.T_map_odom.copy()
                T[2, 3] += float(grid.stations[station, 2] - grid.stations[peak.station, 2])
                out.append(replace(peak, T_map_odom=T, station=station))
        return out

    def clear(self) -> None:
        """Forget all votes."""
        self.consensus.clear()

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self.consensus)
