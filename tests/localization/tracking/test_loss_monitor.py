"""Doubt: one registration begins it, one clears it; driving on or time makes it too much; a long one wants proof."""

from __future__ import annotations

import pytest

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.localization.tracking.monitor import LossMonitor, MatchVerdict, RejectionReason

RULE = AcceptanceConfig(max_rejections=3, max_doubt_s=10.0, max_blind_s=60.0, confirmations=3)
GOOD = MatchVerdict(RejectionReason.VERIFIED, "verified")
BAD = MatchVerdict(RejectionReason.FITNESS, "nothing fits")
AGAINST = [
    RejectionReason.FITNESS,
    RejectionReason.GROUND,
    RejectionReason.FREE_SPACE,
    RejectionReason.TILT,
    RejectionReason.OFF_MAP,
]


@pytest.fixture
def doubt():
    return LossMonitor(RULE, TrackingConfig(distance=2.0, seconds=5.0))


def test_loss_monitor_starts_clear(doubt):
    assert not doubt.active
    assert not doubt.hopeless
    assert doubt.note(GOOD, 0.0, 0.0) == "verified"
    assert not doubt.active


@pytest.mark.parametrize(
    "cause", [cause for cause in RejectionReason if cause is not RejectionReason.VERIFIED]
)
def test_one_rejection_begins_doubt_and_one_verification_clears_it(doubt, cause):
    assert doubt.note(MatchVerdict(cause, "why"), 1.0, 0.0) == "why"
    assert doubt.active
    assert not doubt.hopeless
    assert doubt.note(GOOD, 2.0, 0.0) == "verified"
    assert not doubt.active


@pytest.mark.parametrize("cause", AGAINST)
def test_rejections_while_driving_are_a_loss(doubt, cause):
    against = MatchVerdict(cause, "why")
    for metres in (0.0, 1.9, 2.0, 3.9):
        doubt.note(against, 0.1 * metres, metres)
        assert not doubt.hopeless
    assert doubt.note(against, 0.5, 4.0) == "3 registrations rejected: why"
    assert doubt.hopeless


@pytest.mark.parametrize("cause", [RejectionReason.BLIND, RejectionReason.ODOMETRY])
def test_blind_or_odometry_rejections_are_not_counted_while_driving(doubt, cause):
    for k in range(9):
        doubt.note(MatchVerdict(cause, "why"), 1.0 * k, 5.0 * k)
    assert doubt.active
    assert not doubt.hopeless
    # and what does speak against it is counted from nothing
    for k in range(2):
        assert doubt.note(BAD, 9.0, 50.0 + 5.0 * k) == "nothing fits"
        assert not doubt.hopeless
    assert doubt.note(BAD, 9.0, 60.0) == "3 registrations rejected: nothing fits"


def test_verification_resets_the_rejection_count(doubt):
    for k in range(20):
        doubt.note(GOOD if k % 3 == 2 else BAD, 0.1 * k, 5.0 * k)
        assert not doubt.hopeless


@pytest.mark.parametrize(
    ("cause", "longest"),
    [(RejectionReason.FITNESS, 10.0), (RejectionReason.ODOMETRY, 10.0), (RejectionReason.BLIND, 60.0)],
)
def test_doubt_while_standing_times_out(doubt, cause, longest):
    judgement = MatchVerdict(cause, "why")
    doubt.note(judgement, 100.0, 7.0)
    doubt.note(judgement, 100.0 + longest - 0.1, 7.0)
    assert not doubt.hopeless
    assert doubt.note(judgement, 100.0 + longest, 7.0) == f"in doubt for {longest:.0f} s: why"
    assert doubt.hopeless


def test_required_verification_times_out_from_next_registration(doubt):
    doubt.begin()
    assert doubt.active
    doubt.note(BAD, 1000.0, 0.0)
    doubt.begin()
    assert not doubt.hopeless
    doubt.note(BAD, 1010.0, 0.0)
    assert doubt.hopeless
    doubt.clear()
    assert not doubt.active
    assert not doubt.hopeless


def test_required_verification_is_cleared_by_first_verification(doubt):
    doubt.begin()
    assert doubt.note(GOOD, 5000.0, 0.0) == "verified"
    assert not doubt.active


def blinded(doubt, seconds):
    for k in range(round(seconds) + 1):
        doubt.note(MatchVerdict(RejectionReason.BLIND, "covered"), float(k), 0.0)


def test_long_doubt_needs_several_verifications(doubt):
    blinded(doubt, 30.0)
    told = [doubt.note(GOOD, 31.0 + k, metres) for k, metres in enumerate((0.0, 0.5, 2.0, 3.9))]
    assert told[0] == "verified 1 of 3 times after 31 s of doubt"
    assert told[1].startswith("verified 1 of 3")  # the same view again proves nothing more
    assert told[2].startswith("verified 2 of 3")
    assert told[3].startswith("verified 2 of 3")
    assert doubt.active
    assert doubt.note(GOOD, 36.0, 4.0) == "verified"
    assert not doubt.active
    assert not doubt.hopeless


def test_standing_robot_leaves_long_doubt_after_some_seconds(doubt):
    blinded(doubt, 30.0)
    told = [doubt.note(GOOD, 31.0 + k, 0.0) for k in range(11)]
    assert told[0] == told[4] == "verified 1 of 3 times after 31 s of doubt"
    assert told[5] == told[9] == "verified 2 of 3 times after 31 s of doubt"
    assert told[10] == "verified"
    assert not doubt.active


def test_rejection_resets_verifications_after_long_doubt(doubt):
    blinded(doubt, 30.0)
    doubt.note(GOOD, 31.0, 0.0)
    doubt.note(GOOD, 32.0, 2.0)
    doubt.note(MatchVerdict(RejectionReason.BLIND, "covered"), 33.0, 4.0)
    assert doubt.note(GOOD, 34.0, 6.0).startswith("verified 1 of 3")
    assert doubt.active


def test_short_doubt_is_cleared_by_one_verification(doubt):
    blinded(doubt, 8.0)
    doubt.note(GOOD, 9.9, 0.0)
    assert not doubt.active
    # and the proof of an earlier doubt is not counted for a later one
    blinded(doubt, 30.0)
    assert doubt.note(GOOD, 31.0, 0.0).startswith("verified 1 of 3")
