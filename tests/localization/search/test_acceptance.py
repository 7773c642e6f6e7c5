"""The acceptance test: what learned features that favour the same place add to weak evidence, and what not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coview_stream.config import AcceptanceConfig, LocalizerConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.registration.result import Registration
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.search.acceptance import AcceptanceTest
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.refinement import Candidate
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.scoring import ScoredPlace
from coview_stream.localization.state import State

RULE = AcceptanceConfig()
NOTHING = np.empty((0, 3), dtype=np.float32)
REQUEST = SearchRequest(7.0, pose_from(rot_z(0.3), [40.0, -25.0, 1.2]), NOTHING, NOTHING, NOTHING)
HERE, ELSEWHERE = (pose_from(rot_z(-0.8), [x, 9.0, 0.5]) for x in (3.0, 40.0))
WEAK = RULE.score + 0.03


def candidate(score: float, T_map_odom: np.ndarray = HERE, lead: float = 0.0, inside: float = 0.9) -> Candidate:
    hypothesis = Hypothesis(T_map_odom, 5, 2, -3.0, learned=True, lead=lead)
    found = Registration(T_map_odom, 1e4 * np.eye(6), 0.05, 2000, 20, True)
    return Candidate(ScoredPlace(hypothesis, score, inside), found, Evidence(score, score, 1.0, 1.0, inside))


def keyframes_needed(*candidates: Candidate) -> int | None:
    """Keyframes of the same candidates, best first, until the first is accepted; None if 40 are not enough."""
    test = AcceptanceTest(LocalizerConfig())
    for count in range(1, 41):
        if test.decide(list(candidates), REQUEST, count).accepted is not None:
            return count
    return None


def test_learned_support_lowers_evidence_sum_but_not_confirmations() -> None:
    alone = keyframes_needed(candidate(WEAK))
    favoured = keyframes_needed(candidate(WEAK, lead=1.0))
    assert alone is not None
    assert favoured is not None
    assert RULE.confirmations <= favoured < 0.6 * alone
    assert keyframes_needed(candidate(0.9, lead=100.0)) == RULE.confirmations


def test_candidate_partly_off_the_map_needs_more_keyframes() -> None:
    """At the map's edge a few points may fit anywhere: the fewer lie on it, the more keyframes are needed."""
    shares = [RULE.full_overlap, 0.75 * RULE.full_overlap, RULE.min_overlap]
    needed = [keyframes_needed(candidate(0.45, inside=share)) for share in shares]
    assert None not in needed
    assert needed == sorted(set(needed))
    assert keyframes_needed(candidate(0.45, inside=0.95)) == needed[0]


@pytest.mark.parametrize("lead", [0.0, -1.0])
def test_learned_votes_without_lead_add_no_support(lead: float) -> None:
    assert keyframes_needed(candidate(WEAK, lead=lead)) == keyframes_needed(candidate(WEAK))


def test_learned_votes_for_another_place_add_no_support() -> None:
    other = candidate(0.1, ELSEWHERE, lead=1.0)
    assert keyframes_needed(candidate(WEAK), other) == keyframes_needed(candidate(WEAK))


def test_learned_votes_count_for_place_named_by_coview() -> None:
    twin = candidate(WEAK - 0.01, lead=1.0)
    assert keyframes_needed(candidate(WEAK), twin) == keyframes_needed(candidate(WEAK, lead=1.0))


def test_learned_votes_do_not_accept_a_poor_fit() -> None:
    assert keyframes_needed(candidate(RULE.learned_score - 0.02, lead=100.0)) is None
    assert keyframes_needed(candidate(WEAK, lead=100.0), candidate(WEAK - 0.05, ELSEWHERE)) is None
    assert keyframes_needed(candidate(WEAK, lead=100.0, inside=RULE.min_overlap - 0.02)) is None


def test_lower_score_is_accepted_only_with_clear_learned_lead() -> None:
    low = RULE.score - 0.03
    assert keyframes_needed(candidate(low)) is None
    assert keyframes_needed(candidate(low, lead=0.9 * RULE.learned_lead)) is None
    needed = keyframes_needed(candidate(low, lead=RULE.learned_lead))
    assert needed is not None
    assert needed > RULE.confirmations


def test_single_scan_gets_no_learned_support() -> None:
    test = AcceptanceTest(replace(LocalizerConfig(), stationary=True))
    result = test.decide([candidate(RULE.single_score - 0.02, lead=100.0)], REQUEST, 1)
    assert result.evidence.state is State.SEARCHING
