"""Global search: from the ring buffer's newest keyframe to verified hypotheses, and when to believe one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, DescriptorConfig, LocalizerConfig
from coview_stream.fix import KeyframeEvidence, State
from coview_stream.geometry import (
    Points,
    Pose,
    inverse,
    pose_from,
    rot_z,
    rotation_angle,
    tilt_of,
    transform,
    yaw_of,
)
from coview_stream.place.consensus import Consensus, Hypothesis
from coview_stream.place.descriptor import Descriptor, describe, ground_below
from coview_stream.place.keyframes import Keyframe, KeyframeBuffer
from coview_stream.place.retrieval import Retrieval
from coview_stream.pose.rays import RangeImage
from coview_stream.pose.registration import LocalMaps, Prior, Registration, Source, register
from coview_stream.pose.source import local_source
from coview_stream.pose.verification import Evidence, verify
from coview_stream.suggestions import FROM_THERE, Trials, robot_in

_SAME_DISTANCE = 2.0  # metres: hypotheses that registration brought this close together are one
_SAME_ANGLE = np.radians(5.0)
_SUBMAP_KEYFRAMES = 4  # of the newest in the local scan that is registered: more are smeared by drift
_COARSE_SCALES = 2  # of the registration's scales that every hypothesis goes through
_REMEMBERED = 2  # best candidates that the next keyframe tries again
_COARSE_EVERY = 3  # of the source's points, for the coarse scales only every third
_COARSE_ITERATIONS = 8
_HOPELESS = (
    0.5  # after them, what has less than this share of the best (or needed) score is not refined further
)


@dataclass(frozen=True)
class Query:
    """All that a search needs to know of one keyframe; whoever searches may do it later and elsewhere.

    Attributes:
        stamp: seconds, of the keyframe.
        T_odom_body: (4, 4) of the keyframe.
        scan: (N, 3) float32 virtual local scan, odometry frame, metres.
        submap: (N, 3) float32 points of the newest keyframes, odometry frame: what is registered.
        cloud: (N, 3) float32 newest frame, body frame.
        travelled: metres that odometry had driven.
        generation: of the localizer's memory; a query of another generation starts the search anew.
        suggested: (4, 4) each, ``T_map_odom`` that may be right: verified and judged as what the votes find.
    """

    stamp: float
    T_odom_body: Pose
    scan: Points
    submap: Points
    cloud: Points
    travelled: float = 0.0
    generation: int = 0
    suggested: tuple[Pose, ...] = ()

    @property
    def position(self) -> npt.NDArray[np.float64]:
        """(3,) sensor position in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

    @cached_property
    def seen(self) -> RangeImage:
        """The newest frame by direction."""
        return RangeImage.of(self.cloud)

    @classmethod
    def of(
        cls,
        buffer: KeyframeBuffer,
        keyframe: Keyframe,
        cloud: Points,
        descriptor: DescriptorConfig,
        travelled: float = 0.0,
        generation: int = 0,
        suggested: tuple[Pose, ...] = (),
    ) -> Query:
        """Ask about the newest keyframe of a buffer; ``cloud`` (N, 3) is its newest frame, body frame."""
        scan = buffer.virtual_scan(keyframe.position, descriptor.radius, descriptor.voxel)
        submap = buffer.recent(_SUBMAP_KEYFRAMES)
        return cls(
            keyframe.stamp, keyframe.T_odom_body, scan, submap, cloud, travelled, generation, suggested
        )


@dataclass(frozen=True)
class Candidate:
    """A registered and verified hypothesis of ``T_map_odom``."""

    hypothesis: Hypothesis
    registration: Registration
    evidence: Evidence

    @property
    def T_map_odom(self) -> Pose:
        """(4, 4) map <- odometry."""
        return self.registration.T_map_source


@dataclass(frozen=True)
class Verdict:
    """What one keyframe's search came to: the accepted candidate if any, why, and the query's book-keeping."""

    accepted: Candidate | None
    evidence: KeyframeEvidence
    travelled: float = 0.0
    generation: int = 0


