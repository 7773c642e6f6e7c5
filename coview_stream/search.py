"""Global search: from the ring buffer's newest keyframe to verified hypotheses, and when to believe one."""

from __future__ import annotations

from dataclasses import replace

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, LocalizerConfig
from coview_stream.decision import Decision, Verdict
from coview_stream.place.consensus import Consensus, Hypothesis
from coview_stream.place.descriptor import Descriptor, describe, ground_below
from coview_stream.place.retrieval import Retrieval
from coview_stream.pose.registration import LocalMaps
from coview_stream.pose.source import local_source
from coview_stream.query import Query, same_place
from coview_stream.refinement import Candidate, Refinement
from coview_stream.suggestions import Trials, robot_in

__all__ = ["Candidate", "GlobalSearch", "Query", "Verdict"]

_REMEMBERED = 2  # best candidates that the next keyframe tries again


class GlobalSearch:
    """Votes, registers the best hypotheses, verifies them, and accepts one only when it stands alone."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps) -> None:
        self.base_map = base_map
        # eight places a keyframe: GICP would have to prepare the map at each, and tracking starts with it anyway
        self.config = replace(config, registration=replace(config.registration, method="trimmed-icp"))
        self.local_maps = local_maps
        self.retrieval = Retrieval(base_map, config.retrieval)
        self.consensus = Consensus(base_map.stations, base_map.config.block, config.consensus)
        self._refinement = Refinement(base_map, self.config, local_maps)
        self._decision = Decision(self.config)
        self.last_query: dict[Channel, Descriptor] = {}
        self._remembered: list[Hypothesis] = []
        self._trials = Trials()
        self._generation = 0

    def clear(self) -> None:
        """Forget all votes and confirmations."""
        self.consensus.clear()
        self._remembered = []
        self._trials = Trials()
        self._decision.clear()

    def update(self, query: Query) -> Verdict:
        """Take in one keyframe and judge; once a place is accepted, the next query starts the search anew."""
        if query.generation != self._generation:
            self.clear()
            self._generation = query.generation
        self._vote(query)
        # what was good at the last keyframe is tried again, whatever the votes say now
        hypotheses = [*self.consensus.hypotheses(), *self._remembered]
        suggested = self._suggested(query)
        source = local_source(query.submap, query.position, self.config.registration)
        candidates = self._refinement.refine([*hypotheses, *suggested], source, query)
        if suggested:
            self._trials.tried(self._refuted(suggested, candidates, query))
        self._remembered = [
            replace(c.hypothesis, T_map_odom=c.T_map_odom)
            for c in candidates[:_REMEMBERED]
            if c.evidence.score >= self.config.acceptance.score
        ]
        verdict = self._decision.judge(candidates, query, len(self.consensus))
        if verdict.accepted is not None:
            self.clear()
        return replace(verdict, travelled=query.travelled, generation=query.generation)

    def _vote(self, query: Query) -> None:
        descriptor = self.base_map.descriptor_config
        if len(query.scan) < self.config.keyframe.min_points:
            return
        centre = query.position.copy()
        if descriptor.ground_zero:
            centre[2] = ground_below(query.scan, query.position)
        self.last_query = describe(query.scan, centre, descriptor)
        if self.config.consensus.mode == "single":
            self.consensus.vote_nearest(centre, self.retrieval.best(self.last_query, 1), descriptor.sectors)
        else:
            self.consensus.vote(centre, self.retrieval.distances(self.last_query))

    def _suggested(self, query: Query) -> list[Hypothesis]:
        """Return the suggestions to try now, but none that is remembered from the last keyframe."""
        return [
            each
            for each in self._trials.due(query.suggested)
            if not any(same_place(each.T_map_odom, other.T_map_odom, query) for other in self._remembered)
        ]

    def _refuted(self, suggested: list[Hypothesis], candidates: list[Candidate], query: Query) -> bool:
        """Whether this keyframe speaks against all suggestions; where the map knows nothing, it does not."""
        best = max((c.evidence.score for c in candidates if c.hypothesis.station is None), default=0.0)
        known = [self.base_map.surveyed(robot_in(h.T_map_odom, query.T_odom_body)).all() for h in suggested]
        return all(known) and best < self.config.acceptance.score
