"""The decision on a search: the probability of an error decides, and nothing else does."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fake_robot import search_request
from made_up_places import REQUEST, RULE, candidate, judged, moved, place

from coview_stream.config import AcceptanceConfig
from coview_stream.geometry.transforms import Circle, pose_from, rot_z
from coview_stream.localization.search.acceptance import BY_FEATURES, IN_CIRCLE, MAX_PLACES, Considered, decide
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.hints import FROM_THERE
from coview_stream.localization.search.places import Scored
from coview_stream.localization.state import State


@pytest.mark.parametrize("risk", [1e-2, RULE.risk, 1e-6])
@pytest.mark.parametrize(("share", "accepted"), [(0.01, True), (0.99, True), (1.0, False), (1.01, False), (50, False)])
def test_place_is_accepted_only_below_the_integrity_risk(risk, share, accepted):
    error = share * risk
    best = place(1.0 - error)
    result = judged(best, place(error, moved(20)), error=error, risk=risk)
    assert (result.accepted is not None) == accepted
    assert result.evidence.state is (State.TRACKING if accepted else State.AMBIGUOUS)
    if accepted:
        assert result.accepted.station == best.station


@pytest.mark.parametrize("score", [0.05, 0.3, 0.99])
def test_score_decides_nothing(score):
    assert judged(place(1.0, score=score), error=0.1 * RULE.risk).accepted is not None
    assert judged(place(0.5, score=score), place(0.5, moved(20), score=0.1)).accepted is None


def two(first, second, T, **more):
    return judged(place(first), place(second, T), **more)


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (two(0.5, 0.49, moved(20), error=0.5), "two places fit: equally"),
        (two(0.5, 0.49, moved(0, 180), error=0.5), "two places fit: equally"),
        (two(0.5, 0.5, moved(20), undecided=1.14), "two places fit: equally"),
        (two(0.98, 0.02, moved(20), error=0.02), "two places fit: the first is 49 times as probable"),
        (judged(*(place(0.3, moved(20 * k)) for k in range(3)), error=0.7), "3 places fit: equally"),
        (
            judged(place(0.2), *(place(0.06, moved(20 * k)) for k in range(1, 7)), error=0.8),
            "6 places fit, none is more likely than all others",
        ),
        (two(0.99, 0.001, moved(20), error=0.01), "one place leads: wrong 1 in 100, 1 in 10,000 needed"),
        (
            judged(place(1.0), error=1e-12, undecided=1.14),
            "the place is found, but poses 1.1 m apart fit there equally",
        ),
        (judged(place(1.0), error=1e-12, leader=False), "does not register"),
        (two(0.2, 0.1, moved(20), by_chance=31.4), "none of 2 fits better than chance"),
    ],
)
def test_reason_says_why_no_place_is_accepted(result, reason):
    assert result.accepted is None
    assert reason in result.evidence.reason
    assert result.evidence.state is (State.SEARCHING if "chance" in reason else State.AMBIGUOUS)


def test_no_place_means_searching():
    result = judged()
    assert (result.travelled, result.epoch) == (REQUEST.travelled, REQUEST.epoch)
    assert result.accepted is None
    said = result.evidence
    assert (said.state, said.score, said.confidence, said.by_chance) == (State.SEARCHING, 0.0, None, None)


def test_evidence_says_what_the_decision_rests_on():
    best, rival = place(0.9999, score=0.6), place(0.0001, moved(20), score=0.4)
    result = judged(best, rival, error=0.5e-4, by_chance=2.5e-7)
    assert (result.travelled, result.epoch) == (REQUEST.travelled, REQUEST.epoch)
    said = result.evidence
    assert (said.stamp, said.station, said.shift) == (7.0, 5, 2)
    assert (said.score, said.rival) == (pytest.approx(0.8), pytest.approx(0.4))  # the leader's exact one
    assert said.evidence.score == said.score
    assert said.confidence == pytest.approx(1 - 0.5e-4, abs=1e-12)
    assert said.by_chance == 2.5e-7
    assert said.reason == "found: wrong 1 in 20,000"
    assert result.rivals == 2
    json.dumps(said.to_json(), allow_nan=False)
    # without one it is the field's
    assert judged(best, rival, leader=False).evidence.score == 0.6
    assert judged(best, rival, leader=False).evidence.evidence is None


def test_most_probable_place_is_told_whether_or_not_it_is_accepted():
    for error, accepted in ((1e-6, True), (0.1, False)):
        result = judged(place(1.0 - error), place(0.0, moved(20)), error=error)
        assert (result.accepted is not None) == accepted
        assert result.leader is candidate(place(1.0)).T_map_odom
    unregistered = judged(place(0.9, moved(1.5)), leader=False)
    np.testing.assert_array_equal(unregistered.leader, moved(1.5))
    assert judged().leader is None


def test_reason_says_who_named_the_place():
    other = place(0.0, moved(20))
    hinted = judged(place(1.0, hinted=True, station=None, shift=None), other, error=1e-6).evidence
    assert hinted.reason.endswith(FROM_THERE)
    assert (hinted.station, hinted.shift) == (None, None)
    learned = judged(place(1.0, learned=True), error=1e-6).evidence
    assert learned.reason.endswith(BY_FEATURES)
    assert (learned.station, learned.shift) == (5, None)
    voted = judged(place(1.0, hinted=True), error=1e-6).evidence  # a hint takes no votes away
    assert not voted.reason.endswith((FROM_THERE, BY_FEATURES))


def test_hint_alone_is_not_accepted_before_votes_have_named_rivals():
    hint = place(1.0, hinted=True, station=None, shift=None)
    beside = place(0.0, moved(7), station=None, shift=None)
    result = judged(hint, beside, error=1e-6)
    assert result.accepted is None
    assert result.evidence.state is State.AMBIGUOUS
    assert "no vote" in result.evidence.reason
    assert judged(hint, beside, place(0.0, moved(20)), error=1e-6).accepted is not None


def test_reason_says_that_a_circle_was_searched_unless_there_is_a_pose():
    request = replace(REQUEST, area=Circle(0.0, 0.0, 80.0))
    scored = Scored(0, [], error=1.0)
    assert decide(scored, None, request, AcceptanceConfig()).evidence.reason.endswith(IN_CIRCLE)
    assert not decide(scored, None, REQUEST, AcceptanceConfig()).evidence.reason.endswith(IN_CIRCLE)
    best = place(1.0)
    found = decide(Scored(0, [best], error=1e-9, none=0.0), candidate(best), request, AcceptanceConfig())
    assert found.evidence.state is State.TRACKING
    assert IN_CIRCLE not in found.evidence.reason


def test_the_most_probable_come_first_in_the_frame_of_the_sources():
    places = [
        Hypothesis(pose_from(rot_z(0.5), [k, 2.0, 3.0]), 1, 1, score=0.5, ratio=7.0, probability=0.01 * k)
        for k in range(30)
    ]
    scored = Scored(0, places, none=0.25)
    found = Considered.of(scored, search_request(4.0), np.array([1000.0, 0.0, 50.0]))
    assert (found.stamp, found.none, len(found.places)) == (4.0, 0.25, MAX_PLACES)
    assert np.allclose(found.places[0], [1029.0, 2.0, 53.0, 0.5, 0.29, 7.0])
    assert Considered.of(Scored(0, []), search_request(), np.zeros(3)) is None
