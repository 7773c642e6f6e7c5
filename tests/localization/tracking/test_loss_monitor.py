"""The loss monitor: one rejection costs the pose, driving on or time the place; a long doubt takes several to end."""

from __future__ import annotations

import pytest

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.localization.state import Event
from coview_stream.localization.tracking.monitor import LossMonitor, MatchVerdict, RejectionReason

RULE = AcceptanceConfig(max_rejections=3, max_doubt_s=10.0, max_blind_s=60.0, confirmations=3)
GOOD = MatchVerdict(RejectionReason.VERIFIED, "verified")
BAD = MatchVerdict(RejectionReason.FITNESS, "nothing fits")
VERIFIED = (Event.MATCH_VERIFIED, "verified")
AGAINST = [
    RejectionReason.FITNESS,
    RejectionReason.GROUND,
    RejectionReason.FREE_SPACE,
    RejectionReason.TILT,
    RejectionReason.OFF_MAP,
]


@pytest.fixture
def monitor():
    return LossMonitor(RULE, TrackingConfig(distance=2.0, seconds=5.0))


def test_loss_monitor_starts_clear(monitor):
    assert monitor.verify(GOOD, 0.0, 0.0) == VERIFIED


@pytest.mark.parametrize("cause", [cause for cause in RejectionReason if cause is not RejectionReason.VERIFIED])
def test_one_rejection_begins_doubt_and_one_verification_clears_it(monitor, cause):
    assert monitor.verify(MatchVerdict(cause, "why"), 1.0, 0.0) == (Event.MATCH_REJECTED, "why")
    assert monitor.verify(GOOD, 2.0, 0.0) == VERIFIED


@pytest.mark.parametrize("cause", AGAINST)
def test_rejections_while_driving_are_a_loss(monitor, cause):
    against = MatchVerdict(cause, "why")
    for metres in (0.0, 1.9, 2.0, 3.9):
        assert monitor.verify(against, 0.1 * metres, metres)[0] is Event.MATCH_REJECTED
    assert monitor.verify(against, 0.5, 4.0) == (Event.PLACE_GIVEN_UP, "3 registrations rejected: why")


@pytest.mark.parametrize("cause", [RejectionReason.BLIND, RejectionReason.ODOMETRY])
def test_blind_or_odometry_rejections_are_not_counted_while_driving(monitor, cause):
    for k in range(9):
        assert monitor.verify(MatchVerdict(cause, "why"), 1.0 * k, 5.0 * k) == (Event.MATCH_REJECTED, "why")
    # and what does speak against it is counted from nothing
    for k in range(2):
        assert monitor.verify(BAD, 9.0, 50.0 + 5.0 * k) == (Event.MATCH_REJECTED, "nothing fits")
    given_up = (Event.PLACE_GIVEN_UP, "3 registrations rejected: nothing fits")
    assert monitor.verify(BAD, 9.0, 60.0) == given_up


def test_verification_resets_the_rejection_count(monitor):
    for k in range(20):
        event, _ = monitor.verify(GOOD if k % 3 == 2 else BAD, 0.1 * k, 5.0 * k)
        assert event is (Event.MATCH_VERIFIED if k % 3 == 2 else Event.MATCH_REJECTED)


@pytest.mark.parametrize(
    ("cause", "longest"),
    [(RejectionReason.FITNESS, 10.0), (RejectionReason.ODOMETRY, 10.0), (RejectionReason.BLIND, 60.0)],
)
def test_doubt_while_standing_times_out(monitor, cause, longest):
    verdict = MatchVerdict(cause, "why")
    for seconds in (0.0, longest - 0.1):
        assert monitor.verify(verdict, 100.0 + seconds, 7.0)[0] is Event.MATCH_REJECTED
    given_up = (Event.PLACE_GIVEN_UP, f"in doubt for {longest:.0f} s: why")
    assert monitor.verify(verdict, 100.0 + longest, 7.0) == given_up


def test_doubt_times_out_from_its_first_registration(monitor):
    """Time before that does not count: a verification may have been required long before."""
    assert monitor.verify(BAD, 1000.0, 0.0)[0] is Event.MATCH_REJECTED
    assert monitor.verify(BAD, 1010.0, 0.0)[0] is Event.PLACE_GIVEN_UP
    monitor.clear()
    assert monitor.verify(BAD, 1010.0, 0.0)[0] is Event.MATCH_REJECTED


def blinded(monitor, seconds):
    for k in range(round(seconds) + 1):
        event, _ = monitor.verify(MatchVerdict(RejectionReason.BLIND, "covered"), float(k), 0.0)
        assert event is Event.MATCH_REJECTED


def verified(count, seconds=31):
    """One of several verifications that a long doubt takes."""
    return None, f"verified {count} of 3 times after {seconds} s of doubt"


def test_long_doubt_needs_several_verifications(monitor):
    blinded(monitor, 30.0)
    told = [monitor.verify(GOOD, 31.0 + k, metres) for k, metres in enumerate((0.0, 0.5, 2.0, 3.9))]
    # the same view again proves nothing more
    assert told == [verified(1), verified(1), verified(2), verified(2)]
    assert monitor.verify(GOOD, 36.0, 4.0) == VERIFIED
    assert monitor.verify(BAD, 36.1, 9.0)[0] is Event.MATCH_REJECTED  # and all is forgotten
    assert monitor.verify(GOOD, 36.2, 9.0) == VERIFIED


def test_standing_robot_leaves_long_doubt_after_some_seconds(monitor):
    blinded(monitor, 30.0)
    told = [monitor.verify(GOOD, 31.0 + k, 0.0) for k in range(11)]
    assert told == [verified(1)] * 5 + [verified(2)] * 5 + [VERIFIED]


def test_rejection_resets_verifications_after_long_doubt(monitor):
    blinded(monitor, 30.0)
    monitor.verify(GOOD, 31.0, 0.0)
    assert monitor.verify(GOOD, 32.0, 2.0) == verified(2)
    monitor.verify(MatchVerdict(RejectionReason.BLIND, "covered"), 33.0, 4.0)
    assert monitor.verify(GOOD, 34.0, 6.0) == verified(1, 34)


def test_short_doubt_is_cleared_by_one_verification(monitor):
    blinded(monitor, 8.0)
    assert monitor.verify(GOOD, 9.9, 0.0) == VERIFIED
    # and the verification of an earlier doubt is not counted for a later one
    blinded(monitor, 30.0)
    assert monitor.verify(GOOD, 31.0, 0.0) == verified(1)
