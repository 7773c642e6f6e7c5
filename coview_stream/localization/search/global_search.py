"""Global search: hypotheses from a keyframe, their scores, and the decision to accept one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from coview_kernels import Move
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, LocalizerConfig
from coview_stream.descriptors.coview import Descriptor, on_ground
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_from, rot_z, tilt_of, yaw_of
from coview_stream.localization.calibration.calibration import lean_prior
from coview_stream.localization.evidence.moved_part import find_moved_part
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import LocalMaps, prepare_scan
from coview_stream.localization.search.acceptance import Considered, SearchResult, decide
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.hints import HintSchedule, on_the_ground, robot_position
from coview_stream.localization.search.lost_place import log_priors, weighed_by_odometry
from coview_stream.localization.search.places import BASIN_ANGLE, BASIN_DISTANCE, Scored
from coview_stream.localization.search.recognizers import CoViewRecognizer, PlaceRecognizer, SearchIndex
from coview_stream.localization.search.refinement import find_modes, levelled_by_frame, register_place
from coview_stream.localization.search.request import (
    EarlierKeyframe,
    Epoch,
    LostPlace,
    RequestSpec,
    SearchRequest,
    same_place,
)
from coview_stream.localization.search.scoring import PlaceScorer

_NEWEST_LOST = 8  # newest keyframes whose lost places are kept, as a search may go on from them
_ORDINARY = 20_000  # stations up to which the configured number of co-view hypotheses is enough
_GUESSES = 12  # most poses of a guess, and most rivals to register, that a keyframe tries
_NAMED = 4  # places like the leader, and rivals, that are looked at more closely, and by the next keyframe
_STREET = 12.0  # metres from the leader: reach of the farthest hypothesis around it after its largest move


@dataclass(frozen=True)
class Reading:
    """A keyframe, either as levelled or rotated further by the leader's lean, and the places scored with it."""

    request: SearchRequest  # the keyframe, rotated about the body
    scan: ObservedScan  # of the keyframe
    scored: Scored  # the places
    leader: Hypothesis | None  # the first place, registered; None if that failed
    level: Pose | None  # (4, 4) the leader's T_map_odom, levelled by the newest frame alone; None without a leader
    scorer: PlaceScorer  # of the places
    turn: Pose = field(default_factory=lambda: np.eye(4))  # (4, 4) rotated odometry frame <- odometry frame

    @property
    def leans(self) -> bool:
        """Whether the keyframe is rotated by a lean, so that the earlier scans are not levelled like its own."""
        return not np.array_equal(self.turn, np.eye(4))


