"""Verdicts on registrations: what speaks against a place is explained by the share that has fallen furthest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coview_stream.localization.evidence.likelihood import NUISANCES
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.tracking.monitor import EvidenceBaseline, MatchVerdict, RejectionReason
from coview_stream.localization.tracking.place_evidence import Observation

GOOD = Evidence(near=0.8, covered=0.9, ground=0.95, free_space=0.9, inside=1.0)


@pytest.fixture
def used():
    """Used to places that fit well."""
    baseline = EvidenceBaseline()
    for _ in range(10):
        baseline.learn(GOOD)
    return baseline


@pytest.mark.parametrize(
    ("changes", "cause", "told"),
    [
        ({"inside": 0.25}, RejectionReason.OFF_MAP, "only 25% of what is seen lies on the map"),
        ({"ground": 0.4}, RejectionReason.GROUND, "only 40% of the ground lies on the map's"),
        ({"near": 0.1, "covered": 0.2}, RejectionReason.FITNESS, "10% of what stands above the ground is on the map"),
        ({"free_space": 0.05}, RejectionReason.FREE_SPACE, "rays pass through 95% of the map's points"),
    ],
)
@pytest.mark.parametrize("baseline", ["fresh", "used"])
def test_share_that_is_poor_names_its_cause(changes, cause, told, baseline, used):
    found, reason = (used if baseline == "used" else EvidenceBaseline()).explain(replace(GOOD, **changes))
    assert found is cause
    assert told in reason
    if cause is RejectionReason.FITNESS:
        assert ("80% usual here" in reason) == (baseline == "used")


@pytest.mark.parametrize("inside", [0.0, 0.2])
def test_off_the_map_comes_before_a_poor_fit(inside, used):
    """What little lies on the map's edge need not fit: that it is so little is the cause."""
    little = Evidence(near=0.0, covered=0.0, ground=0.0, free_space=0.0, inside=inside)
    for baseline in (EvidenceBaseline(), used):
        assert baseline.explain(little)[0] is RejectionReason.OFF_MAP
        assert baseline.explain(replace(little, inside=0.6))[0] is not RejectionReason.OFF_MAP


def test_cause_is_the_share_furthest_below_the_usual():
    """Where hardly anything above the ground is ever on the map, rays through what it shows are the news."""
    baseline, usual = (EvidenceBaseline(), Evidence(near=0.45, covered=0.6, ground=0.9, free_space=0.9, inside=0.6))
    baseline.learn(usual)
    assert baseline.explain(replace(usual, free_space=0.5, near=0.4))[0] is RejectionReason.FREE_SPACE
    assert baseline.explain(replace(usual, ground=0.6, near=0.42))[0] is RejectionReason.GROUND
    assert baseline.explain(replace(usual, free_space=0.8, near=0.2))[0] is RejectionReason.FITNESS
    assert baseline.explain(replace(usual, free_space=0.8, inside=0.4))[0] is RejectionReason.OFF_MAP


def test_baseline_follows_slowly_and_clears_at_once(used):
    worse = Evidence(near=0.4, covered=0.6, ground=0.8, free_space=0.7, inside=0.8)
    used.learn(worse)
    assert 0.7 < used.usual.near < 0.8
    assert 0.9 < used.usual.inside < 1.0
    for _ in range(30):
        used.learn(worse)
    for name, share in vars(worse).items():
        assert getattr(used.usual, name) == pytest.approx(share, abs=0.01)
    used.clear()
    assert used.usual is None
    used.learn(GOOD)
    assert used.usual == GOOD


def test_evidence_has_fallen_by_as_much_as_the_usual_is_better(used):
    half = replace(GOOD, near=0.25 * GOOD.near)  # the score is a root
    assert used.fallen(half) == pytest.approx(2.0)
    assert used.fallen(GOOD) == 1.0
    assert used.fallen(replace(GOOD, ground=1.0)) == 1.0  # better than usual
    assert EvidenceBaseline().fallen(half) == 1.0


def test_explaining_does_not_change_the_baseline(used):
    before = used.usual
    used.explain(replace(GOOD, near=0.1))
    assert used.usual == before


@pytest.mark.parametrize("cause", list(RejectionReason))
def test_match_verdict_has_verified_flag_score_and_ratio(cause):
    verdict = MatchVerdict(cause, "why", GOOD, None, Observation(-3.0, np.zeros(NUISANCES)))
    assert verdict.verified == (cause is RejectionReason.VERIFIED)
    assert (verdict.score, verdict.ratio) == (GOOD.score, -3.0)
    assert (MatchVerdict(cause, "why").score, MatchVerdict(cause, "why").ratio) == (0.0, 0.0)
