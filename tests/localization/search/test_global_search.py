"""Global search: its acceptance test case by case, and its rules on the small world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_world
from se3 import exp_se3

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.files import write_cloud
from coview_stream.config import (
    AcceptanceConfig,
    ConsensusConfig,
    DescriptorConfig,
    LocalizerConfig,
    RegistrationConfig,
)
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, tilt_of
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import voxelized
from coview_stream.localization.registration.result import Registration
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.localization.search.refinement import Candidate, gravity_information
from coview_stream.localization.search.request import RequestSpec, SearchRequest
from coview_stream.localization.search.scoring import Rivals, Scored, ScoredPlace
from coview_stream.localization.state import State

RULE = AcceptanceConfig()
NOTHING = np.empty((0, 3), np.float32)
REQUEST = SearchRequest(7.0, pose_from(rot_z(0.3), [40.0, -25.0, 1.2]), NOTHING, NOTHING, NOTHING, 5.5, (2, 3))
HERE = pose_from(rot_z(-0.8), [3.0, 9.0, 0.5])  # map <- odometry of all candidates that are right
T_MAP_ODOM = pose_from(rot_z(1.9), [7.0, -3.0, 0.4])  # of the runs through the small world
TILT = np.radians(4.0)
SHARES = ("near", "covered", "ground", "free_space")


def moved(forward=0.0, degrees=0.0):
    """``HERE`` with the robot (not the odometry's origin) moved and turned."""
    body = HERE @ REQUEST.T_odom_body @ pose_from(rot_z(np.radians(degrees)), [forward, 0.0, 0.0])
    return body @ inverse(REQUEST.T_odom_body)


def candidate(score, T_map_odom=HERE, inside=0.9, ground=1.0):
    """A made-up candidate: all that is judged is its pose and its evidence."""
    found = Registration(T_map_odom, 1e4 * np.eye(6), 0.05, 2000, 20, True)
    place = ScoredPlace(Hypothesis(T_map_odom, 5, 2, -3.0), score, inside)
    return Candidate(place, found, Evidence(score / ground, score, ground, 1.0, inside))


@pytest.fixture
def search(world_map):
    return GlobalSearch(world_map, LocalizerConfig(), LocalMaps(world_map, 50.0))


@pytest.fixture
def stationary(world_map):
    return GlobalSearch(world_map, LocalizerConfig(stationary=True), LocalMaps(world_map, 50.0))


def judged(search, *keyframes):
    """Results of one list of candidates (best first) per keyframe."""
    votes = len(search.coview.consensus)
    return [search._acceptance.decide(candidates, REQUEST, votes) for candidates in keyframes]


# ---- what counts against a pose


@pytest.mark.parametrize("share", SHARES)
def test_every_evidence_share_lowers_the_score(share):
    perfect = Evidence(1.0, 1.0, 1.0, 1.0, 1.0)
    assert perfect.score == 1.0
    assert replace(perfect, **{share: 0.25}).score == pytest.approx(0.5)
    assert replace(perfect, **{share: 0.0}).score == 0.0


def test_inside_share_does_not_raise_the_score():
    assert Evidence(0.5, 0.5, 1.0, 1.0, 0.1).score == Evidence(0.5, 0.5, 1.0, 1.0, 1.0).score


# ---- acceptance


def test_unrivalled_place_is_accepted_after_enough_confirmations(search):
    best = candidate(0.7)
    results = judged(search, *[[best, candidate(0.2, moved(20))]] * RULE.confirmations)
    states = [result.evidence.state for result in results]
    assert states == [State.AMBIGUOUS] * (RULE.confirmations - 1) + [State.TRACKING]
    assert [result.accepted for result in results[:-1]] == [None] * (RULE.confirmations - 1)
    assert results[-1].accepted is best
    assert {(result.travelled, result.epoch) for result in results} == {(REQUEST.travelled, REQUEST.epoch)}
    said = results[-1].evidence
    assert (said.stamp, said.station, said.shift) == (7.0, 5, 2)
    assert (said.score, said.rival) == (pytest.approx(0.7), pytest.approx(0.2))


REFUSED = {
    "low score": ([candidate(RULE.score - 0.02)], State.SEARCHING),
    "off the survey": ([candidate(0.95, inside=RULE.min_overlap - 0.05)], State.SEARCHING),
    "no ground": ([candidate(0.5, ground=RULE.ground - 0.05)], State.AMBIGUOUS),
    "equal rival": ([candidate(0.7), candidate(0.7, moved(20))], State.AMBIGUOUS),
    "close rival": ([candidate(0.7), candidate(0.7 - RULE.lead / 2, moved(20))], State.AMBIGUOUS),
    "the rival comes third": ([candidate(0.7), candidate(0.69), candidate(0.68, moved(20))], State.AMBIGUOUS),
    "rival heading": ([candidate(0.7), candidate(0.68, moved(0, 180))], State.AMBIGUOUS),
}


@pytest.mark.parametrize("case", REFUSED)
def test_weak_or_rivalled_candidate_is_never_accepted(search, case):
    candidates, state = REFUSED[case]
    for result in judged(search, *[candidates] * 3 * RULE.confirmations):
        assert result.accepted is None
        assert result.evidence.state is state


ACCEPTED = {
    "just good enough": [candidate(RULE.score + 0.02)],
    "just enough ground": [candidate(0.65, ground=RULE.ground + 0.05)],
    "just inside": [candidate(0.95, inside=RULE.min_overlap + 0.05)],
    "rival far enough below": [candidate(0.7), candidate(0.7 - 1.5 * RULE.lead, moved(20))],
    "the same place twice is no rival": [candidate(0.7), candidate(0.69, moved(0.5, 1.0))],
}


@pytest.mark.parametrize("case", ACCEPTED)
def test_good_candidate_is_accepted_after_enough_evidence(search, case):
    best = ACCEPTED[case][0]
    needed = int(np.ceil(RULE.evidence_sum / (best.evidence.score - RULE.evidence_floor)))
    accepted = [result.accepted for result in judged(search, *[ACCEPTED[case]] * (max(needed, RULE.confirmations) + 1))]
    assert accepted[-1] is best
    # no sooner either: weak evidence needs more driving
    assert accepted[: max(needed, RULE.confirmations) - 1] == [None] * (max(needed, RULE.confirmations) - 1)


@pytest.mark.parametrize(
    "other",
    [moved(2 * RULE.agree_distance), moved(0, 2 * np.degrees(RULE.agree_angle)), moved(-30, 90)],
    ids=["elsewhere", "turned", "far"],
)
def test_disagreeing_keyframes_give_no_confirmation(search, other):
    for result in judged(search, *[[candidate(0.7, T)] for T in [HERE, other] * RULE.confirmations]):
        assert result.accepted is None
        assert result.evidence.state is State.AMBIGUOUS
        assert "confirmed by 1 keyframe," in result.evidence.reason


def test_agreement_is_measured_at_the_robot_not_at_the_odometry_origin(search):
    """Turned about the robot, which is 47 m from the odometry's origin: the origin moves more than is allowed."""
    turned = moved(0.3 * RULE.agree_distance, 0.9 * np.degrees(RULE.agree_angle))
    assert np.linalg.norm((turned - HERE)[:3, 3]) > RULE.agree_distance
    poses = [HERE, turned] * RULE.confirmations
    assert judged(search, *[[candidate(0.7, T)] for T in poses[: RULE.confirmations]])[-1].accepted is not None


WEAK = {
    "low": [candidate(0.1)],
    "two": [candidate(0.7), candidate(0.7, moved(20))],
    "off the survey": [candidate(0.9, inside=0.01)],
    "no ground": [candidate(0.4, ground=0.4)],
}


@pytest.mark.parametrize("case", WEAK)
def test_weak_keyframe_gives_no_confirmation(search, case):
    good = [candidate(0.7)]
    results = judged(search, *[good] * (RULE.confirmations - 1), *[WEAK[case]] * RULE.confirmations)
    assert [result.accepted for result in results] == [None] * len(results)


@pytest.mark.parametrize("between", [[], [candidate(0.7, moved(20))]], ids=["nothing", "elsewhere"])
def test_contradicting_keyframe_resets_confirmations(search, between):
    good = [candidate(0.7)]
    count = RULE.confirmations - 1
    results = judged(search, *[good] * count, between, *[good] * count, good)
    assert [result.accepted for result in results[:-1]] == [None] * (2 * count + 1)
    assert results[-1].accepted is good[0]


def test_clear_resets_confirmations(search):
    good = [candidate(0.7)]
    judged(search, *[good] * (RULE.confirmations - 1))
    search.clear()
    assert judged(search, good)[0].accepted is None


def test_no_candidate_means_searching(search):
    (result,) = judged(search, [])
    assert (result.travelled, result.epoch) == (REQUEST.travelled, REQUEST.epoch)
    assert result.accepted is None
    assert result.evidence.state is State.SEARCHING
    assert result.evidence.score == 0.0


def test_single_scan_needs_a_larger_lead(stationary):
    """The default of one frame alone: accepted at once, but only far ahead of every rival."""
    assert RULE.single_lead >= 0.2
    assert judged(stationary, [candidate(0.7)])[0].accepted is not None
    ahead = [candidate(0.7), candidate(0.7 - RULE.single_lead - 0.03, moved(20))]
    assert judged(stationary, ahead)[0].accepted is ahead[0]
    for behind in (0.0, RULE.lead + 0.02, RULE.single_lead - 0.03):
        (result,) = judged(stationary, [candidate(0.7), candidate(0.7 - behind, moved(20))])
        assert result.accepted is None
        assert result.evidence.state is State.AMBIGUOUS
    assert judged(stationary, [candidate(RULE.single_score - 0.01)])[0].accepted is None
    assert judged(stationary, [candidate(0.9, inside=RULE.min_overlap - 0.05)])[0].accepted is None


# ---- on the small world


@pytest.fixture(scope="module")
def twin_map(map_points, tmp_path_factory):
    """Two equal places side by side."""
    path = tmp_path_factory.mktemp("twins") / "twins.ply"
    both = np.concatenate([map_points, map_points + np.array([2 * small_world.HALF, 0, 0])])
    write_cloud(path, both.astype(np.float32))
    return BaseMap.build(path, radius=30.0)


@pytest.mark.slow
def test_single_scan_is_refused_between_two_equal_places(world_map, twin_map, world_drive):
    config = LocalizerConfig(stationary=True)
    scan = world_drive.clouds[2], world_drive.T_odom_body[2], 0.0
    alone = Localizer(world_map, config).step(*scan)
    assert alone.state is State.TRACKING
    between_two = Localizer(twin_map, config).step(*scan)
    assert between_two.state is State.AMBIGUOUS
    assert between_two.T_map_body is None
    assert between_two.evidence.rival > 0.8 * between_two.evidence.score


def run_of(world_drive, frames, T_map_odom=T_MAP_ODOM):
    """A request for each keyframe of the run, odometry near its origin."""
    buffer = KeyframeBuffer(LocalizerConfig().keyframe)
    descriptor = DescriptorConfig(radius=30.0)  # the small world's
    for k in range(frames):
        T = inverse(T_map_odom) @ world_drive.T_map_body[k]
        cloud = world_drive.clouds[k]
        yield SearchRequest.of(
            buffer, buffer.add(voxelized(cloud, T, buffer.config), T, 0.5 * k), cloud, RequestSpec(descriptor)
        )


def test_good_candidate_is_tried_again_without_votes(search, world_drive, monkeypatch):
    frames = run_of(world_drive, 3)
    assert search.update(next(frames)).evidence.score > 0.8
    monkeypatch.setattr(search.coview.consensus, "hypotheses", list)
    again = search.update(next(frames))
    assert again.evidence.score > 0.8
    assert "confirmed by 2 keyframes" in again.evidence.reason
    search.clear()
    assert search.update(next(frames)).evidence.score == 0.0


@pytest.mark.slow
def test_single_minimum_mode_finds_an_easy_place(search, world_drive):
    single = replace(search.config, consensus=ConsensusConfig(mode="single"))
    paper = GlobalSearch(search.base_map, single, LocalMaps(search.base_map, 50.0))
    assert paper.update(next(run_of(world_drive, 1))).evidence.score > 0.8


def test_wrong_place_is_scored_again_but_not_confirmed(search, world_drive, monkeypatch):
    frames = run_of(world_drive, 3)
    wrong = Hypothesis(T_MAP_ODOM @ pose_from(rot_z(2.0), [9.0, -14.0, 0.0]), 0, 0, 0.0)
    monkeypatch.setattr(search.coview.consensus, "hypotheses", lambda: [wrong])
    assert search.update(next(frames)).evidence.score < RULE.score
    monkeypatch.setattr(search.coview.consensus, "hypotheses", list)
    for frame in frames:
        again = search.update(frame)
        assert len(again.rivals) == 1
        assert again.evidence.score < RULE.score


def test_result_carries_all_distinct_places_that_were_scored(search, world_drive):
    result = search.update(next(run_of(world_drive, 1)))
    rivals = result.rivals
    assert len(rivals) > 20
    rank = rivals.scores * rivals.inside
    assert (np.diff(rank) <= 0).all()
    assert np.linalg.norm((rivals.T_map_odom[0] - T_MAP_ODOM)[:3, 3]) < 0.6
    assert rank[0] > 2 * rank[1]
    robot = rivals.T_map_odom @ np.append(next(run_of(world_drive, 1)).position, 1.0)
    gap = np.linalg.norm(robot[:, None] - robot[None], axis=2)
    yaw = np.arctan2(rivals.T_map_odom[:, 1, 0], rivals.T_map_odom[:, 0, 0])
    turn = np.abs((yaw[:, None] - yaw[None] + np.pi) % (2 * np.pi) - np.pi)
    assert ((gap >= 2.0) | (turn >= np.radians(5.0)) | np.eye(len(rivals), dtype=bool)).all()


def test_place_that_was_only_scored_is_a_rival_too(search):
    best = candidate(0.7)
    close = ScoredPlace(Hypothesis(moved(20), 7, 1, -2.0), 0.7 - RULE.lead / 2, 1.0)
    beyond = replace(close, inside=0.3)  # most of the scan is not on the map there
    for place, state in ((close, State.AMBIGUOUS), (beyond, State.TRACKING)):
        search.clear()
        for _ in range(3 * RULE.confirmations):
            result = search._acceptance.decide([best], REQUEST, 5, Scored(Rivals.none(), [best.place, place]))
        assert result.evidence.state is state


def with_leaning_odometry(world_map, world_drive, monkeypatch, gravity_sigma, max_tilt):
    """First search keyframe; the odometry leans against gravity by TILT, the hypothesis is right but upright."""
    config = LocalizerConfig(
        registration=RegistrationConfig(gravity_sigma=gravity_sigma),
        acceptance=AcceptanceConfig(
            max_tilt=max_tilt,
            confirmations=1,
            evidence_sum=0.01,
            evidence_floor=0.0,
            score=0.01,
            lead=0.01,
            ground=0.01,
        ),
    )
    robot = pose_from(np.eye(3), world_drive.T_map_body[0][:3, 3])
    leaning = robot @ exp_se3(np.array([TILT, 0.0, 0.0, 0.0, 0.0, 0.0]))
    search = GlobalSearch(world_map, config, LocalMaps(world_map, 50.0))
    upright = Hypothesis(robot, 0, 0, 0.0)
    monkeypatch.setattr(search.coview.consensus, "hypotheses", lambda: [upright])
    return search.update(next(run_of(world_drive, 1, leaning)))


def test_gravity_prior_keeps_candidates_upright(world_map, world_drive, monkeypatch):
    def found(sigma_degrees):
        result = with_leaning_odometry(world_map, world_drive, monkeypatch, np.radians(sigma_degrees), 1.0)
        return tilt_of(result.accepted.T_map_odom)

    assert found(30.0) == pytest.approx(TILT, rel=0.1)
    assert found(0.01) < 0.3 * TILT


def test_gravity_prior_has_no_heading_or_position_information():
    np.testing.assert_allclose(gravity_information(0.02), np.diag([2500.0, 2500.0, 0, 0, 0, 0]))


@pytest.mark.parametrize("limit", [2.0, 0.5])
def test_candidate_tilted_beyond_limit_is_dropped(world_map, world_drive, monkeypatch, limit):
    result = with_leaning_odometry(world_map, world_drive, monkeypatch, np.radians(30.0), limit * TILT)
    assert (result.evidence.score > 0.5) == (limit > 1)
    assert (result.accepted is not None) == (limit > 1)
