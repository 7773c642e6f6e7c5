"""Global search: from the ring buffer's newest keyframe to verified hypotheses, and when to believe one."""

from __future__ import annotations

from dataclasses import replace

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, LocalizerConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.search.acceptance import AcceptanceTest, SearchResult
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.pose_hints import HintSchedule, robot_position
from coview_stream.localization.search.recognizers import CoViewRecognizer, PlaceRecognizer, SearchIndex
from coview_stream.localization.search.refinement import Candidate, Refinement
from coview_stream.localization.search.request import RequestSpec, SearchRequest, same_place

__all__ = ["Candidate", "GlobalSearch", "Query", "Verdict"]

_REMEMBERED = 2  # best candidates that the next keyframe tries again


class GlobalSearch:
    """Votes, registers the best hypotheses, verifies them, and accepts one only when it stands alone.

    Attributes:
        coview: the source of hypotheses that the paper has; None if it is not used.
        learned: the source by learned features; None if it is not used.
    """

    def __init__(
        self,
        base_map: BaseMap,
        config: LocalizerConfig,
        local_maps: LocalMaps,
        knowledge: SearchIndex | None = None,
    ) -> None:
        """Search a map; searches of one map may share ``knowledge``. Raises what :meth:`SearchIndex.of` does."""
        self.base_map = base_map
        # eight places a keyframe: GICP would have to prepare the map at each, and tracking starts with it anyway
        self.config = replace(config, registration=replace(config.registration, method="trimmed-icp"))
        self.local_maps = local_maps
        known = knowledge or SearchIndex.of(base_map, config)
        self.learned: PlaceRecognizer | None = None
        if known.learned is not None:
            from coview_stream.localization.search.learned.recognizer import LearnedRecognizer

            self.learned = LearnedRecognizer(base_map, config, known.learned)
        # together they name no more than can be registered in time
        peaks = config.consensus.peaks
        peaks = peaks if known.learned is None else min(peaks, config.learned.peaks)
        self.coview = (
            None if known.retrieval is None else CoViewRecognizer(base_map, config, known.retrieval, peaks)
        )
        self._sources: list[PlaceRecognizer] = [s for s in (self.coview, self.learned) if s is not None]
        self._refinement = Refinement(base_map, self.config, local_maps)
        self._decision = AcceptanceTest(self.config)
        self._remembered: list[Hypothesis] = []
        self._trials = HintSchedule()
        self._generation = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its sources of hypotheses."""
        return tuple(n for n, s in (("coview", self.coview), ("learned", self.learned)) if s is not None)

    @property
    def needs(self) -> RequestSpec:
        """What its queries have to have."""
        return RequestSpec(
            None if self.coview is None else self.base_map.descriptor_config,
            None if self.learned is None else self.config.learned.reach,
        )

    @property
    def last_query(self) -> dict[Channel, Descriptor]:
        """Descriptors (R, S) of the newest keyframe that voted by them, by channel."""
        return {} if self.coview is None else self.coview.last_query

    def clear(self) -> None:
        """Forget all votes and confirmations."""
        for source in self._sources:
            source.clear()
        self._remembered = []
        self._trials = HintSchedule()
        self._decision.clear()

    def reset(self) -> None:
        """Forget the newest descriptors as well."""
        self.clear()
        if self.coview is not None:
            self.coview.last_query = {}

    def update(self, query: SearchRequest) -> SearchResult:
        """Take in one keyframe and judge; once a place is accepted, the next query starts the search anew."""
        if query.generation != self._generation:
            self.clear()
            self._generation = query.generation
        for source in self._sources:
            source.vote(query)
        # what was good at the last keyframe is tried again, whatever the votes say now
        hypotheses = [*self._voted(query), *self._remembered]
        suggested = self._suggested(query)
        moving = prepare_scan(query.submap, query.position, self.config.registration)
        candidates = self._refinement.refine([*hypotheses, *suggested], moving, query)
        if suggested:
            self._trials.tried(self._refuted(suggested, candidates, query))
        self._remembered = [
            replace(c.hypothesis, T_map_odom=c.T_map_odom, lead=0.0)
            for c in candidates[:_REMEMBERED]
            if c.evidence.score >= self.config.acceptance.score
        ]
        verdict = self._decision.judge(candidates, query, max(map(len, self._sources)))
        if verdict.accepted is not None:
            self.clear()
        return replace(verdict, travelled=query.travelled, generation=query.generation)

    def _voted(self, query: SearchRequest) -> list[Hypothesis]:
        """Return what the sources name, and only once what both do, if one of the two is exact: that one."""
        learned = [] if self.learned is None else self.learned.hypotheses()
        coview = [] if self.coview is None else self.coview.hypotheses()
        return [
            each
            for each in coview
            if not any(o.exact and same_place(each.T_map_odom, o.T_map_odom, query) for o in learned)
        ] + learned

    def _suggested(self, query: SearchRequest) -> list[Hypothesis]:
        """Return the suggestions to try now, but none that is remembered from the last keyframe."""
        return [
            each
            for each in self._trials.due(query.suggested)
            if not any(same_place(each.T_map_odom, other.T_map_odom, query) for other in self._remembered)
        ]

    def _refuted(
        self, suggested: list[Hypothesis], candidates: list[Candidate], query: SearchRequest
    ) -> bool:
        """Whether this keyframe speaks against all suggestions; where the map knows nothing, it does not."""
        best = max((c.evidence.score for c in candidates if c.hypothesis.station is None), default=0.0)
        known = [
            self.base_map.surveyed(robot_position(h.T_map_odom, query.T_odom_body)).all() for h in suggested
        ]
        return all(known) and best < self.config.acceptance.score