class GlobalSearch:
    """Votes, registers the best hypotheses, verifies them, and accepts one only when it stands alone."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps) -> None:
        self.base_map = base_map
        # eight places a keyframe: GICP would have to prepare the map at each, and tracking starts with it anyway
        self.config = replace(config, registration=replace(config.registration, method="trimmed-icp"))
        self.local_maps = local_maps
        self.retrieval = Retrieval(base_map, config.retrieval)
        self.consensus = Consensus(base_map.stations, base_map.config.block, config.consensus)
        self.last_query: dict[Channel, Descriptor] = {}
        self._remembered: list[Hypothesis] = []
        self._trials = Trials()
        self._favourite: Candidate | None = None
        self._confirmed = 0
        self._proof = 0.0
        self._generation = 0

    def clear(self) -> None:
        """Forget all votes and confirmations."""
        self.consensus.clear()
        self._remembered = []
        self._trials = Trials()
        self._forget_favourite()

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
        candidates = self._refine([*hypotheses, *suggested], source, query)
        if suggested:
            self._trials.tried(self._refuted(suggested, candidates, query))
        self._remembered = [
            replace(c.hypothesis, T_map_odom=c.T_map_odom)
            for c in candidates[:_REMEMBERED]
            if c.evidence.score >= self.config.acceptance.score
        ]
        verdict = self._judge(candidates, query)
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
            if not any(_same(each.T_map_odom, other.T_map_odom, query) for other in self._remembered)
        ]

    def _refuted(self, suggested: list[Hypothesis], candidates: list[Candidate], query: Query) -> bool:
        """Whether this keyframe speaks against all suggestions; where the map knows nothing, it does not."""
        best = max((c.evidence.score for c in candidates if c.hypothesis.station is None), default=0.0)
        known = [self.base_map.surveyed(robot_in(h.T_map_odom, query.T_odom_body)).all() for h in suggested]
        return all(known) and best < self.config.acceptance.score

    def _refine(self, hypotheses: list[Hypothesis], source: Source, query: Query) -> list[Candidate]:
        """Return verified candidates, best first. All go through the coarse scales, the promising ones through all."""
        scales = self.config.registration.search
        rough = source.every(_COARSE_EVERY)
        coarse = [
            candidate
            for hypothesis in hypotheses
            if (candidate := self._candidate(hypothesis, rough, source, query, scales[:_COARSE_SCALES]))
        ]
        coarse.sort(key=lambda c: -c.evidence.score)
        enough = _HOPELESS * max(coarse[0].evidence.score if coarse else 0.0, self.config.acceptance.score)
        fine: list[Candidate] = []
        for rank, candidate in enumerate(coarse):
            # the best and its rival are compared on equal terms; what is far below them stays as it is
            if coarse[0].evidence.score < enough or (rank > 1 and candidate.evidence.score < enough):
                fine.append(candidate)
                continue
            again = replace(candidate.hypothesis, T_map_odom=candidate.T_map_odom)
            refined = self._candidate(again, source, source, query, scales[_COARSE_SCALES:] or scales[-1:])
            if refined is not None:
                fine.append(refined)
        return sorted(fine, key=lambda c: -c.evidence.score)

    def _candidate(
        self,
        hypothesis: Hypothesis,
        moving: Source,
        source: Source,
        query: Query,
        scales: tuple[float, ...],
    ) -> Candidate | None:
        """Register ``moving`` from the hypothesis and verify with ``source``; None if it finds no hold or tilts."""
        start = hypothesis.T_map_odom
        target = self.local_maps.around(transform(start, query.position[None])[0])
        if target is None:
            return None
        level = pose_from(rot_z(yaw_of(start)), start[:3, 3])
        upright = Prior(level, gravity_information(self.config.registration.gravity_sigma))
        iterations = None if moving is source else _COARSE_ITERATIONS
        found = register(
            moving, start, target, self.config.registration, scales, upright, query.position, iterations
        )
        if found is None or tilt_of(found.T_map_source) > self.config.acceptance.most_tilt:
            return None
        T = found.T_map_source
        surveyed = self.base_map.surveyed(transform(T, source.points)[:, :2])
        evidence = verify(source, T, query.seen, T @ query.T_odom_body, target, surveyed)
        return Candidate(hypothesis, found, evidence)

    def _judge(self, candidates: list[Candidate], query: Query) -> Verdict:
        """Accept the best candidate once it has stood alone often and clearly enough."""
        if not candidates:
            self._forget_favourite()
            seen = len(self.consensus)
            reason = "no hypothesis fits the map" if seen else "too few points to search with"
            return Verdict(None, KeyframeEvidence(query.stamp, State.SEARCHING, reason))
        best = candidates[0]
        rival = max(
            (c.evidence.score for c in candidates[1:] if not _same(c.T_map_odom, best.T_map_odom, query)),
            default=0.0,
        )
        if not self._agrees(best, query):
            self._forget_favourite()
        state, doubt = self._doubt(best.evidence, rival)
        if doubt is None and not self._has_rivals(best, candidates, query):
            needed = self.config.acceptance.confirmations
            doubt = f"rivals rest on {len(self.consensus)} keyframes' votes, {needed} needed"
        if doubt is None:
            self._favourite = best
            self._confirmed += 1
            self._proof += max(0.0, best.evidence.score - self.config.acceptance.proof_floor)
            state, doubt = self._confirmation()
        if best.hypothesis.station is None:
            doubt += FROM_THERE
        return Verdict(
            best if state is State.TRACKING else None,
            KeyframeEvidence(
                query.stamp, state, doubt, best.evidence.score, rival, best.evidence,
                best.hypothesis.station, best.hypothesis.shift,
            ),
        )  # fmt: skip

    def _doubt(self, evidence: Evidence, rival: float) -> tuple[State, str | None]:
        """Say why this keyframe does not count for its best candidate; None if it does."""
        rule, alone = self.config.acceptance, self.config.stationary
        least = rule.single_score if alone else rule.score
        lead = rule.single_lead if alone else rule.lead
        if evidence.score < least or evidence.inside < rule.inside:
            return State.SEARCHING, f"no place fits: best score {evidence.score:.2f}, {least:.2f} needed"
        if evidence.ground < rule.ground:
            return (
                State.AMBIGUOUS,
                f"the ground does not fit: {evidence.ground:.2f}, {rule.ground:.2f} needed",
            )
        if evidence.score - rival < lead:
            return State.AMBIGUOUS, f"two places fit: scores {evidence.score:.2f} and {rival:.2f}"
        return State.AMBIGUOUS, None

    def _has_rivals(self, best: Candidate, candidates: list[Candidate], query: Query) -> bool:
        """Whether enough keyframes have voted for what else it might be; a place found by votes needs no more."""
        voted = any(
            c.hypothesis.station is not None and _same(c.T_map_odom, best.T_map_odom, query)
            for c in candidates
        )
        return voted or len(self.consensus) >= self.config.acceptance.confirmations

    def _confirmation(self) -> tuple[State, str]:
        rule = self.config.acceptance
        if self.config.stationary:
            return State.TRACKING, "one scan, and it stands alone"
        reason = f"confirmed by {self._confirmed} keyframes, proof {self._proof:.2f} of {rule.proof:.2f}"
        enough = self._confirmed >= rule.confirmations and self._proof >= rule.proof
        return State.TRACKING if enough else State.AMBIGUOUS, reason

    def _forget_favourite(self) -> None:
        self._favourite, self._confirmed, self._proof = None, 0, 0.0

    def _agrees(self, best: Candidate, query: Query) -> bool:
        rule = self.config.acceptance
        return self._favourite is not None and _same(
            best.T_map_odom, self._favourite.T_map_odom, query, rule.agree_distance, rule.agree_angle
        )


def gravity_information(sigma: float) -> npt.NDArray[np.float64]:
    """Information (6, 6) over (rx, ry, rz, x, y, z) of "both frames are level to ``sigma`` radians"."""
    return np.diag([sigma**-2, sigma**-2, 0.0, 0.0, 0.0, 0.0])


def _same(
    T_a: Pose,
    T_b: Pose,
    query: Query,
    distance: float = _SAME_DISTANCE,
    angle: float = float(_SAME_ANGLE),
) -> bool:
    """Whether two ``T_map_odom`` put the keyframe at the same place and heading."""
    a, b = T_a @ query.T_odom_body, T_b @ query.T_odom_body
    apart = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return apart < distance and rotation_angle(inverse(a) @ b) < angle