class GlobalSearch:
    """Search of the whole map, one keyframe at a time (paper, eqs 1-13); docs/method.md follows its steps.

    Attributes:
        coview: recognizer by the paper's descriptors; None if unused.
        learned: recognizer by learned features; None if unused.
    """

    KERNELS = (
        "transform_unique", "polar_bin", "StationCodes", "distinct_poses", "field_scores", "align_planes",
        "crop_points",
    )  # fmt: skip
    """Names of its kernels, for :func:`coview_kernels.warm_up`."""

    def __init__(
        self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps, index: SearchIndex | None = None
    ) -> None:
        """Search a map; searches of one map may share ``index``. Raises as :meth:`SearchIndex.of`."""
        self.base_map = base_map
        self.config = config
        self._index = index = index or SearchIndex.of(base_map, config)
        self.coview: CoViewRecognizer | None = None
        self.learned: PlaceRecognizer | None = None
        if index.retrieval is not None:
            peaks = coview_peaks(config.consensus.peaks, len(base_map))
            self.coview = CoViewRecognizer(base_map, config, index.retrieval, peaks)
        if index.learned is not None:
            from coview_stream.localization.search.learned.matcher import LearnedRecognizer

            self.learned = LearnedRecognizer(base_map, config, index.learned)
        self._recognizers: list[PlaceRecognizer] = [r for r in (self.coview, self.learned) if r is not None]
        self._local_maps = local_maps
        self._scorer = PlaceScorer(base_map)
        self._epoch = Epoch()
        self.clear()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its recognizers."""
        return tuple(n for n, r in (("coview", self.coview), ("learned", self.learned)) if r is not None)

    @property
    def spec(self) -> RequestSpec:
        """Data that the search needs in its requests."""
        return RequestSpec(
            None if self.coview is None else self.base_map.descriptor_config,
            None if self.learned is None else self.config.learned.reach,
        )

    @property
    def last_query(self) -> dict[Channel, Descriptor]:
        """Descriptors (R, S) of the newest keyframe that voted by them, by channel."""
        return {} if self.coview is None else self.coview.last_query

    def prepare(self) -> None:
        """Load and compute ahead of the first update.

        Raises:
            InputError: the network of the learned features cannot be loaded.
        """
        self._index.prepare()
        _ = self.base_map.field.layers

    def clear(self) -> None:
        """Forget all votes and observations."""
        for recognizer in self._recognizers:
            recognizer.clear()
        self._hints = HintSchedule()
        self._guesses = HintSchedule()
        self._scorer.clear()
        self._keyframes = 0
        self._lost: list[LostPlace | None] = []  # at the first keyframe and the newest
        self._named: list[tuple[int, Hypothesis]] = []  # places for the next keyframe, each after its rank in the votes

    def reset(self) -> None:
        """Forget all votes and observations, and the newest descriptors."""
        self.clear()
        if self.coview is not None:
            self.coview.last_query = {}

    def update(self, request: SearchRequest) -> SearchResult:
        """Search the map for one keyframe; another epoch or an acceptance starts a new search."""
        if request.epoch != self._epoch:
            self._begin(request)
        self._lost = [*self._lost[:1], *self._lost[1:][-_NEWEST_LOST:], request.lost]
        self._scorer.area = request.area
        for recognizer in self._recognizers:
            recognizer.vote(request)  # eqs 1-9: descriptors, compared with all stations at all turns
        voted = [enumerate(r.hypotheses()) for r in self._recognizers]  # propose T_map_odom: peaks (eq. 12)
        named = [*(place for each in voted for place in each), *enumerate(self._guessed(request)), *self._named]
        hints = self._hints.due(request.hints)
        hypotheses, scan = [*(place for _, place in named), *hints], self._observed(request)
        ranks = [rank for rank, _ in named]
        scored = self._scorer.score(hypotheses, ranks, len(hints), scan, request.lean_prior)  # against chance
        leader = self._register(scored, scan, request)  # eq. 13, and the evidence there
        reading = Reading(request, scan, scored, leader, self._level(leader, request), self._scorer)
        self._keyframes += 1
        if scored.error >= self.config.acceptance.risk:
            reading = self._leaning(reading, hypotheses, ranks, len(hints)) or reading
        self._note_hints(reading.scored, hints, request)
        alike = self._alike(reading)
        best = sorted(alike, key=lambda place: -place.probability)[:_NAMED]
        self._named = [(int(reading.scorer.followed.votes[0]), place) for place in best]
        reading = replace(reading, scored=reading.scored.beside(alike))
        result, scored = self._decide(reading)
        if result.accepted is not None:
            self.clear()
        return replace(result, considered=Considered.of(scored, request, self.base_map.origin))

    def _decide(self, reading: Reading) -> tuple[SearchResult, Scored]:
        """Decide on a keyframe's first place by its rivals along the street, its modes, and moved parts."""
        request, scan, scored, leader = reading.request, reading.scan, reading.scored, reading.leader
        undecided, aside = 0.0, list[Hypothesis]()
        if leader is not None:
            scored = self._gathered(scored, leader, scan, request)
            scans = [scan] if reading.leans else [*self._scorer.scans[:-1], scan]
            begin = self._lost[0] if len(scans) > 1 else None
            context = request, scans, self.base_map, self.config, reading.scorer, begin
            if weighed_by_odometry(scored, leader, *context).error < self.config.acceptance.risk:
                place = scored.places[0]
                registered = leader

                def beside(poses: Floats) -> Floats:
                    by_path = log_priors(poses, registered, request, self.config, reading.scorer, begin)
                    return reading.scorer.beside(poses) + by_path

                modes = find_modes(place, leader, scan, request, self.base_map, self.config, self._local_maps, beside)
                leader, undecided = modes.best, modes.undecided
                aside = modes.distant if request.lost is not None else []  # a slip, or a moved building
                if not undecided:
                    scored = scored.beside(self._registered_rivals(replace(reading, scored=scored), leader))
            scored = weighed_by_odometry(scored, leader, *context).beside(aside)  # may be another pose than before
            if scored.error < 0.5:  # a stated error has to be true even if nothing follows from it
                scored = scored.doubted(find_moved_part(self.base_map.field, scans, leader.T_map_odom))
        result = decide(scored, leader, request, self.config.acceptance, undecided)
        level = reading.level if leader is reading.leader else self._level(leader, request)
        if level is not None:
            result = replace(result, leader=level @ reading.turn)
        if result.accepted is not None:
            result = replace(result, accepted=result.accepted.after(reading.turn))
        return result, scored

    def _registered_rivals(self, reading: Reading, leader: Hypothesis) -> list[Hypothesis]:
        """Return the leader's best rivals, registered; their ``probability`` is the gain of their odds against it.

        A rival may have moved to a pose half a metre off its best one, where a copy of the leader explains far less.
        The next keyframe starts from the registered poses.
        """
        request, scan, scored = reading.request, reading.scan, reading.scored
        taken, rivals = [leader.T_map_odom, scored.places[0].T_map_odom], list[int]()
        votes, count = reading.scorer.followed.votes, len(scored.places)
        ranks = np.concatenate([votes, np.full(count - len(votes), votes[0])])  # only the map names the last places

        def new(T_map_odom: Pose) -> bool:
            return not any(same_place(T_map_odom, T, request, BASIN_DISTANCE, BASIN_ANGLE) for T in taken)

        order = np.argsort(np.log1p(ranks) - [place.ratio for place in scored.places], kind="stable").tolist()
        for k in [k for k in order if new(scored.places[k].T_map_odom)][:_GUESSES]:
            place, widest = scored.places[k], self.config.registration.search[0]
            found = register_place(place, scan, self.base_map, self.config, self._local_maps, widest=widest)
            if new((found or place).T_map_odom):
                taken.append((found or place).T_map_odom)
                rivals.append(k)
            if len(rivals) == _NAMED:
                break
        if not rivals:
            return []
        own = ranks[rivals]
        out = reading.scorer.at_their_best(leader.T_map_odom, np.array(taken[2:]), own, scan)
        known = zip(own.tolist(), out, strict=True)
        self._named = [*((rank, place) for rank, place in known if place.probability > 0.0), *self._named]
        before = np.array([scored.places[k].probability for k in rivals]) / max(1.0 - scored.error, 1e-9)
        gains = np.maximum([place.probability for place in out] - before, 0.0)
        return [replace(place, probability=gain) for place, gain in zip(out, gains.tolist(), strict=True)]

    def _alike(self, reading: Reading) -> list[Hypothesis]:
        """Return places that look like a probable leader's on the map, with their odds against it.

        The votes of a scan may miss one: near the border, where the map shows a part of the view, or on a flat site.
        """
        scored, leader = reading.scored, reading.leader
        if self.coview is None or not scored.places:
            return []
        street = [] if leader is None else self._along_street(scored, leader, reading.request)
        if scored.error - sum(place.probability for place in street) >= 0.5:
            return []
        places = self.coview.alike(scored.places[0].T_map_odom)
        return reading.scorer.beside_leader(places, reading.scan) if len(places) else []

    def _level(self, leader: Hypothesis | None, request: SearchRequest) -> Pose | None:
        if leader is None:
            return None
        return levelled_by_frame(leader.T_map_odom, request, self.config.registration, self._local_maps)

    def _leaning(self, upright: Reading, hypotheses: list[Hypothesis], ranks: list[int], hints: int) -> Reading | None:
        """Return the keyframe rotated by the leader's lean, and its places; None for a small lean or another leader.

        A sensor leans alike at all places: all are scored again by this keyframe alone, among chance places of the same
        lean. As the lean was fitted, its prior probability counts, and each keyframe so far counts as another start of
        the search.
        """
        request, leader, seen = upright.request, upright.leader, upright.level
        if leader is None or seen is None:
            return None
        R = rot_z(-yaw_of(seen)) @ seen[:3, :3]
        prior = lean_prior(tilt_of(seen), request.calibration.sigma_tilt)
        if prior == 0.0:
            return None
        turned = request.turned(R)
        scan = self._observed(turned)
        scorer = PlaceScorer(self.base_map)
        scorer.starts, scorer.area = self._scorer.starts * self._keyframes, request.area
        if self._keyframes > 1:
            followed = self._scorer.followed
            hypotheses, ranks = [*followed.hypotheses, *hypotheses], [*followed.votes.tolist(), *ranks]
        scored = scorer.score(hypotheses, ranks, hints, scan, prior + request.lean_prior)
        found = self._register(scored, scan, turned)
        if found is None or not same_place(found.T_map_odom, leader.T_map_odom, turned, BASIN_DISTANCE, BASIN_ANGLE):
            return None
        about_body = request.position
        turn = pose_from(R, about_body - R @ about_body)
        level = self._level(found, turned)
        return Reading(turned, scan, scored.together_with(upright.scored), found, level, scorer, turn)

    def _begin(self, request: SearchRequest) -> None:
        """Restart with a request, or continue with its earlier keyframes, which does not count as another start."""
        starts = self._scorer.starts + (bool(self._scorer.scans) and not request.earlier)
        keyframes = self._keyframes if request.earlier else 0
        lost = self._lost[-len(request.earlier) :] if request.earlier else []
        self.clear()
        self._epoch, self._scorer.starts, self._keyframes, self._lost = request.epoch, starts, keyframes, lost
        self._scorer.go_on_with([self._observed(each) for each in request.earlier])

    def _observed(self, keyframe: SearchRequest | EarlierKeyframe) -> ObservedScan:
        """Return a keyframe's scan."""
        cloud = prepare_scan(keyframe.submap, keyframe.T_odom_body[:3, 3], self.config.registration)
        return ObservedScan.of(cloud, keyframe.cloud, keyframe.T_odom_body)

    def _guessed(self, request: SearchRequest) -> list[Hypothesis]:
        """Return the best few poses of a guess, on the ground, whenever they are due.

        All poses of a guess lie around one place; more of them would pass for chance places of the map.
        """
        due = self._guesses.due(request.guesses)
        if not due:
            return []
        self._guesses.tried(refuted=True)
        points = request.scan if len(request.scan) else request.submap
        guesses = on_the_ground(due, on_ground(points, request.position), self.base_map.station_grid)
        if len(guesses) <= _GUESSES:
            return guesses
        scan = self._observed(request)
        poses = scan.poses(np.array([guess.T_map_odom for guess in guesses]))
        scores = scan.few.look_up(self.base_map.field, poses, Move.FAR).scores
        return [guesses[k] for k in np.argsort(-scores, kind="stable")[:_GUESSES]]

    def _register(self, scored: Scored, scan: ObservedScan, request: SearchRequest) -> Hypothesis | None:
        """Register the most probable place; None if the result is another place or leans."""
        if not scored.places:
            return None
        best = scored.places[0]
        leader = register_place(best, scan, self.base_map, self.config, self._local_maps)
        if leader is None or not same_place(leader.T_map_odom, best.T_map_odom, request, BASIN_DISTANCE, BASIN_ANGLE):
            return None
        return leader

    def _gathered(self, scored: Scored, leader: Hypothesis, scan: ObservedScan, request: SearchRequest) -> Scored:
        """Count rivals along the leader's street as the leader where registration takes them there.

        The field hardly separates poses a few metres along a street; points against surfaces do. Done only where it may
        lead to an acceptance.
        """
        risk, error = self.config.acceptance.risk, scored.error
        near = self._along_street(scored, leader, request)
        for k, place in enumerate(near[:_GUESSES]):
            if error < risk or error - sum(other.probability for other in near[k:]) >= risk:
                break
            found = register_place(
                place, scan, self.base_map, self.config, self._local_maps, widest=self.config.registration.search[0]
            )
            if found is not None and same_place(
                found.T_map_odom, leader.T_map_odom, request, BASIN_DISTANCE, BASIN_ANGLE
            ):
                error -= place.probability
        return replace(scored, error=max(error, scored.none))

    def _along_street(self, scored: Scored, leader: Hypothesis, request: SearchRequest) -> list[Hypothesis]:
        """Return the places within 12 m of the leader, at its heading, that are not its own; most probable first."""

        def around(place: Hypothesis, of: Hypothesis, distance: float) -> bool:
            return same_place(place.T_map_odom, of.T_map_odom, request, distance, BASIN_ANGLE)

        near = [
            place for place in scored.places[1:]
            if around(place, leader, _STREET) and not around(place, leader, BASIN_DISTANCE)
            and not around(place, scored.places[0], BASIN_DISTANCE)
        ]  # fmt: skip
        return sorted(near, key=lambda place: -place.probability)

    def _note_hints(self, scored: Scored, hints: list[Hypothesis], request: SearchRequest) -> None:
        """Record whether the keyframe refuted the hints that it tried."""
        if not hints:
            return
        best = max((place.ratio for place in scored.places if place.hinted), default=-math.inf)
        positions = [robot_position(hint.T_map_odom, request.T_odom_body) for hint in hints]
        # outside the survey a keyframe does not refute a hint
        surveyed = all(self.base_map.surveyed(position).all() for position in positions)
        self._hints.tried(refuted=surveyed and best < 0.0)


def coview_peaks(configured: int, stations: int) -> int:
    """Return the number of co-view hypotheses on a map with so many ``stations``.

    On an airborne map of 324,000 stations the right place came 70th to 250th, even by exhaustive sums.
    """
    return round(configured * math.sqrt(math.sqrt(max(1.0, stations / _ORDINARY))))
