"""Global search: from the ring buffer's newest keyframe to scored and verified hypotheses, and when to believe one."""

from __future__ import annotations

from dataclasses import replace

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, LocalizerConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.search.acceptance import AcceptanceTest, SearchResult
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.pose_hints import HintSchedule, robot_position
from coview_stream.localization.search.recognizers import CoViewRecognizer, PlaceRecognizer, SearchIndex
from coview_stream.localization.search.refinement import Candidate, RegisteredPlace, register_places, verify_places
from coview_stream.localization.search.request import Epoch, RequestSpec, SearchRequest
from coview_stream.localization.search.scoring import Scored, score_hypotheses

_REMEMBERED = 32  # best places that the next keyframe scores again; set by hand
REGISTERED = 3  # best places that are registered and verified, beside the hints; set by hand
_ORDINARY = 20_000  # stations up to which the configured number of co-view hypotheses is enough; set by hand
_MIN_SHARE = 0.5  # of the best one's rank: what is below that stays a rival as it has been scored; set by hand


class GlobalSearch:
    """Search of the whole map, a keyframe at a time (paper, Algorithm 1); docs/method.md follows its steps.

    Attributes:
        coview: the recognizer by the paper's descriptors; None if it is not used.
        learned: the recognizer by learned features; None if it is not used.
    """

    KERNELS = (
        "transform_unique", "describe_points", "distinct_poses", "field_scores", "align_planes",
        "crop_points", "match_points", "match_rays", "sort_beams",
    )  # fmt: skip
    """Names of the kernels that it runs, for :func:`coview_kernels.warm_up`."""

    def __init__(
        self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps, index: SearchIndex | None = None
    ) -> None:
        """Search a map; searches of one map may share ``index``. Raises what :meth:`SearchIndex.of` does."""
        self.base_map = base_map
        # many places a keyframe: GICP would have to prepare the map at each, and tracking starts with it anyway
        self.config = replace(config, registration=replace(config.registration, method="trimmed-icp"))
        index = index or SearchIndex.of(base_map, config)
        self.coview, self.learned = _recognizers(base_map, config, index)
        self._recognizers = [each for each in (self.coview, self.learned) if each is not None]
        self._local_maps = local_maps
        self._index = index
        self._acceptance = AcceptanceTest(self.config)
        self._epoch = Epoch()
        self.clear()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its recognizers."""
        return tuple(n for n, r in (("coview", self.coview), ("learned", self.learned)) if r is not None)

    @property
    def spec(self) -> RequestSpec:
        """Data that its requests have to bring."""
        return RequestSpec(
            None if self.coview is None else self.base_map.descriptor_config,
            None if self.learned is None else self.config.learned.reach,
        )

    @property
    def last_query(self) -> dict[Channel, Descriptor]:
        """Descriptors (R, S) of the newest keyframe that voted by them, by channel."""
        return {} if self.coview is None else self.coview.last_query

    def prepare(self) -> None:
        """Make now what the first update would: of the stations' index, of the learned features, of the field.

        Raises:
            InputError, DependencyError: the network of the learned features cannot be loaded.
        """
        self._index.prepare()
        _ = self.base_map.field.layers

    def clear(self) -> None:
        """Forget all votes and confirmations."""
        for recognizer in self._recognizers:
            recognizer.clear()
        self._remembered: list[Hypothesis] = []
        self._hints = HintSchedule()
        self._acceptance.clear()

    def reset(self) -> None:
        """Forget the newest descriptors as well."""
        self.clear()
        if self.coview is not None:
            self.coview.last_query = {}

    def update(self, request: SearchRequest) -> SearchResult:
        """Search the map for one keyframe; a request of another epoch, or one after an acceptance, starts anew."""
        if request.epoch != self._epoch:
            self.clear()
            self._epoch = request.epoch
        scan = ScanInput(
            prepare_scan(request.submap, request.position, self.config.registration), request.cloud, request.T_odom_body
        )
        votes = self._vote(request)  # eqs 1-9: descriptors, compared with all stations at all turns
        hypotheses, hints = self._propose(request)  # eq. 12: peaks of the consensus as T_map_odom
        scored = self._score(hypotheses, hints, scan)  # the likelihood field, at the best pose near each
        registered = self._register(scored, scan)  # eq. 13, the best few
        candidates = self._verify(registered)  # the evidence there
        self._remember(scored, candidates, hints, request)
        return self._decide(candidates, request, votes, scored)

    def _vote(self, request: SearchRequest) -> int:
        """Let every recognizer compare the keyframe with the map; return how many keyframes have voted."""
        for recognizer in self._recognizers:
            recognizer.vote(request)
        return max(map(len, self._recognizers))

    def _propose(self, request: SearchRequest) -> tuple[list[Hypothesis], list[Hypothesis]]:
        """Return what the votes name and what was good at the last keyframe; and the hints to try now."""
        learned = [] if self.learned is None else self.learned.hypotheses()
        coview = [] if self.coview is None else self.coview.hypotheses()
        return [*coview, *learned, *self._remembered], self._hints.due(request.hints)

    def _score(self, hypotheses: list[Hypothesis], hints: list[Hypothesis], scan: ScanInput) -> Scored:
        """Score all of them by the map's likelihood field, at the places that they come to."""
        return score_hypotheses(self.base_map.field, [*hypotheses, *hints], scan, _REMEMBERED, len(hints))

    def _register(self, scored: Scored, scan: ScanInput) -> list[RegisteredPlace]:
        """Register the best place, its rivals if they are not far below, and those that hints came to."""
        enough = _MIN_SHARE * scored.places[0].rank if scored.places else 0.0
        best = [place for place in scored.places[:REGISTERED] if place.rank >= enough]
        chosen = best + [p for p in scored.places[len(best) :] if p.hinted]
        return register_places(chosen, scan, self.base_map, self.config, self._local_maps)

    def _verify(self, registered: list[RegisteredPlace]) -> list[Candidate]:
        """Verify what was registered; best first."""
        return verify_places(registered)

    def _remember(
        self, scored: Scored, candidates: list[Candidate], hints: list[Hypothesis], request: SearchRequest
    ) -> None:
        """Keep what the next keyframe tries again: the best places, and hints that were not refuted."""
        if hints:
            best = max((c.evidence.score for c in candidates if c.place.hinted), default=0.0)
            positions = [robot_position(each.T_map_odom, request.T_odom_body) for each in hints]
            # where the map knows nothing, a keyframe does not speak against a hint
            surveyed = all(self.base_map.surveyed(position).all() for position in positions)
            self._hints.tried(refuted=surveyed and best < self.config.acceptance.score)
        self._remembered = [replace(place.hypothesis, lead=0.0) for place in scored.places[:_REMEMBERED]]

    def _decide(self, candidates: list[Candidate], request: SearchRequest, votes: int, scored: Scored) -> SearchResult:
        """Accept the best candidate, or say why not yet."""
        result = self._acceptance.decide(candidates, request, votes, scored)
        if result.accepted is not None:
            self.clear()
        return result


def _recognizers(
    base_map: BaseMap, config: LocalizerConfig, index: SearchIndex
) -> tuple[CoViewRecognizer | None, PlaceRecognizer | None]:
    """Return the recognizers by descriptors and by learned features, each None where it is not used."""
    learned: PlaceRecognizer | None = None
    if index.learned is not None:
        from coview_stream.localization.search.learned.recognizer import LearnedRecognizer

        learned = LearnedRecognizer(base_map, config, index.learned)
    # on an airborne map of 324,000 stations the right place came 70th to 250th, by exhaustive sums, too
    peaks = round(config.consensus.peaks * max(1.0, (len(base_map) / _ORDINARY) ** 0.25))
    coview = None if index.retrieval is None else CoViewRecognizer(base_map, config, index.retrieval, peaks)
    return coview, learned
