"""Hints and guesses: judged like every other place, never trusted, harmless when wrong; when they are tried."""

import numpy as np
import pytest
import small_world
from made_up_places import name_instead
from se3 import exp_se3
from small_world import assert_pose, pose_error
from trackers import assert_usual, follow, garbage

from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import ConfigError, RunError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, tilt_of, yaw_of
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search import hints
from coview_stream.localization.search.hints import HintSchedule, PlaceGuess, PoseHints
from coview_stream.localization.search.scoring import PlaceScorer
from coview_stream.localization.state import State

NEAR = pose_from(rot_z(np.radians(2.0)), [0.6, -0.5, 0.1])  # what a parked robot's last pose may be off by
BESIDE = pose_from(rot_z(2.0), [9.0, -14.0, 0.0])  # another place of the map


def first_fix(fixes):
    return next((k for k, fix in enumerate(fixes) if fix.T_map_body is not None), None)


def misled(localizer, drive, metres=8.0):
    """The votes name some places, but never the right one, nor any near it."""
    first = pose_from(drive.T_odom_body[0][:3, :3], np.zeros(3))  # about the localizer's anchor
    T_map_odom = drive.T_map_body[0] @ inverse(first)

    def wrong(places):
        gaps = [(each.T_map_odom - T_map_odom) @ np.append(votes.centre, 1.0) for each in places]
        return [each for each, gap in zip(places, gaps, strict=True) if np.linalg.norm(gap[:2]) > metres]

    votes = name_instead(localizer.search, wrong)
    return localizer


UTM = np.array([512_345.6, 5_403_210.9, 287.4])


def test_correct_hint_is_judged_like_what_votes_find(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    fixes = follow(localizer, world_drive, 4)
    assert first_fix(fixes) == first_fix(world_fixes)
    assert [f.evidence.state for f in fixes] == [f.evidence.state for f in world_fixes[:4]]


def test_hint_is_given_in_map_source_coordinates(world_map, world_drive):
    """A map far from zero, odometry far from zero, and a robot that leans otherwise than when it was saved."""
    far = BaseMap({**world_map.arrays, "origin": UTM + world_map.origin}, world_map.parameters)
    localizer = misled(Localizer(far), world_drive)
    leaning = exp_se3(np.array([0.05, -0.04, 0.0, *UTM])) @ pose_from(np.eye(3), -UTM)
    there = pose_from(np.eye(3), UTM) @ world_drive.T_map_body[0] @ NEAR
    localizer.hint_pose(leaning @ there)
    fixes = follow(localizer, world_drive, 5)
    assert fixes[-1].state is State.TRACKING
    moved = pose_from(np.eye(3), -UTM) @ fixes[-1].T_map_body
    assert pose_error(moved, world_drive.T_map_body[4])[0] < 0.1


def test_hint_refers_to_the_next_frame(world_map, world_drive):
    localizer = Localizer(world_map)
    name_instead(localizer.search)
    follow(localizer, world_drive, 1)
    T = world_drive.T_odom_body[0] @ pose_from(np.eye(3), [0.1, 0.0, 0.0])
    localizer.hint_pose(world_drive.T_map_body[0])
    assert localizer.add_frame(world_drive.clouds[0], T, 0.1) is None  # no keyframe: it has hardly moved
    request = localizer.add_frame(world_drive.clouds[1], world_drive.T_odom_body[1], 0.5)
    (T_map_odom,) = request.hints
    metres, degrees = pose_error(T_map_odom @ request.T_odom_body, world_drive.T_map_body[1])
    # but for what the lidar says of the motion between the two
    assert metres == pytest.approx(0.1, abs=0.01)
    assert degrees < 0.1
    assert tilt_of(T_map_odom) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("off", [None, BESIDE, pose_from(rot_z(np.pi), [0, 0, 0]), pose_from(np.eye(3), [900.0, 0, 0])])
def test_wrong_hint_does_not_delay_the_fix(world_map, world_drive, world_fixes, off):
    localizer = Localizer(world_map)
    farthest = pose_from(np.eye(3), [9.9e6, -9.9e6, 9.9e6])  # that is accepted
    localizer.hint_pose(farthest if off is None else world_drive.T_map_body[0] @ off)
    fixes = follow(localizer, world_drive, 4)
    assert_usual(fixes, world_fixes, 1e-6)
    assert [fix.evidence.station for fix in fixes] == [usual.evidence.station for usual in world_fixes[:4]]


@pytest.mark.slow
def test_hint_gives_no_pose_off_the_map(world_map, world_drive, elsewhere):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0])
    for fix in follow(localizer, elsewhere, 4):
        assert fix.T_map_body is None


