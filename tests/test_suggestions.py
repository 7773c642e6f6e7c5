"""Suggested places: verified and judged as what the votes find, never trusted, and not in the way when wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_world
from small_world import pose_error

from coview_stream import suggestions
from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.writers import write_cloud
from coview_stream.config import AcceptanceConfig, LocalizerConfig
from coview_stream.errors import RunError
from coview_stream.fix import State
from coview_stream.geometry import exp_se3, inverse, pose_from, rot_z, tilt_of
from coview_stream.localizer import Localizer
from coview_stream.pose.registration import LocalMaps
from coview_stream.query import same_place
from coview_stream.search import GlobalSearch
from coview_stream.suggestions import FROM_THERE, Suggestions, Trials

RULE = AcceptanceConfig()
UTM = np.array([512_345.6, 5_403_210.9, 287.4])
NEAR = pose_from(rot_z(np.radians(2.0)), [0.6, -0.5, 0.1])  # what a parked robot's last pose may be off by
BESIDE = pose_from(rot_z(2.0), [9.0, -14.0, 0.0])  # another place of the map


def follow(localizer, drive, frames, first=0):
    return [
        localizer.step(drive.clouds[k], drive.T_odom_body[k], 0.5 * k) for k in range(first, first + frames)
    ]


def first_fix(fixes):
    return next((k for k, fix in enumerate(fixes) if fix.T_map_body is not None), None)


def voteless(localizer, monkeypatch):
    """The keyframes vote, but nothing comes of it."""
    monkeypatch.setattr(localizer._search.consensus, "hypotheses", list)
    return localizer


# ---- right ones


def test_a_right_one_needs_the_proof_that_any_place_needs(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    localizer.suggest(world_drive.T_map_body[0] @ NEAR)
    fixes = follow(localizer, world_drive, 4)
    assert first_fix(fixes) == first_fix(world_fixes) == RULE.confirmations - 1
    assert [f.evidence.state for f in fixes] == [f.evidence.state for f in world_fixes[:4]]


def test_a_right_one_alone_is_found_but_waits_for_rivals(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    localizer.suggest(world_drive.T_map_body[0] @ NEAR)
    fixes = follow(localizer, world_drive, 6)
    posed = first_fix(fixes)
    # the first keyframes had voted too little for a rival to be seen
    assert posed == 2 * RULE.confirmations - 2
    assert all(fix.state is State.AMBIGUOUS for fix in fixes[:posed])
    assert f"rivals rest on 1 keyframes' votes, {RULE.confirmations} needed" in fixes[0].evidence.reason
    for fix in fixes[:posed]:
        assert fix.evidence.reason.endswith(FROM_THERE)
        assert (fix.evidence.station, fix.evidence.shift) == (None, None)
    metres, degrees = pose_error(fixes[posed].T_map_body, world_drive.T_map_body[posed])
    assert metres < 0.1
    assert degrees < 0.3


def test_without_it_there_would_be_nothing(world_map, world_drive, monkeypatch):
    fixes = follow(voteless(Localizer(world_map), monkeypatch), world_drive, 6)
    assert {fix.state for fix in fixes} == {State.SEARCHING}


def test_in_the_frame_of_the_maps_sources(world_map, world_drive, monkeypatch):
    """A map far from zero, odometry far from zero, and a robot that leans otherwise than when it was saved."""
    far = BaseMap({**world_map._arrays, "origin": UTM + world_map.origin}, world_map.parameters)
    localizer = voteless(Localizer(far), monkeypatch)
    leaning = exp_se3(np.array([0.05, -0.04, 0.0, *UTM])) @ pose_from(np.eye(3), -UTM)
    there = pose_from(np.eye(3), UTM) @ world_drive.T_map_body[0] @ NEAR
    localizer.suggest(leaning @ there)
    fixes = follow(localizer, world_drive, 5)
    assert fixes[-1].state is State.TRACKING
    moved = pose_from(np.eye(3), -UTM) @ fixes[-1].T_map_body
    assert pose_error(moved, world_drive.T_map_body[4])[0] < 0.1


def test_it_is_of_the_next_frame_whether_that_is_a_keyframe_or_not(world_map, world_drive, monkeypatch):
    localizer = Localizer(world_map)
    follow(localizer, world_drive, 1)
    voteless(localizer, monkeypatch)
    localizer._search.clear()
    T = world_drive.T_odom_body[0] @ pose_from(np.eye(3), [0.1, 0.0, 0.0])
    localizer.suggest(world_drive.T_map_body[0])
    assert localizer.take(world_drive.clouds[0], T, 0.1) is None  # no keyframe: it has hardly moved
    query = localizer.take(world_drive.clouds[1], world_drive.T_odom_body[1], 0.5)
    (T_map_odom,) = query.suggested
    metres, degrees = pose_error(T_map_odom @ query.T_odom_body, world_drive.T_map_body[1])
    assert metres == pytest.approx(0.1, abs=1e-6)
    assert degrees < 1e-3
    assert tilt_of(T_map_odom) < 1e-9


# ---- wrong ones


@pytest.mark.parametrize(
    "off", [BESIDE, pose_from(rot_z(np.pi), [0, 0, 0]), pose_from(np.eye(3), [900.0, 0, 0])]
)
def test_a_wrong_one_costs_no_fix(world_map, world_drive, world_fixes, off):
    localizer = Localizer(world_map)
    localizer.suggest(world_drive.T_map_body[0] @ off)
    fixes = follow(localizer, world_drive, 4)
    assert first_fix(fixes) == first_fix(world_fixes)
    for fix, usual in zip(fixes, world_fixes, strict=False):
        assert fix.evidence.station == usual.evidence.station
        if fix.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body, usual.T_map_body, atol=1e-6)


@pytest.mark.parametrize("share", [(12, -4), (-14, 9)])
def test_a_wrong_one_is_not_believed_though_nothing_else_is_offered(
    world_map, world_drive, monkeypatch, share
):
    localizer = voteless(Localizer(world_map), monkeypatch)
    localizer.suggest(pose_from(rot_z(0.4), [*share, small_world.SENSOR_HEIGHT]))
    assert first_fix(follow(localizer, world_drive, 8)) is None


def test_never_a_pose_for_a_robot_that_has_left_the_map(world_map, world_drive, elsewhere):
    localizer = Localizer(world_map)
    localizer.suggest(world_drive.T_map_body[0])
    for fix in follow(localizer, elsewhere, 4):
        assert fix.T_map_body is None


@pytest.fixture(scope="module")
def lookalike_map(map_points, tmp_path_factory):
    """Beside the robot's place another that is like it but for what stands in its upper right quarter."""
    path = tmp_path_factory.mktemp("lookalike") / "map.ply"
    quarter = (map_points[:, 0] > 4) & (map_points[:, 1] > 4) & (map_points[:, 2] > 0.2)
    other = map_points[~quarter] + np.array([2 * small_world.HALF, 0, 0])
    write_cloud(path, np.concatenate([map_points, other]).astype(np.float32))
    return BaseMap.build(path, radius=30.0)


