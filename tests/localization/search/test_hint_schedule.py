"""Hints: how long they are kept, how often they are tried, and when one is accepted."""

from __future__ import annotations

import numpy as np
import pytest
from hint_cases import BESIDE, NEAR, RULE, follow, misled, voteless
from se3 import exp_se3
from small_world import pose_error

from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search import hints
from coview_stream.localization.search.hints import HintSchedule, PoseHints
from coview_stream.localization.state import State

# ---- what a localizer keeps


def test_hint_is_kept_until_accepted_or_reset(world_map, world_drive):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0])
    requests = [localizer.add_frame(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k) for k in (0, 1)]
    assert [len(request.hints) for request in requests] == [1, 1]
    np.testing.assert_array_equal(requests[0].hints, requests[1].hints)
    localizer.reset()
    assert localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0).hints == ()
    localizer.hint_pose(world_drive.T_map_body[0] @ BESIDE)
    assert follow(localizer, world_drive, 4, 1)[-1].state is State.TRACKING
    assert localizer._requests.hints.about(np.zeros(3), np.eye(4)) == ()
    localizer.hint_pose(world_drive.T_map_body[0])  # now it knows better
    assert localizer._requests.hints.about(np.zeros(3), np.eye(4)) == ()


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


@pytest.mark.slow
def test_continuous_odometry_hints_the_place_after_loss(world_map, world_drive):
    localizer, k = lost(world_map, world_drive)
    request = localizer.add_frame(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
    (T_map_odom,) = request.hints
    metres, degrees = pose_error(T_map_odom @ request.T_odom_body, world_drive.T_map_body[k])
    assert metres < 0.3
    assert degrees < 0.5


@pytest.mark.slow
def test_jumped_odometry_hint_is_not_accepted_after_loss(world_map, world_drive):
    localizer, k = lost(world_map, world_drive)
    jump = pose_from(rot_z(0.7), [12.0, -5.0, 0.0])
    for fix, truth in zip(
        [localizer.step(world_drive.clouds[n], jump @ world_drive.T_odom_body[n], 0.5 * n) for n in range(k, 10)],
        world_drive.T_map_body[k:],
        strict=True,
    ):
        assert fix.T_map_body is None or pose_error(fix.T_map_body, truth)[0] < 0.1


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


# ---- what a search tries


def test_hint_is_tried_at_once_then_periodically():
    schedule = HintSchedule()
    tried = []
    for _ in range(100):
        due = schedule.due((np.eye(4),))
        tried.append(bool(due))
        if due:
            schedule.tried(refuted=True)
    assert tried[: hints._TRIES] == [True] * hints._TRIES
    gaps = np.diff(np.flatnonzero(tried))[hints._TRIES - 1 :]
    assert set(gaps) == {hints._PAUSE + 1}


def test_unrefuted_keyframe_resets_hint_tries():
    schedule = HintSchedule()
    for refuted in [*[True] * (hints._TRIES - 1), False] * 3:
        assert schedule.due((np.eye(4),))
        schedule.tried(refuted)
    assert schedule.due((np.eye(4),))


def test_new_hint_is_tried_at_once():
    schedule = HintSchedule()
    for _ in range(hints._TRIES):
        schedule.due((np.eye(4),))
        schedule.tried(refuted=True)
    assert not schedule.due((np.eye(4),))
    assert schedule.due((pose_from(rot_z(0.1), [0, 0, 0]),))


def counted(localizer, monkeypatch):
    """Hinted places that were scored, keyframe by keyframe."""
    made = []
    whole = localizer.search._register

    def register(scored, *others):
        made.append(sum(place.hinted for place in scored.places))
        return whole(scored, *others)

    monkeypatch.setattr(localizer.search, "_register", register)
    return made


def test_refuted_hint_is_rarely_tried_again(world_map, world_drive, monkeypatch):
    localizer = misled(Localizer(world_map), world_drive, monkeypatch)
    made = counted(localizer, monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ BESIDE)
    follow(localizer, world_drive, 10)
    assert made == [1] * hints._TRIES + [0] * 4 + [1]


def test_hint_outside_the_map_is_not_refuted(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    made = counted(localizer, monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ pose_from(np.eye(3), [500.0, 0, 0]))
    follow(localizer, world_drive, 10)
    assert made == [1] * 10


def test_followed_hint_is_one_place(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    made = counted(localizer, monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    follow(localizer, world_drive, 4)
    assert made == [1] * 4


# ---- acceptance


def test_hint_waits_for_places_that_votes_name(world_map, world_drive, monkeypatch):
    """Whatever fits at the hint may fit elsewhere as well: without a rival there is nothing to compare it with."""
    localizer = Localizer(world_map)
    consensus = localizer.search.coview.consensus
    found = consensus.hypotheses
    monkeypatch.setattr(consensus, "hypotheses", lambda: found()[1:] if len(consensus) > 2 else [])
    localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    fixes = follow(localizer, world_drive, 3)
    assert [fix.state for fix in fixes] == [State.AMBIGUOUS, State.AMBIGUOUS, State.TRACKING]
    assert fixes[0].T_map_body is None
    assert fixes[2].evidence.confidence > 1.0 - RULE.risk


def test_hint_places_the_robot_for_any_odometry_pose():
    """The robot is at the hinted place at any odometry pose."""
    kept = PoseHints()
    T_map_body, T_odom_body = pose_from(rot_z(2.5), [40, -7, 3]), pose_from(rot_z(-1.0), [5, 6, 0.2])
    kept.robot_at(T_map_body)
    (T,) = kept.about(np.array([100.0, 200.0, 5.0]), T_odom_body)
    np.testing.assert_allclose(T @ T_odom_body, T_map_body, atol=1e-9)
    np.testing.assert_allclose(inverse(T) @ T_map_body, T_odom_body, atol=1e-9)
