"""Verdicts on registrations: each cause is named, by its own threshold and against the usual evidence."""

from __future__ import annotations

from dataclasses import replace

import pytest

from coview_stream.config import AcceptanceConfig
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.tracking.monitor import EvidenceBaseline, MatchVerdict, RejectionReason

RULE = AcceptanceConfig(tracking_min_score=0.22, tracking_min_share=0.5, tracking_min_ground=0.5, min_overlap=0.3)
GOOD = Evidence(near=0.8, covered=0.9, ground=0.95, free_space=0.9, inside=1.0)


@pytest.fixture
def used():
    """Used to places that fit well."""
    baseline = EvidenceBaseline()
    for _ in range(10):
        baseline.learn(GOOD)
    return baseline


@pytest.mark.parametrize("baseline", ["fresh", "used"])
def test_normal_evidence_is_verified(baseline, used):
    cause, reason = (used if baseline == "used" else EvidenceBaseline()).judge(GOOD, RULE)
    assert cause is RejectionReason.VERIFIED
    assert reason == "verified"


@pytest.mark.parametrize(
    ("changes", "cause", "told"),
    [
        ({"inside": 0.25}, RejectionReason.OFF_MAP, "25% of what is seen lies on the map"),
        ({"ground": 0.4}, RejectionReason.GROUND, "only 40% of the ground"),
        ({"near": 0.1, "covered": 0.2}, RejectionReason.FITNESS, "10% of what stands above the ground"),
        ({"free_space": 0.05}, RejectionReason.FREE_SPACE, "rays pass through 95% of the map"),
    ],
)
@pytest.mark.parametrize("baseline", ["fresh", "used"])
def test_each_failed_share_names_its_cause(changes, cause, told, baseline, used):
    found, reason = (used if baseline == "used" else EvidenceBaseline()).judge(replace(GOOD, **changes), RULE)
    assert found is cause
    assert told in reason


def test_off_map_takes_precedence_over_poor_fit():
    """What the map does not cover is no evidence against the place."""
    cause, _ = EvidenceBaseline().judge(replace(GOOD, inside=0.1, ground=0.0, near=0.0), RULE)
    assert cause is RejectionReason.OFF_MAP


def test_score_far_below_baseline_is_rejected(used):
    """A score of 0.3: right in a street where half of everything is hidden, wrong where 0.8 is usual."""
    poor = Evidence(near=0.3, covered=0.45, ground=0.85, free_space=0.8, inside=1.0)
    assert RULE.tracking_min_score < poor.score < RULE.tracking_min_share * used.usual.score
    assert EvidenceBaseline().judge(poor, RULE)[0] is RejectionReason.VERIFIED
    cause, reason = used.judge(poor, RULE)
    assert cause is RejectionReason.FITNESS
    assert f"score {poor.score:.2f}, {RULE.tracking_min_share * GOOD.score:.2f} needed" in reason
    assert "80% usual here" in reason
    poor_baseline = EvidenceBaseline()
    poor_baseline.learn(poor)
    assert poor_baseline.judge(poor, RULE)[0] is RejectionReason.VERIFIED


def test_poor_baseline_does_not_lower_the_absolute_threshold():
    bad = replace(GOOD, near=0.05, covered=0.5)
    assert bad.score < RULE.tracking_min_score
    baseline = EvidenceBaseline()
    baseline.learn(bad)
    cause, reason = baseline.judge(bad, RULE)
    assert cause is not RejectionReason.VERIFIED
    assert f"{RULE.tracking_min_score:.2f} needed" in reason


def test_cause_is_the_share_furthest_below_baseline():
    """Where hardly anything above the ground is ever on the map, rays through what it shows are the news."""
    baseline, usual = (EvidenceBaseline(), Evidence(near=0.45, covered=0.6, ground=0.9, free_space=0.9, inside=1.0))
    baseline.learn(usual)
    tight = replace(RULE, tracking_min_share=0.9)
    assert baseline.judge(replace(usual, free_space=0.5, near=0.4), tight)[0] is RejectionReason.FREE_SPACE
    assert baseline.judge(replace(usual, ground=0.6, near=0.42), tight)[0] is RejectionReason.GROUND
    assert baseline.judge(replace(usual, free_space=0.8, near=0.2), tight)[0] is RejectionReason.FITNESS


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


def test_judging_does_not_change_the_baseline(used):
    before = used.usual
    used.judge(replace(GOOD, near=0.1), RULE)
    assert used.usual == before


@pytest.mark.parametrize("cause", list(RejectionReason))
def test_match_verdict_has_verified_flag_and_score(cause):
    verdict = MatchVerdict(cause, "why", GOOD)
    assert verdict.verified == (cause is RejectionReason.VERIFIED)
    assert verdict.score == GOOD.score
    assert MatchVerdict(cause, "why").score == 0.0
