"""When to believe what a search has found: once one place has stood alone, often and clearly enough."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.config import LocalizerConfig
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.result import KeyframeEvidence, State
from coview_stream.localization.search.pose_hints import FROM_THERE
from coview_stream.localization.search.refinement import Candidate
from coview_stream.localization.search.request import SearchRequest, same_place

BY_FEATURES = " (by learned features)"
"""What an evidence's reason ends with where learned features have named the best hypothesis."""


@dataclass(frozen=True)
class SearchResult:
    """What one keyframe's search came to: the accepted candidate if any, why, and the query's book-keeping."""

    accepted: Candidate | None
    evidence: KeyframeEvidence
    travelled: float = 0.0
    generation: int = 0


class AcceptanceTest:
    """Judges keyframe by keyframe, and remembers the favourite and what has spoken for it."""

    def __init__(self, config: LocalizerConfig) -> None:
        self.config = config
        self.clear()

    def clear(self) -> None:
        """Have no favourite."""
        self._favourite: Candidate | None = None
        self._confirmed = 0
        self._proof = 0.0

    def judge(self, candidates: list[Candidate], query: SearchRequest, votes: int) -> SearchResult:
        """Take in a keyframe's candidates, best first; ``votes`` is how many keyframes have voted for them."""
        if not candidates:
            self.clear()
            reason = "no hypothesis fits the map" if votes else "too few points to search with"
            return SearchResult(None, KeyframeEvidence(query.stamp, State.SEARCHING, reason))
        best = candidates[0]
        here = [same_place(c.T_map_odom, best.T_map_odom, query) for c in candidates]
        rival = max(
            (c.evidence.score for c, same in zip(candidates, here, strict=True) if not same), default=0.0
        )
        favour = max(c.hypothesis.lead for c, same in zip(candidates, here, strict=True) if same)
        if not self._agrees(best, query):
            self.clear()
        state, doubt = self._doubt(best.evidence, rival, favour)
        if doubt is None and not self._has_rivals(best, candidates, query, votes):
            needed = self.config.acceptance.confirmations
            doubt = f"rivals rest on {votes} keyframes' votes, {needed} needed"
        if doubt is None:
            self._favourite = best
            self._confirmed += 1
            self._proof += self._increment(best.evidence, favour)
            state, doubt = self._confirmation()
        if best.hypothesis.station is None:
            doubt += FROM_THERE
        elif best.hypothesis.learned:
            doubt += BY_FEATURES
        return SearchResult(
            best if state is State.TRACKING else None,
            KeyframeEvidence(
                query.stamp, state, doubt, best.evidence.score, rival, best.evidence,
                best.hypothesis.station, None if best.hypothesis.learned else best.hypothesis.shift,
            ),
        )  # fmt: skip

    def _doubt(self, evidence: Evidence, rival: float, favour: float) -> tuple[State, str | None]:
        """Say why this keyframe does not count for its best candidate; None if it does."""
        rule, alone = self.config.acceptance, self.config.stationary
        # two that do not know of each other name the same place: each may be less sure of it
        clear = not alone and favour >= rule.favoured_lead
        least = rule.single_score if alone else rule.favoured_score if clear else rule.score
        ground = rule.favoured_ground if clear else rule.ground
        lead = rule.single_lead if alone else rule.lead
        if evidence.score < least or evidence.inside < rule.inside:
            return State.SEARCHING, f"no place fits: best score {evidence.score:.2f}, {least:.2f} needed"
        if evidence.ground < ground:
            return State.AMBIGUOUS, f"the ground does not fit: {evidence.ground:.2f}, {ground:.2f} needed"
        if evidence.score - rival < lead:
            return State.AMBIGUOUS, f"two places fit: scores {evidence.score:.2f} and {rival:.2f}"
        return State.AMBIGUOUS, None

    def _has_rivals(
        self, best: Candidate, candidates: list[Candidate], query: SearchRequest, votes: int
    ) -> bool:
        """Whether enough keyframes have voted for what else it might be; a place found by votes needs no more."""
        voted = any(
            c.hypothesis.station is not None and same_place(c.T_map_odom, best.T_map_odom, query)
            for c in candidates
        )
        return voted or votes >= self.config.acceptance.confirmations

    def _increment(self, evidence: Evidence, favour: float) -> float:
        """Return what a keyframe that counts adds to the proof: less if much of what it saw is not on the map.

        More if the place is also the one that learned features favour most, for they know nothing of its fit.
        """
        rule = self.config.acceptance
        beyond = evidence.score - (rule.favoured_floor if favour > 0 else rule.proof_floor)
        return max(0.0, beyond) * min(1.0, evidence.inside / rule.inside_fully)

    def _confirmation(self) -> tuple[State, str]:
        rule = self.config.acceptance
        if self.config.stationary:
            return State.TRACKING, "one scan, and it stands alone"
        reason = f"confirmed by {self._confirmed} keyframes, proof {self._proof:.2f} of {rule.proof:.2f}"
        enough = self._confirmed >= rule.confirmations and self._proof >= rule.proof
        return State.TRACKING if enough else State.AMBIGUOUS, reason

    def _agrees(self, best: Candidate, query: SearchRequest) -> bool:
        rule = self.config.acceptance
        return self._favourite is not None and same_place(
            best.T_map_odom, self._favourite.T_map_odom, query, rule.agree_distance, rule.agree_angle
        )