def test_the_last_place_looks_like_the_one_that_the_robot_was_moved_to(lookalike_map, world_drive):
    plain = follow(Localizer(lookalike_map), world_drive, 8)
    localizer = Localizer(lookalike_map)
    localizer.suggest(pose_from(np.eye(3), [2 * small_world.HALF, 0, 0]) @ world_drive.T_map_body[0])
    fixes = follow(localizer, world_drive, 8)
    assert first_fix(plain) is not None
    assert first_fix(fixes) == first_fix(plain)
    for fix, truth in zip(fixes, world_drive.T_map_body, strict=False):
        assert fix.T_map_body is None or pose_error(fix.T_map_body, truth)[0] < 0.1


def test_a_lookalike_is_not_believed_before_the_votes_can_name_the_right_place(
    lookalike_map, world_drive, monkeypatch
):
    """The right place comes up with the fourth keyframe's votes; by itself the wrong one would have won before."""
    localizer = Localizer(lookalike_map)
    consensus = localizer._search.consensus
    found = consensus.hypotheses
    monkeypatch.setattr(
        consensus, "hypotheses", lambda: found() if len(consensus) > RULE.confirmations else []
    )
    localizer.suggest(pose_from(np.eye(3), [2 * small_world.HALF, 0, 0]) @ world_drive.T_map_body[0])
    fixes = follow(localizer, world_drive, 8)
    assert all(f.evidence.score > RULE.score for f in fixes[:3])  # the wrong one, and it was alone
    posed = first_fix(fixes)
    assert posed is not None
    for fix, truth in zip(fixes[posed:], world_drive.T_map_body[posed:], strict=False):
        assert pose_error(fix.T_map_body, truth)[0] < 0.1


