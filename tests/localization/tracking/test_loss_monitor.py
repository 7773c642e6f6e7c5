"""The loss monitor: odds that the place is wrong, which add up against it a view at a time, and never for it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.localization.evidence.likelihood import NUISANCES
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.state import Event
from coview_stream.localization.tracking import monitor as rates
from coview_stream.localization.tracking.monitor import (
    EvidenceBaseline,
    LossMonitor,
    MatchVerdict,
    RejectionReason,
    Ruling,
)
from coview_stream.localization.tracking.place_evidence import Observation

RULE = AcceptanceConfig(risk=1e-4, max_doubt_s=10.0, max_blind_s=60.0)
PRIOR = 1e-5  # of a view, 1 m driven


def verdict_of(ratio, cause=None, reason="why"):
    """A verdict on a registration with a log-likelihood ratio for the place."""
    usual = RejectionReason.VERIFIED if ratio > 0 else RejectionReason.FITNESS
    return MatchVerdict(cause or usual, reason, None, None, Observation(ratio, np.zeros(NUISANCES)))


def nothing(cause=RejectionReason.BLIND):
    """A verdict without an observation."""
    return MatchVerdict(cause, "covered")


@pytest.fixture
def monitor():
    return LossMonitor(RULE, TrackingConfig(distance=1.0, seconds=5.0))


def drive(monitor, ratios, start=0.0, speed=1.0):
    """Registrations 1 m apart."""
    return [monitor.verify(verdict_of(ratio), (start + k) / speed, start + k) for k, ratio in enumerate(ratios)]


def log_odds(ruling: Ruling) -> float:
    return math.log(ruling.wrong / (1.0 - ruling.wrong))


def test_what_speaks_against_the_place_adds_up_a_view_at_a_time(monitor):
    outcome = [log_odds(ruling) for ruling in drive(monitor, [5.0, -1.0, -2.0, -4.0], speed=1e3)]
    np.testing.assert_allclose(np.diff(outcome[1:]), [2.0, 4.0], atol=0.35)  # and what is driven
    assert outcome[-1] == pytest.approx(math.log(PRIOR) + 7.0, abs=0.5)


def test_newest_registration_of_a_view_counts(monitor):
    monitor.verify(verdict_of(5.0), 0.0, 0.0)
    first = monitor.verify(verdict_of(-6.0), 1.0, 1.0).wrong
    assert [monitor.verify(verdict_of(-6.0), 1.0, 1.0).wrong for _ in range(20)] == pytest.approx([first] * 20)
    assert monitor.verify(verdict_of(-1.0), 1.0, 1.4).wrong < 0.1 * first
    assert monitor.verify(verdict_of(-6.0), 1.0, 1.99).wrong == pytest.approx(2 * first, rel=0.1)  # and a metre driven
    assert monitor.verify(verdict_of(-6.0), 1.0, 2.0).wrong > 50 * first


def test_path_of_odometry_is_doubted_by_metres_and_seconds_since_the_last_verified_pose(monitor):
    drive(monitor, [8.0, -30.0, -30.0])  # what speaks against the place is left to the search
    assert monitor.odds(0.0, 0.0) == pytest.approx(1e-5, rel=0.1)
    assert monitor.odds(100.0, 500.0) == pytest.approx(1e-5 + 100.0 * 1e-4 + 500.0 * 1e-5, rel=1e-3)
    assert LossMonitor(RULE, TrackingConfig()).odds(9.0, 9.0) == 0.0  # nothing was verified yet


@pytest.mark.parametrize("metres", [0.2, 1.5, 20.0])
def test_one_frame_of_garbage_costs_its_pose_and_two_views_of_it_the_place(monitor, metres):
    """However often the place has fitted: a robot that is carried while it stands is noticed as soon as any other."""
    for k in range(50):
        assert monitor.verify(verdict_of(15.0), float(k), 4.0).believed
    assert monitor.verify(verdict_of(-100.0), 50.0, 4.0).event is Event.MATCH_REJECTED
    assert monitor.verify(verdict_of(15.0), 50.1, 4.0 + metres).believed
    reports = drive(monitor, [-100.0, -100.0], 60.0)
    assert [ruling.event for ruling in reports] == [Event.MATCH_REJECTED, Event.PLACE_GIVEN_UP]


def test_one_view_has_to_make_up_for_all_that_was_said_before(monitor):
    """Two that speak for it as much as one needs do not, each by itself."""
    drive(monitor, [5.0, -4.0, -4.0])
    weak = drive(monitor, [3.0, 3.0, 3.0], 3.0)
    assert [(ruling.event, ruling.believed) for ruling in weak] == [(Event.MATCH_REJECTED, False)] * 3
    assert weak[-1].wrong > weak[0].wrong > RULE.risk
    assert weak[0].reason.startswith("it fits again: wrong 1 in ")
    assert monitor.verify(verdict_of(9.0), 6.0, 6.0) == pytest.approx(
        (Event.MATCH_VERIFIED, "why", 1e-5, True), abs=3e-5
    )
    # and is forgiven
    assert drive(monitor, [1.0], 7.0)[0].believed


def test_place_is_given_up_once_it_is_more_probable_than_not_that_it_is_wrong(monitor):
    outcome = drive(monitor, [5.0, *[-2.5] * 6], speed=1e3)
    given_up = [ruling.event is Event.PLACE_GIVEN_UP for ruling in outcome]
    assert given_up == [ruling.wrong >= 0.5 for ruling in outcome]
    assert any(0.1 < ruling.wrong < 0.5 for ruling in outcome)
    assert outcome[given_up.index(True)].reason == "more probably elsewhere: why"


def test_verification_that_is_required_begins_a_doubt_with_a_timeout(monitor):
    drive(monitor, [15.0])
    for _ in range(10_000):  # asked again, it changes nothing
        monitor.require_verification()
    reports = [monitor.verify(verdict_of(-0.1), 1.0 + seconds, 1.0).event for seconds in (0.0, 0.9 * RULE.max_doubt_s)]
    assert reports == [Event.MATCH_REJECTED] * 2
    assert monitor.verify(verdict_of(-0.1), 1.0 + RULE.max_doubt_s, 1.0).event is Event.PLACE_GIVEN_UP
    monitor.begin(0.0)
    drive(monitor, [15.0])
    monitor.require_verification()
    assert monitor.verify(verdict_of(9.0), 60.0, 1.0).believed


@pytest.mark.parametrize("ratio", [-1e4, 1e4])
def test_any_ratio_gives_a_probability(monitor, ratio):
    outcome = monitor.verify(verdict_of(ratio), 0.0, 0.0)
    assert 0.0 <= outcome.wrong <= 1.0
    assert outcome.event is (Event.MATCH_VERIFIED if ratio > 0 else Event.MATCH_REJECTED)


def test_little_that_speaks_against_the_place_costs_no_pose_and_corrects_nothing(monitor):
    drive(monitor, [5.0])
    outcome = monitor.verify(verdict_of(-0.5), 1.0, 1.0)
    assert (outcome.event, outcome.believed) == (None, False)
    assert outcome.reason == "odometry alone: why"
    assert PRIOR < outcome.wrong < RULE.risk


def test_robot_on_odometry_alone_is_doubted_by_the_metre(monitor):
    drive(monitor, [5.0])
    outcome = [monitor.verify(nothing(RejectionReason.OFF_MAP), 1.0, float(metres)) for metres in range(1, 21)]
    posed = [ruling.event is None for ruling in outcome]
    assert posed == sorted(posed, reverse=True)
    assert posed.count(True) == pytest.approx(RULE.risk / PRIOR, abs=2)
    np.testing.assert_allclose(np.diff([ruling.wrong for ruling in outcome]), PRIOR, rtol=0.01)


def test_robot_that_trusts_odometry_is_not_doubted_by_the_second(monitor):
    drive(monitor, [5.0])
    wrong = [monitor.verify(verdict_of(-0.5), 1.0 + k, 1.0).wrong for k in range(100)]
    assert wrong == pytest.approx([wrong[0]] * 100)


@pytest.mark.parametrize("cause", [RejectionReason.BLIND, RejectionReason.ODOMETRY, RejectionReason.TILT])
@pytest.mark.parametrize("ratio", [20.0, None], ids=["fits", "nothing seen"])
def test_some_causes_cost_the_pose_at_once_and_lose_no_place_while_driving(monitor, cause, ratio):
    drive(monitor, [15.0] * 3)
    verdict = nothing(cause) if ratio is None else verdict_of(ratio, cause, "covered")
    for k in range(9):
        assert monitor.verify(verdict, 3.0 + k, 3.0 + 5.0 * k)[:2] == (Event.MATCH_REJECTED, "covered")
    assert monitor.verify(verdict_of(15.0), 12.0, 44.0).event is Event.MATCH_VERIFIED


@pytest.mark.parametrize("seconds", [10.0, 30.0])
def test_return_after_long_blindness_needs_more_evidence(monitor, seconds):
    """Meanwhile it may have been carried: one frame could fit by chance."""
    drive(monitor, [15.0])
    for k in range(int(seconds) + 1):
        monitor.verify(nothing(), 1.0 + k, 0.0)
    enough = math.log((PRIOR + rates._PER_SECOND * seconds) / RULE.risk)
    reports = monitor.verify(verdict_of(enough - 0.5), 1.0 + seconds, 0.0)
    assert (reports.event, reports.believed) == (Event.MATCH_REJECTED, False)
    assert "it fits again" in reports.reason
    assert monitor.verify(verdict_of(enough + 0.5), 1.0 + seconds, 0.0).event is Event.MATCH_VERIFIED


@pytest.mark.parametrize(
    ("verdict", "longest"),
    [(verdict_of(-3.0), 10.0), (verdict_of(20.0, RejectionReason.ODOMETRY), 10.0), (nothing(), 60.0)],
    ids=["against", "odometry", "blind"],
)
def test_doubt_while_standing_times_out(monitor, verdict, longest):
    drive(monitor, [5.0])
    for seconds in (0.0, longest - 0.1):
        assert monitor.verify(verdict, 100.0 + seconds, 1.0).event is Event.MATCH_REJECTED
    lost = monitor.verify(verdict, 100.0 + longest, 1.0)
    assert lost.event is Event.PLACE_GIVEN_UP
    assert lost.reason == f"in doubt for {longest:.0f} s: {verdict.reason}"


def test_time_that_the_sensor_was_blind_is_no_time_of_doubt(monitor):
    """What it sees then has the whole time to be doubted in."""
    for k in range(31):
        monitor.verify(nothing(), float(k), 0.0)
    assert monitor.verify(verdict_of(-1.0), 30.0 + RULE.max_doubt_s - 0.1, 0.0).event is Event.MATCH_REJECTED
    lost = monitor.verify(verdict_of(-1.0), 30.0 + RULE.max_doubt_s, 0.0)
    assert (lost.event, lost.reason) == (Event.PLACE_GIVEN_UP, "in doubt for 40 s: why")


def test_doubt_ends_with_the_first_registration_that_is_believed(monitor):
    """The next one begins a doubt of its own."""
    monitor.verify(nothing(), 0.0, 0.0)
    assert monitor.verify(verdict_of(15.0), 9.0, 0.0).believed
    assert monitor.verify(nothing(), 11.0, 0.0).event is Event.MATCH_REJECTED
    assert monitor.verify(nothing(), 11.0 + RULE.max_blind_s - 0.1, 0.0).event is Event.MATCH_REJECTED


@pytest.mark.parametrize("error", [0.0, 0.9e-4])
def test_place_begins_with_the_error_of_the_search(monitor, error):
    """What was said of the place before does not count, and what the search said does."""
    drive(monitor, [5.0, -5.0, -5.0])
    monitor.begin(error)
    wrong = monitor.verify(verdict_of(-2.0), 3.0, 3.0).wrong
    assert wrong == pytest.approx(max(error, PRIOR) * math.exp(2.0), rel=0.01)
    monitor.begin(error)
    assert monitor.verify(verdict_of(2.0), 3.0, 3.0).believed


def test_risk_decides_what_is_believed():
    for risk in (1e-2, 1e-6):
        monitor = LossMonitor(AcceptanceConfig(risk=risk), TrackingConfig(distance=1.0))
        drive(monitor, [15.0])
        outcome = monitor.verify(verdict_of(1.0), 1.0, 1.0)  # 1e-5 / e
        assert outcome.believed == (risk == 1e-2)
        assert outcome.event is (Event.MATCH_VERIFIED if outcome.believed else Event.MATCH_REJECTED)


GOOD = Evidence(near=0.8, covered=0.9, ground=0.95, free_space=0.9, inside=1.0)


@pytest.fixture
def used():
    """Used to places that fit well."""
    baseline = EvidenceBaseline()
    for _ in range(10):
        baseline.learn(GOOD)
    return baseline


@pytest.mark.parametrize(
    ("changes", "cause", "clause"),
    [
        ({"inside": 0.25}, RejectionReason.OFF_MAP, "only 25% of the scan lies on the map"),
        ({"ground": 0.4}, RejectionReason.GROUND, "only 40% of the ground lies on the map's"),
        ({"near": 0.1, "covered": 0.2}, RejectionReason.FITNESS, "10% of the points above the ground are on the map"),
        ({"free_space": 0.05}, RejectionReason.FREE_SPACE, "rays pass through 95% of the map's points"),
    ],
)
@pytest.mark.parametrize("baseline", ["fresh", "used"])
def test_share_that_is_poor_names_its_cause(changes, cause, clause, baseline, used):
    outcome, reason = (used if baseline == "used" else EvidenceBaseline()).explain(replace(GOOD, **changes))
    assert outcome is cause
    assert clause in reason
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


def test_baseline_follows_slowly(used):
    worse = Evidence(near=0.4, covered=0.6, ground=0.8, free_space=0.7, inside=0.8)
    used.learn(worse)
    assert 0.7 < used.usual.near < 0.8
    assert 0.9 < used.usual.inside < 1.0
    for _ in range(30):
        used.learn(worse)
    for name, share in vars(worse).items():
        assert getattr(used.usual, name) == pytest.approx(share, abs=0.01)


def test_evidence_has_fallen_by_as_much_as_the_usual_is_better(used):
    half = replace(GOOD, near=0.25 * GOOD.near)  # the score is a root
    assert used.fallen(half) == pytest.approx(2.0)
    assert used.fallen(GOOD) == 1.0
    assert used.fallen(replace(GOOD, ground=1.0)) == 1.0  # better than usual
    assert EvidenceBaseline().fallen(half) == 1.0
    assert math.isfinite(used.fallen(replace(GOOD, near=0.0)))
