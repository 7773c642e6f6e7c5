"""Map matching: the match against the map alone, its rivals metres away, and its weight against odometry."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_world import assert_pose, pose_error
from trackers import observed

from coview_kernels import Prior
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import boxminus, boxplus, inverse, pose_from, rot_z
from coview_stream.geometry.validation import check_covariance
from coview_stream.localization.evidence.likelihood import NUISANCES
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.registration.register import register
from coview_stream.localization.tracking import map_matching
from coview_stream.localization.tracking.map_matching import MapMatch, MapMatcher, _beside, best_of, find_rivals
from coview_stream.localization.tracking.monitor import MatchVerdict, RejectionReason
from coview_stream.localization.tracking.place_evidence import Observation, PlaceEvidence
from coview_stream.localization.tracking.pose_graph import Estimate
from coview_stream.localization.tracking.slip import matters, off_by

CONFIG = LocalizerConfig()
T_MAP_ODOM = pose_from(rot_z(-1.1), [3.0, 8.0, 0.5])
LOOSE = np.diag([0.01, 0.01, 0.03, 0.5, 0.5, 0.3]) ** 2
TIGHT = np.diag([0.003, 0.003, 0.004, 0.05, 0.05, 0.05]) ** 2


@pytest.fixture(scope="module")
def truth(world_drive):
    return world_drive.T_map_body[4]


@pytest.fixture(scope="module")
def scan(world_drive, truth):
    return observed(world_drive.clouds[4], inverse(T_MAP_ODOM) @ truth)


def matched(world_map, scan, belief: Estimate, graph: Estimate | None = None) -> MapMatch:
    """Match from a belief, which is what the graph predicts unless that is given too."""
    target = LocalMaps(world_map, 50.0).around(belief.T_map_body[:3, 3])
    scales = CONFIG.registration.track
    return MapMatcher(world_map, CONFIG).match(scan, belief, target, scales, graph or belief)


def off(match, truth):
    return float(np.linalg.norm(boxminus(match, truth)[3:]))


def test_match_does_not_depend_on_the_prior(world_map, truth, scan):
    """The belief is off by centimetres and claims to be sure; registered with it, the pose is pulled there."""
    believed = boxplus(truth, np.array([0.001, -0.001, 0.002, 0.05, -0.04, 0.03]))
    sure = np.diag([0.001, 0.001, 0.001, 0.003, 0.003, 0.003]) ** 2
    settings = CONFIG.registration
    prior = Prior(believed @ inverse(scan.T_odom_body), np.linalg.inv(sure))
    target = LocalMaps(world_map, 50.0).around(truth[:3, 3])
    arguments = (scan.cloud, prior.T_map_source, target, settings, settings.track)
    fused = register(*arguments, prior, scan.T_odom_body[:3, 3]).T_map_source @ scan.T_odom_body
    loose = matched(world_map, scan, Estimate(believed, LOOSE))
    match = matched(world_map, scan, Estimate(believed, sure))
    assert loose.verdict.cause is match.verdict.cause is RejectionReason.VERIFIED
    assert off(loose.T_map_body, truth) < 0.01
    assert off(fused, truth) > 0.003
    assert off(match.T_map_body, truth) < 0.5 * off(fused, truth)


def test_match_covariance_does_not_depend_on_prior_covariance(world_map, truth, scan):
    loose, tight = (matched(world_map, scan, Estimate(truth, C)).covariance for C in (LOOSE, TIGHT))
    check_covariance(loose, "loose")
    np.testing.assert_allclose(np.sqrt(np.diag(tight)), np.sqrt(np.diag(loose)), rtol=0.2)


def test_innovation_is_measured_against_graph_prediction(world_map, truth, scan):
    """Which need not be what the match began with."""
    away = boxplus(truth, np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    matcher, target = MapMatcher(world_map, CONFIG), LocalMaps(world_map, 50.0).around(truth[:3, 3])
    near, far = (
        matcher.match(scan, Estimate(truth, LOOSE), target, CONFIG.registration.track, Estimate(T, TIGHT))
        for T in (truth, away)
    )
    assert near.innovation < 1.0
    gap = boxminus(far.T_map_body, away)
    expected = gap @ np.linalg.solve(TIGHT + far.covariance + matcher.shared.covariance, gap)
    assert far.innovation == pytest.approx(expected, rel=1e-6)
    assert far.innovation > CONFIG.acceptance.max_innovation
    assert far.verdict.innovation == far.innovation
    # the place fits: what to think of odometry is another question
    assert far.verdict.cause is RejectionReason.VERIFIED


def test_without_matching_structure_the_prior_pose_is_kept(world_map, truth, scan):
    """Ten metres above everything."""
    belief = Estimate(boxplus(truth, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 40.0])), TIGHT)
    match = matched(world_map, scan, belief)
    assert not match.verdict.verified
    assert match.verdict.cause in (RejectionReason.GROUND, RejectionReason.FITNESS)
    assert match.verdict.innovation is None
    assert match.innovation == 0.0
    np.testing.assert_array_equal(match.T_map_body, belief.T_map_body)


@pytest.mark.parametrize("bad", [np.zeros((6, 6)), np.full((6, 6), np.nan)], ids=["singular", "nan"])
@pytest.mark.parametrize("part", ["prior", "registration"])
def test_singular_prior_or_registration_is_rejected(world_map, truth, scan, bad, part, monkeypatch):
    if part == "prior":
        match = matched(world_map, scan, Estimate(truth, bad), Estimate(truth, TIGHT))
    else:
        monkeypatch.setattr(map_matching, "register", lambda *given: register(*given)._replace(information=bad))
        match = matched(world_map, scan, Estimate(truth, TIGHT))
    assert (match.verdict.evidence is None) == (part == "prior")  # a registration's is as good as ever
    assert match.verdict.cause is RejectionReason.FITNESS
    assert match.verdict.reason.startswith("registration failed: ")
    assert match.verdict.innovation is None
    np.testing.assert_array_equal(match.T_map_body, truth)


def held(world_map, scan, belief):
    """The matches from a belief that may be metres off, the first with it as it is."""
    matcher = MapMatcher(world_map, CONFIG)
    target = LocalMaps(world_map, 50.0).around(belief.T_map_body[:3, 3])
    first = matcher.match(scan, belief, target, CONFIG.registration.track, belief)
    wider = Estimate(belief.T_map_body, belief.covariance + np.diag([0.01, 0.01, 0.1, 1.0, 1.0, 0.3]) ** 2)
    return matcher.match_widely(first, scan, wider, target, belief)


def test_place_that_odometry_leads_beside_is_held_against_the_right_one(world_map, truth, scan):
    for x, y in ((1.6, 0.0), (-1.0, 2.2)):
        tries = held(world_map, scan, Estimate(boxplus(truth, np.array([0.0, 0.0, 0.0, x, y, 0.0])), TIGHT))
        best = max(tries, key=lambda each: each.verdict.ratio)
        assert off(best.T_map_body, truth) < 0.02
        assert best.verdict.verified
        assert best is not tries[0]
        assert not tries[0].verdict.verified
        assert tries[0].verdict.reason == "the scan fits as well some metres beside"
        assert tries[0].verdict.observation.rival == pytest.approx(best.verdict.observation.ratio, abs=3.0)


def test_right_place_stays_when_it_is_tried_again(world_map, truth, scan):
    tries = held(world_map, scan, Estimate(truth, TIGHT))
    assert tries[0].verdict.verified
    assert all(off(each.T_map_body, truth) < 0.05 for each in tries if each.verdict.verified)


def rivals(world_map, truth, scan, off, count=1):
    """Rivals of a pose that is off the truth by a motion of the body, and what is known of the place."""
    place, target = PlaceEvidence(world_map), LocalMaps(world_map, 50.0).around(truth[:3, 3])
    T = truth @ off @ inverse(scan.T_odom_body)
    return find_rivals(place, scan, T, target, CONFIG.registration, count), T, place


@pytest.mark.parametrize(
    ("off", "count"),
    [
        ([3.2, 0.0, 0.0], 1),
        ([0.0, -3.3, 0.0], 1),
        ([-2.3, -2.3, 0.0], 1),
        ([2.4, -2.1, 0.0], 1),
        ([0.5, 3.1, 4.0], 3),
        ([-3.1, 0.0, -4.0], 3),
        ([2.2, 2.2, -4.0], 3),
    ],
)
def test_right_place_is_the_best_rival_of_one_beside_it(world_map, truth, scan, off, count):
    """From where the finest scale of a registration does not come there alone."""
    x, y, degrees = off
    match, T, place = rivals(world_map, truth, scan, pose_from(rot_z(np.radians(degrees)), [x, y, 0.0]), count)
    target, settings = LocalMaps(world_map, 50.0).around(truth[:3, 3]), CONFIG.registration
    alone = register(scan.cloud, T, target, settings, settings.track[-1:])
    assert alone is None or pose_error(alone.T_map_source @ scan.T_odom_body, truth)[0] > 0.5
    assert_pose(match[0].T_map_odom @ scan.T_odom_body, truth, 0.05, 0.3)
    assert match[0].ratio > place.observe(scan, T).ratio + 5.0


@pytest.mark.parametrize("count", [1, 3])
def test_right_place_has_no_rival_that_comes_near_it(world_map, truth, scan, count):
    match, T, place = rivals(world_map, truth, scan, np.eye(4), count)
    assert len(match) <= count
    for rival in match:
        assert rival.ratio < place.observe(scan, T).ratio - 3.0


def test_rivals_are_apart_and_the_most_probable_first(world_map, truth, scan):
    match, T, _ = rivals(world_map, truth, scan, pose_from(np.eye(3), [1.5, 1.5, 0.0]), 3)
    ratios = [rival.ratio for rival in match]
    assert ratios == sorted(ratios, reverse=True)
    poses = [each @ scan.T_odom_body for each in (T, *(rival.T_map_odom for rival in match))]
    for k, one in enumerate(poses):
        assert all(matters(*off_by(one, other)) for other in poses[:k])


@pytest.mark.parametrize(
    ("moved", "beside"), [((0.0, 0.0, 2.0), False), ((0.8, 0.0, 0.0), True), ((0.1, 0.1, -0.7), False)]
)
def test_pose_above_or_below_is_no_rival(moved, beside):
    """Wheels slip along the ground."""
    scan = SimpleNamespace(T_odom_body=np.eye(4))
    assert _beside(scan, pose_from(np.eye(3), moved), np.eye(4)) == beside


def made_up(world_map, scan, truth, ratio, innovation, cause=RejectionReason.VERIFIED, elsewhere=0.0):
    """Match of some evidence, against that of another pose."""
    likelihoods = np.zeros(NUISANCES)
    verdict = MatchVerdict(cause, "", None, innovation, Observation(ratio, likelihoods, elsewhere))
    return MapMatch(verdict, truth, TIGHT, innovation, scan)


def test_slip_has_to_fit_better_by_the_odds_against_it(world_map, scan, truth):
    limit = CONFIG.acceptance.max_innovation
    beside = RejectionReason.FITNESS
    here = made_up(world_map, scan, truth, 4.0, 3.0, beside)
    assert best_of([here, slip := made_up(world_map, scan, truth, 20.0, 900.0)], limit) is slip
    # too rare to be believed, but a contradiction that fits: the scans will decide
    assert best_of([here, slip := made_up(world_map, scan, truth, 6.0, 900.0)], limit) is slip
    assert best_of([here, made_up(world_map, scan, truth, 6.0, 900.0, beside)], limit) is here
    # within odometry's uncertainty nothing contradicts it
    assert best_of([here, made_up(world_map, scan, truth, 6.0, 20.0)], limit) is here
    assert best_of([here, better := made_up(world_map, scan, truth, 6.0, 5.0)], limit) is better
    fits = made_up(world_map, scan, truth, 4.0, 3.0)
    assert best_of([fits, made_up(world_map, scan, truth, 6.0, 900.0)], limit) is fits
    # a pose that leans, or could not be registered, is none
    leaning = made_up(world_map, scan, truth, 30.0, 3.0, RejectionReason.TILT)
    assert best_of([leaning, replace(leaning, scan=None), fits], limit) is fits