@pytest.fixture(scope="module")
def lookalike_map(map_points):
    """Beside the robot's place another that is like it but for what stands in its upper right quarter."""
    quarter = (map_points[:, 0] > 4) & (map_points[:, 1] > 4) & (map_points[:, 2] > 0.2)
    other = map_points[~quarter] + np.array([2 * small_world.HALF, 0, 0])
    return BaseMap.build(np.concatenate([map_points, other]).astype(np.float32), radius=30.0)


@pytest.mark.slow
def test_lookalike_hint_waits_for_votes_of_the_true_place(lookalike_map, world_drive):
    """The right place comes up with the fourth keyframe's votes, and before on the map, as it looks like the hint."""
    localizer = Localizer(lookalike_map)
    votes = name_instead(localizer.search, lambda places: places if len(votes) > 3 else [])
    localizer.hint_pose(pose_from(np.eye(3), [2 * small_world.HALF, 0, 0]) @ world_drive.T_map_body[0])
    fixes = follow(localizer, world_drive, 10)
    assert all(f.evidence.reason.startswith("two places fit") for f in fixes[:3])
    posed = first_fix(fixes)
    assert posed in range(3, 10)
    for fix, truth in zip(fixes[posed:], world_drive.T_map_body[posed:], strict=False):
        assert pose_error(fix.T_map_body, truth)[0] < 0.1


@pytest.mark.parametrize("bad", [2 * np.eye(4), pose_from(np.eye(3), [1e8, 0, 0]), None], ids=str)
def test_invalid_hint_pose_is_refused(world_map, bad):
    with pytest.raises(RunError, match="T_map_body"):
        Localizer(world_map).hint_pose(bad)


def test_place_that_led_is_one_hint_beside_the_others():
    hints = PoseHints()
    hints.odometry_continues(pose_from(rot_z(0.3), [5.0, 1.0, 0.0]), np.array([100.0, 0.0, 0.0]))
    for x in (1.0, 2.0):
        hints.place_leads(pose_from(rot_z(0.1), [x, 0.0, 0.0]), np.array([100.0, 0.0, 0.0]))
    assert len(hints.about(np.array([100.0, 0.0, 0.0]), np.eye(4))) == 1  # until the search begins anew
    hints.search_begins_anew()
    continued, led = hints.about(np.array([100.0, 0.0, 0.0]), np.eye(4))
    np.testing.assert_allclose(continued, pose_from(rot_z(0.3), [5.0, 1.0, 0.0]), atol=1e-9)
    np.testing.assert_allclose(led, pose_from(rot_z(0.1), [2.0, 0.0, 0.0]), atol=1e-9)
    hints.clear()
    assert hints.about(np.zeros(3), np.eye(4)) == ()