@pytest.mark.parametrize(
    "bad",
    [
        np.eye(3),
        2 * np.eye(4),
        np.diag([1.0, -1, 1, 1]),
        np.full((4, 4), np.nan),
        pose_from(np.eye(3), [1e8, 0, 0]),
        "here",
        None,
    ],
    ids=str,
)
def test_what_is_no_pose_is_refused(world_map, bad):
    with pytest.raises(RunError, match="T_map_body"):
        Localizer(world_map).suggest(bad)


def test_the_farthest_that_is_taken_harms_nothing(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    localizer.suggest(pose_from(np.eye(3), [9.9e6, -9.9e6, 9.9e6]))
    assert first_fix(follow(localizer, world_drive, 4)) == first_fix(world_fixes)


# ---- what a localizer keeps


def test_kept_until_a_place_is_accepted_or_reset(world_map, world_drive):
    localizer = Localizer(world_map)
    localizer.suggest(world_drive.T_map_body[0])
    queries = [localizer.take(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k) for k in (0, 1)]
    assert [len(q.suggested) for q in queries] == [1, 1]
    np.testing.assert_array_equal(queries[0].suggested, queries[1].suggested)
    localizer.reset()
    assert localizer.take(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0).suggested == ()
    localizer.suggest(world_drive.T_map_body[0] @ BESIDE)
    assert follow(localizer, world_drive, 4, 1)[-1].state is State.TRACKING
    assert localizer._suggested(np.eye(4)) == ()
    localizer.suggest(world_drive.T_map_body[0])  # now it knows better
    assert localizer._suggested(np.eye(4)) == ()


def lost(world_map, world_drive):
    """A localizer that has just lost its place to a blinded sensor, and the frame after."""
    localizer = Localizer(world_map)
    follow(localizer, world_drive, 5)
    rng = np.random.default_rng(1)
    k = 5
    while localizer.state is not State.LOST:
        garbage = rng.uniform([-20, -20, -1.5], [20, 20, 6], (6000, 3)).astype(np.float32)
        localizer.step(garbage, world_drive.T_odom_body[k], 0.5 * k)
        k += 1
    return localizer, k


def test_after_a_loss_the_odometry_that_went_on_suggests_the_place(world_map, world_drive):
    localizer, k = lost(world_map, world_drive)
    query = localizer.take(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
    (T_map_odom,) = query.suggested
    metres, degrees = pose_error(T_map_odom @ query.T_odom_body, world_drive.T_map_body[k])
    assert metres < 0.3
    assert degrees < 0.5


def test_after_a_loss_an_odometry_that_jumped_suggests_nothing_that_is_believed(world_map, world_drive):
    localizer, k = lost(world_map, world_drive)
    jump = pose_from(rot_z(0.7), [12.0, -5.0, 0.0])
    for fix, truth in zip(
        [
            localizer.step(world_drive.clouds[n], jump @ world_drive.T_odom_body[n], 0.5 * n)
            for n in range(k, 10)
        ],
        world_drive.T_map_body[k:],
        strict=True,
    ):
        assert fix.T_map_body is None or pose_error(fix.T_map_body, truth)[0] < 0.1


def test_a_loss_keeps_the_odometrys_frame_whatever_the_anchor():
    rng = np.random.default_rng(3)
    T_map_odom, T_odom_body = (exp_se3(rng.uniform(-1, 1, 6) * [0, 0, 3, 50, 50, 3]) for _ in range(2))
    first, second = rng.uniform(-1e3, 1e3, (2, 3))
    kept = Suggestions()
    kept.frames_were(T_map_odom, first)
    (again,) = kept.about(second, np.eye(4))
    moved = pose_from(np.eye(3), first - second) @ T_odom_body  # the same pose about the second anchor
    np.testing.assert_allclose(again @ moved, T_map_odom @ T_odom_body, atol=1e-9)
    np.testing.assert_allclose(kept.about(first, np.eye(4))[0], T_map_odom, atol=1e-9)


# ---- what a search tries


def test_tried_at_once_then_now_and_then():
    trials = Trials()
    tried = []
    for _ in range(100):
        due = trials.due((np.eye(4),))
        tried.append(bool(due))
        if due:
            trials.tried(refuted=True)
    assert tried[: suggestions._TRIES] == [True] * suggestions._TRIES
    gaps = np.diff(np.flatnonzero(tried))[suggestions._TRIES - 1 :]
    assert set(gaps) == {suggestions._PAUSE + 1}


def test_one_keyframe_that_does_not_speak_against_it_starts_the_count_anew():
    trials = Trials()
    for refuted in [*[True] * (suggestions._TRIES - 1), False] * 3:
        assert trials.due((np.eye(4),))
        trials.tried(refuted)
    assert trials.due((np.eye(4),))


def test_another_suggestion_is_tried_at_once():
    trials = Trials()
    for _ in range(suggestions._TRIES):
        trials.due((np.eye(4),))
        trials.tried(refuted=True)
    assert not trials.due((np.eye(4),))
    assert trials.due((pose_from(rot_z(0.1), [0, 0, 0]),))


def counted(localizer, monkeypatch):
    """Suggestions that went through registration, keyframe by keyframe."""
    made = []
    whole = localizer._search._refinement.refine

    def refine(hypotheses, source, query):
        made.append(sum(h.station is None for h in hypotheses))
        return whole(hypotheses, source, query)

    monkeypatch.setattr(localizer._search._refinement, "refine", refine)
    return made


def test_a_refuted_one_is_hardly_tried_again(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    made = counted(localizer, monkeypatch)
    localizer.suggest(world_drive.T_map_body[0] @ BESIDE)
    follow(localizer, world_drive, 10)
    assert made == [1] * suggestions._TRIES + [0] * 4 + [1]


def test_where_the_map_knows_nothing_it_is_not_refuted(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    made = counted(localizer, monkeypatch)
    localizer.suggest(world_drive.T_map_body[0] @ pose_from(np.eye(3), [500.0, 0, 0]))
    follow(localizer, world_drive, 10)
    assert made == [1] * 10


def test_what_is_remembered_is_not_registered_twice(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    made = counted(localizer, monkeypatch)
    localizer.suggest(world_drive.T_map_body[0] @ NEAR)
    follow(localizer, world_drive, 4)
    assert made == [1] * 4


# ---- the judge


@pytest.mark.parametrize("votes", [0, 1, RULE.confirmations - 1, RULE.confirmations])
def test_the_judge_wants_rivals_before_it_believes_a_suggestion(world_map, votes):
    from test_search import HERE, KEYFRAME, candidate, judged

    search = GlobalSearch(world_map, LocalizerConfig(), LocalMaps(world_map, 50.0))
    for _ in range(votes):
        search.consensus._ballots.append(None)
    best = candidate(0.7)
    alone = replace(best, hypothesis=replace(best.hypothesis, station=None, shift=None))
    assert same_place(HERE, HERE, KEYFRAME)
    verdicts = judged(search, *[[alone, candidate(0.2, BESIDE @ HERE)]] * 5)
    accepted = [v.accepted is not None for v in verdicts]
    assert accepted == ([False] * 2 + [True] * 3 if votes == RULE.confirmations else [False] * 5)
    # a vote for the same place is worth as much as any
    search.clear()
    both = [alone, candidate(0.69)]
    assert [v.accepted is not None for v in judged(search, *[both] * 3)] == [False, False, True]


def test_one_scan_alone_never_believes_a_suggestion_that_no_vote_supports(world_map):
    from test_search import candidate, judged

    search = GlobalSearch(world_map, LocalizerConfig(stationary=True), LocalMaps(world_map, 50.0))
    best = candidate(0.9)
    alone = replace(best, hypothesis=replace(best.hypothesis, station=None, shift=None))
    (unsupported, supported) = judged(search, [alone], [alone, best])
    assert unsupported.accepted is None
    assert supported.accepted is not None


def test_inverse_of_a_suggestion_is_where_odometry_began():
    """The robot at the suggested place, whatever odometry says where it is."""
    kept = Suggestions()
    T_map_body, T_odom_body = pose_from(rot_z(2.5), [40, -7, 3]), pose_from(rot_z(-1.0), [5, 6, 0.2])
    kept.robot_at(T_map_body)
    (T,) = kept.about(np.array([100.0, 200.0, 5.0]), T_odom_body)
    np.testing.assert_allclose(T @ T_odom_body, T_map_body, atol=1e-9)
    np.testing.assert_allclose(inverse(T) @ T_map_body, T_odom_body, atol=1e-9)
