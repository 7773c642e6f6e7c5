"""The decision on a search: a place is accepted once it has led all rivals, often and clearly enough."""

from __future__ import annotations

from dataclasses import dataclass, field

from coview_stream.config import LocalizerConfig
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.pose_hints import FROM_THERE
from coview_stream.localization.search.refinement import Candidate
from coview_stream.localization.search.request import FIRST_EPOCH, Epoch, SearchRequest, same_place
from coview_stream.localization.search.scoring import Rivals, Scored, ScoredPlace
from coview_stream.localization.state import State

BY_FEATURES = " (by learned features)"
"""What an evidence's reason ends with where learned features have named the best hypothesis."""


@dataclass(frozen=True)
class SearchResult:
    """Result of one keyframe's search.

    Attributes:
        accepted: the place, once there is one.
        evidence: of the best candidate, with the state it leads to and the reason.
        travelled: metres that odometry had driven at the keyframe.
        epoch: the request's.
        rivals: all places that the keyframe was scored at, the best candidate's among them.
    """

    accepted: Candidate | None
    evidence: KeyframeEvidence
    travelled: float = 0.0
    epoch: Epoch = FIRST_EPOCH
    rivals: Rivals = field(default_factory=Rivals.none)


class AcceptanceTest:
    """Judges keyframe by keyframe; remembers the leading place and the evidence that has added up for it."""

    def __init__(self, config: LocalizerConfig) -> None:
        self.config = config
        self.clear()

    def clear(self) -> None:
        """Forget the leading place."""
        self._leading: Candidate | None = None
        self._confirmed = 0
        self._evidence_sum = 0.0

    def decide(
        self, candidates: list[Candidate], request: SearchRequest, votes: int, scored: Scored | None = None
    ) -> SearchResult:
        """Judge a keyframe.

        Args:
            candidates: registered and verified, best first.
            request: the keyframe.
            votes: how many keyframes have voted for them.
            scored: all places that were scored, from which the candidates come.
        """
        rivals = Rivals.none() if scored is None else scored.rivals
        if not candidates:
            self.clear()
            reason = "no hypothesis fits the map" if votes else "too few points to search with"
            evidence = KeyframeEvidence(request.stamp, State.SEARCHING, reason)
            return SearchResult(None, evidence, request.travelled, request.epoch, rivals)
        best = candidates[0]
        here = [same_place(c.T_map_odom, best.T_map_odom, request) for c in candidates]
        rival = max((c.evidence.score for c, same in zip(candidates, here, strict=True) if not same), default=0.0)
        if scored is not None:
            rival = max(rival, _best_other(best, candidates, scored.places, request))
        lead = max(c.hypothesis.lead for c, same in zip(candidates, here, strict=True) if same)
        if not self._agrees(best, request):
            self.clear()
        state, reason = self._objection(best.evidence, rival, lead)
        if not reason and not self._has_rivals(best, candidates, request, votes):
            needed = self.config.acceptance.confirmations
            reason = f"rivals rest on {votes} keyframes' votes, {needed} needed"
        if not reason:
            self._leading = best
            self._confirmed += 1
            self._evidence_sum += self._increment(best.evidence, lead)
            state, reason = self._confirmation()
        if best.hypothesis.station is None:
            reason += FROM_THERE
        elif best.hypothesis.learned:
            reason += BY_FEATURES
        evidence = KeyframeEvidence(
            request.stamp, state, reason, best.evidence.score, rival, best.evidence,
            best.hypothesis.station, None if best.hypothesis.learned else best.hypothesis.shift,
        )  # fmt: skip
        accepted = best if state is State.TRACKING else None
        return SearchResult(accepted, evidence, request.travelled, request.epoch, rivals)

    def _objection(self, evidence: Evidence, rival: float, lead: float) -> tuple[State, str]:
        """Return why this keyframe does not count for its best candidate; an empty reason if it does.

        ``lead`` is by how much learned features favour the place.
        """
        rule, single = self.config.acceptance, self.config.stationary
        # co-view and learned votes agree, so relax both thresholds
        agreed = not single and lead >= rule.learned_lead
        min_score = rule.single_score if single else rule.learned_score if agreed else rule.score
        min_ground = rule.learned_ground if agreed else rule.ground
        min_lead = rule.single_lead if single else rule.lead
        if evidence.score < min_score or evidence.inside < rule.min_overlap:
            return State.SEARCHING, f"no place fits: best score {evidence.score:.2f}, {min_score:.2f} needed"
        if evidence.ground < min_ground:
            return (State.AMBIGUOUS, f"the ground does not fit: {evidence.ground:.2f}, {min_ground:.2f} needed")
        if evidence.score - rival < min_lead:
            return State.AMBIGUOUS, f"two places fit: scores {evidence.score:.2f} and {rival:.2f}"
        return State.AMBIGUOUS, ""

    def _has_rivals(self, best: Candidate, candidates: list[Candidate], request: SearchRequest, votes: int) -> bool:
        """Tell whether enough keyframes have voted for rivals of the best; a place found by votes needs no more."""
        voted = any(
            c.hypothesis.station is not None and same_place(c.T_map_odom, best.T_map_odom, request) for c in candidates
        )
        return voted or votes >= self.config.acceptance.confirmations

    def _increment(self, evidence: Evidence, lead: float) -> float:
        """Return what a keyframe adds to the evidence: less if much of what it saw is not on the map.

        More if the place is also the one that learned features favour most, for they know nothing of its fit.
        """
        rule = self.config.acceptance
        beyond = evidence.score - (rule.learned_floor if lead > 0 else rule.evidence_floor)
        return max(0.0, beyond) * min(1.0, evidence.inside / rule.full_overlap)

    def _confirmation(self) -> tuple[State, str]:
        rule = self.config.acceptance
        if self.config.stationary:
            return State.TRACKING, "one scan, no rival within the required lead"
        total = f"{self._evidence_sum:.2f} of {rule.evidence_sum:.2f}"
        keyframes = "1 keyframe" if self._confirmed == 1 else f"{self._confirmed} keyframes"
        reason = f"confirmed by {keyframes}, evidence {total}"
        enough = self._confirmed >= rule.confirmations and self._evidence_sum >= rule.evidence_sum
        return State.TRACKING if enough else State.AMBIGUOUS, reason

    def _agrees(self, best: Candidate, request: SearchRequest) -> bool:
        rule = self.config.acceptance
        return self._leading is not None and same_place(
            best.T_map_odom, self._leading.T_map_odom, request, rule.agree_distance, rule.agree_angle
        )


def _best_other(
    best: Candidate, candidates: list[Candidate], places: list[ScoredPlace], request: SearchRequest
) -> float:
    """Return the rank of the best place that was scored but not registered; 0 if there is none."""
    registered = {id(c.place) for c in candidates}
    for place in places:  # best first
        elsewhere = not same_place(place.hypothesis.T_map_odom, best.T_map_odom, request)
        if id(place) not in registered and elsewhere:
            return place.rank
    return 0.0