def test_hints_stay_at_the_places_that_they_named_before_a_jump():
    kept, anchor, T_odom_body = PoseHints(), np.array([100.0, 0.0, 0.0]), pose_from(rot_z(0.2), [3.0, 1.0, 0.0])
    T_map_odom = pose_from(rot_z(0.3), [5.0, 1.0, 0.0])
    kept.odometry_continues(T_map_odom, anchor)
    np.testing.assert_allclose(kept.lost(anchor), T_map_odom, atol=1e-9)
    kept.forget_lost()
    assert kept.lost(anchor) is None
    kept.odometry_continues(T_map_odom, anchor)
    kept.guess(PlaceGuess(0.0, 0.0, within=60.0))
    kept.guessed(np.zeros(3), anchor, T_odom_body)
    kept.odometry_jumped(anchor, T_odom_body)
    assert kept.lost(anchor) is None  # odometry does not lead from there
    after = pose_from(rot_z(-1.0), [400.0, 7.0, 0.0])
    (hint,) = kept.about(np.zeros(3), after)
    np.testing.assert_allclose(hint @ after, T_map_odom @ T_odom_body, atol=1e-9)
    assert kept.circle is None
    assert kept.guessed(np.zeros(3), anchor, after) == ()


def test_hint_is_kept_until_reset(world_map, world_drive):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0])
    requests = [localizer.add_frame(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k) for k in (0, 1)]
    assert [len(request.hints) for request in requests] == [1, 1]
    np.testing.assert_array_equal(requests[0].hints, requests[1].hints)
    localizer.reset()
    assert localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0).hints == ()


