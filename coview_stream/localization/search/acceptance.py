"""Acceptance: a place is accepted once the probability that it is wrong is below the integrity risk."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from coview_stream.config import AcceptanceConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import one_in
from coview_stream.geometry.transforms import Pose, yaw_of
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.hints import FROM_THERE
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.request import FIRST_EPOCH, Epoch, SearchRequest
from coview_stream.localization.state import State

BY_FEATURES = " (by learned features)"
"""End of an evidence's reason where the best hypothesis came from learned features."""

IN_CIRCLE = " (searched in the circle given)"
"""End of a reason for no pose where only a circle was searched."""

MAX_PLACES = 20  # a screen shows them clearly, and the message stays below 3 kB


@dataclass(frozen=True)
class Considered:
    """The most probable places of a robot at a keyframe, for display only.

    Attributes:
        stamp: of the keyframe, seconds.
        places: (K, 6) float64, most probable first: x, y, z and yaw of the body in the frame of the map's sources
            (metres, radians), posterior probability, log-likelihood ratio against chance.
        none: probability that the robot is at no place of the map.
    """

    stamp: float
    places: Floats
    none: float

    @classmethod
    def of(cls, scored: Scored, request: SearchRequest, origin: Floats) -> Considered | None:
        """Return a keyframe's places on a map with ``origin`` (3,); None without any place."""
        rows = []
        for place in sorted(scored.places, key=lambda place: -place.probability)[:MAX_PLACES]:
            T_map_body = place.T_map_odom @ request.T_odom_body
            rows.append([*(T_map_body[:3, 3] + origin), yaw_of(T_map_body), place.probability, place.ratio])
        return cls(request.stamp, np.array(rows, dtype=np.float64), float(scored.none)) if rows else None


@dataclass(frozen=True)
class SearchResult:
    """Result of one keyframe's search."""

    accepted: Hypothesis | None  # the registered place; None if none is accepted
    evidence: KeyframeEvidence  # of the most probable place, with the resulting state and the reason
    travelled: float = 0.0  # metres that odometry had driven at the keyframe
    epoch: Epoch = FIRST_EPOCH  # of the request
    rivals: int = 0  # number of distinct places of the keyframe
    # (4, 4) T_map_odom of the most probable place, registered if that succeeded, levelled by the newest frame alone;
    # None without any place
    leader: Pose | None = None
    T_odom_body: Pose = field(default_factory=lambda: np.eye(4))  # (4, 4) of the keyframe
    calibration: Calibration = field(default_factory=Calibration)  # that levelled the keyframe's clouds
    considered: Considered | None = None  # the most probable places, for display; None without any place

    @property
    def T_map_cloud(self) -> Pose | None:
        """(4, 4) pose of the keyframe's cloud in the sensor's own axes, by the leader; None without a leader."""
        return None if self.leader is None else self.leader @ self.T_odom_body @ self.calibration.T_body_cloud


def decide(
    scored: Scored, leader: Hypothesis | None, request: SearchRequest, rule: AcceptanceConfig, undecided: float = 0.0
) -> SearchResult:
    """Decide on a keyframe's places by ``rule``, the integrity risk.

    ``leader`` is the most probable place, registered; None if that failed. ``undecided`` is the distance in metres
    between equally probable poses of the first place; 0 if one of them stands out.
    """
    state, reason = _verdict(scored, leader, rule, undecided)
    if request.area is not None and state is not State.TRACKING:
        reason += IN_CIRCLE
    evidence, T_map_odom = KeyframeEvidence(request.stamp, state, reason), None
    if scored.places:
        best, second = scored.places[0], scored.second
        if best.station is None and best.hinted:
            reason += FROM_THERE
        elif best.learned:
            reason += BY_FEATURES
        shares = None if leader is None else leader.evidence
        evidence = KeyframeEvidence(
            request.stamp, state, reason, best.score if shares is None else shares.score,
            0.0 if second is None else second.score, shares, best.station, None if best.learned else best.shift,
            confidence=1.0 - scored.error, by_chance=scored.by_chance,
        )  # fmt: skip
        T_map_odom = (leader or best).T_map_odom
    return SearchResult(
        leader if state is State.TRACKING else None, evidence, request.travelled, request.epoch, scored.rivals,
        T_map_odom, request.T_odom_body, request.calibration,
    )  # fmt: skip


def _verdict(scored: Scored, leader: Hypothesis | None, rule: AcceptanceConfig, undecided: float) -> tuple[State, str]:
    if not scored.places:
        return State.SEARCHING, "too few points to search with"
    if scored.error < rule.risk:
        if leader is None:
            return State.AMBIGUOUS, "the place that stands out does not register"
        if all(place.station is None for place in scored.places):
            return State.AMBIGUOUS, "no vote has named a place to compare it with"  # hints are not trusted
        if undecided:
            return State.AMBIGUOUS, f"the place is found, but poses {undecided:.1f} m apart fit there equally"
        return State.TRACKING, f"found: wrong {one_in(scored.error)}"
    if scored.moved.probability > scored.error:  # most of the error
        metres = f"{scored.moved.metres:.0f} m"
        wrong = f"wrong {one_in(scored.error)}, {one_in(rule.risk)} needed"
        return State.AMBIGUOUS, f"a part of the scan may fit {metres} beside the rest: {wrong}"
    if scored.none > 0.5:
        if scored.by_chance < 1.5:
            return State.SEARCHING, "no place stands out: the best fits no better than chance would have it"
        if scored.by_chance > 0.5 * scored.rivals:
            return State.SEARCHING, f"no place stands out: none of {scored.rivals} fits better than chance"
        return State.SEARCHING, f"no place stands out: {scored.by_chance:.0f} places would fit as well by chance"
    best, second = scored.places[0], scored.second
    if second is not None and second.probability > scored.none:
        times = best.probability / max(second.probability, 1e-300)
        ratio = f"{times:,.0f}" if times < 1e6 else "over 1,000,000"
        lead = "equally" if times < 1.5 else f"the first is {ratio} times as probable"
        left = scored.left
        return State.AMBIGUOUS, f"{left if left > 2 else 'two'} places fit: {lead}"
    if scored.error >= 0.5:
        return State.AMBIGUOUS, f"{max(2, scored.left)} places fit, none is more likely than all others"
    return State.AMBIGUOUS, f"one place leads: wrong {one_in(scored.error)}, {one_in(rule.risk)} needed"