@pytest.mark.slow
def test_continuous_odometry_is_the_only_hint_after_loss(world_map, world_drive):
    """Hints from before the place was accepted, and from while it was known, are dropped."""
    localizer, k = Localizer(world_map), 5
    localizer.hint_pose(world_drive.T_map_body[0] @ BESIDE)
    assert follow(localizer, world_drive, k)[-1].state is State.TRACKING
    localizer.hint_pose(world_drive.T_map_body[0])
    while localizer.state is not State.LOST:
        localizer.step(garbage(k), world_drive.T_odom_body[k], 0.5 * k)
        k += 1
    request = localizer.add_frame(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
    (T_map_odom,) = request.hints
    assert_pose(T_map_odom @ request.T_odom_body, world_drive.T_map_body[k], 0.3, 0.5)
    np.testing.assert_array_equal(request.lost.T_map_odom, T_map_odom)
    assert 0.01 < np.sqrt(request.lost.covariance[3, 3]) < 1.0  # some metres have been driven
    assert 1e-5 < request.lost.odds < 0.5


def test_odometry_frame_hint_is_kept_across_anchors():
    rng = np.random.default_rng(3)
    T_map_odom, T_odom_body = (exp_se3(rng.uniform(-1, 1, 6) * [0, 0, 3, 50, 50, 3]) for _ in range(2))
    first, second = rng.uniform(-1e3, 1e3, (2, 3))
    kept = PoseHints()
    kept.odometry_continues(T_map_odom, first)
    (again,) = kept.about(second, np.eye(4))
    moved = pose_from(np.eye(3), first - second) @ T_odom_body  # the same pose about the second anchor
    np.testing.assert_allclose(again @ moved, T_map_odom @ T_odom_body, atol=1e-9)
    np.testing.assert_allclose(kept.about(first, np.eye(4))[0], T_map_odom, atol=1e-9)


def test_new_hint_or_one_keyframe_that_does_not_refute_it_starts_the_tries_again():
    schedule = HintSchedule()
    for refuted in [*[True] * (hints._TRIES - 1), False] * 3:
        assert schedule.due((np.eye(4),))
        schedule.tried(refuted)
    for _ in range(hints._TRIES):
        assert schedule.due((np.eye(4),))
        schedule.tried(refuted=True)
    assert not schedule.due((np.eye(4),))
    assert schedule.due((pose_from(rot_z(0.1), [0, 0, 0]),))


def counted(monkeypatch):
    """Hinted places that were scored, keyframe by keyframe."""
    made, whole = [], PlaceScorer.score

    def score(*given):
        scored = whole(*given)
        made.append(sum(place.hinted for place in scored.places))
        return scored

    monkeypatch.setattr(PlaceScorer, "score", score)
    return made


@pytest.mark.slow
def test_refuted_hint_is_rarely_tried_again(world_map, world_drive, monkeypatch):
    localizer = misled(Localizer(world_map), world_drive)
    made = counted(monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ BESIDE)
    follow(localizer, world_drive, 10)
    assert made == [1] * hints._TRIES + [0] * 4 + [1]


@pytest.mark.slow
def test_hint_outside_the_map_is_not_refuted(world_map, world_drive, monkeypatch):
    localizer = Localizer(world_map)
    name_instead(localizer.search)
    made = counted(monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ pose_from(np.eye(3), [500.0, 0, 0]))
    follow(localizer, world_drive, 10)
    assert made == [1] * 10


@pytest.mark.parametrize("hinted", [True, False])
def test_followed_hint_is_one_place_and_waits_for_votes(world_map, world_drive, monkeypatch, hinted):
    localizer = Localizer(world_map)
    name_instead(localizer.search)
    made = counted(monkeypatch)
    if hinted:
        localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    states = {fix.state for fix in follow(localizer, world_drive, 6)}
    assert states == {State.AMBIGUOUS if hinted else State.SEARCHING}
    assert made == [int(hinted)] * 6


def test_poses_to_try_begin_at_the_guess_and_cover_its_surroundings():
    guess = PlaceGuess(10.0, 20.0, 0.5, distance=6.0, angle=np.radians(26))
    poses = guess.poses()
    np.testing.assert_allclose(poses[0], [10.0, 20.0, 0.5])
    assert np.linalg.norm(poses[:, :2] - (10.0, 20.0), axis=1).max() <= 6.0
    assert np.degrees(np.ptp(poses[:, 2])) == pytest.approx(52)
    for place in np.random.default_rng(1).uniform((6.0, 16.0), (14.0, 24.0), (50, 2)):
        assert np.linalg.norm(poses[:, :2] - place, axis=1).min() < 3.0


def test_guess_without_heading_tries_them_all():
    yaws = np.unique(np.round(PlaceGuess(0.0, 0.0, distance=1.0).poses()[:, 2], 6))
    gaps = np.diff(np.concatenate([yaws, yaws[:1] + 2 * np.pi]))
    assert np.degrees(gaps).max() < 14.0


@pytest.mark.parametrize(
    "fields",
    [
        {"x": float("nan")},
        {"x": "1"},
        {"x": True},
        {"y": 1e9},
        {"distance": 0.0},
        {"distance": 100.0},
        {"yaw": np.inf},
        {"distance": "5"},
        {"angle": None},
        {"within": "60"},
        {"x": 10**400},
    ],
)
def test_impossible_guesses_are_refused(fields):
    with pytest.raises(ConfigError):
        PlaceGuess(**{"x": 1.0, "y": 2.0, **fields})


@pytest.mark.slow
def test_wrong_guess_changes_nothing_of_where_and_when_the_robot_is_found(world_map, world_drive, world_fixes):
    away = world_fixes[first_fix(world_fixes)].T_map_body[:2, 3] + (15.0, -12.0)
    localizer = Localizer(world_map)
    localizer.guess_place(PlaceGuess(*away.tolist(), 2.0))
    assert_usual(follow(localizer, world_drive, 6), world_fixes, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("yaw", ["known", "open", "no guess"])
def test_right_guess_finds_a_place_that_no_vote_has_named(world_map, world_drive, yaw):
    localizer, T = misled(Localizer(world_map), world_drive, 15.0), world_drive.T_map_body[0]
    if yaw != "no guess":
        x, y = (T[:2, 3] + world_map.origin[:2] + (2.0, -1.5)).tolist()
        localizer.guess_place(PlaceGuess(x, y, yaw_of(T) + 0.25 if yaw == "known" else None))
    fixes = follow(localizer, world_drive, 6)
    assert (first_fix(fixes) is None) == (yaw == "no guess")
    for fix, truth in zip(fixes, world_drive.T_map_body, strict=False):
        assert fix.T_map_body is None or pose_error(fix.T_map_body, truth)[0] < 0.3
