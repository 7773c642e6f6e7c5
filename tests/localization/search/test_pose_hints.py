"""Hints: verified and judged like what the votes find, never trusted, and harmless when wrong."""

from __future__ import annotations

import numpy as np
import pytest
import small_world
from hint_cases import BESIDE, NEAR, first_fix, follow, misled, voteless
from se3 import exp_se3
from small_world import pose_error

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.files import write_cloud
from coview_stream.errors import RunError
from coview_stream.geometry.transforms import pose_from, rot_z, tilt_of
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.hints import FROM_THERE, PoseHints
from coview_stream.localization.state import State

UTM = np.array([512_345.6, 5_403_210.9, 287.4])


# ---- right ones


def test_correct_hint_is_judged_like_what_votes_find(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    fixes = follow(localizer, world_drive, 4)
    assert first_fix(fixes) == first_fix(world_fixes)
    assert [f.evidence.state for f in fixes] == [f.evidence.state for f in world_fixes[:4]]


def test_correct_hint_without_votes_for_it_gives_a_pose(world_map, world_drive, monkeypatch):
    localizer = misled(Localizer(world_map), world_drive, monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    fixes = follow(localizer, world_drive, 3)
    posed = first_fix(fixes)
    assert posed is not None
    for fix in fixes[: posed + 1]:
        assert fix.evidence.reason.endswith(FROM_THERE)
        assert (fix.evidence.station, fix.evidence.shift) == (None, None)
    metres, degrees = pose_error(fixes[posed].T_map_body, world_drive.T_map_body[posed])
    assert metres < 0.1
    assert degrees < 0.3


def test_correct_hint_without_any_votes_waits(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
    localizer.hint_pose(world_drive.T_map_body[0] @ NEAR)
    assert {fix.state for fix in follow(localizer, world_drive, 6)} == {State.AMBIGUOUS}


def test_without_hint_and_votes_search_finds_nothing(world_map, world_drive, monkeypatch):
    fixes = follow(voteless(Localizer(world_map), monkeypatch), world_drive, 6)
    assert {fix.state for fix in fixes} == {State.SEARCHING}


def test_hint_is_given_in_map_source_coordinates(world_map, world_drive, monkeypatch):
    """A map far from zero, odometry far from zero, and a robot that leans otherwise than when it was saved."""
    far = BaseMap({**world_map.arrays, "origin": UTM + world_map.origin}, world_map.parameters)
    localizer = misled(Localizer(far), world_drive, monkeypatch)
    leaning = exp_se3(np.array([0.05, -0.04, 0.0, *UTM])) @ pose_from(np.eye(3), -UTM)
    there = pose_from(np.eye(3), UTM) @ world_drive.T_map_body[0] @ NEAR
    localizer.hint_pose(leaning @ there)
    fixes = follow(localizer, world_drive, 5)
    assert fixes[-1].state is State.TRACKING
    moved = pose_from(np.eye(3), -UTM) @ fixes[-1].T_map_body
    assert pose_error(moved, world_drive.T_map_body[4])[0] < 0.1


def test_hint_refers_to_the_next_frame(world_map, world_drive, monkeypatch):
    localizer = voteless(Localizer(world_map), monkeypatch)
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


# ---- wrong ones


@pytest.mark.slow
@pytest.mark.parametrize("off", [BESIDE, pose_from(rot_z(np.pi), [0, 0, 0]), pose_from(np.eye(3), [900.0, 0, 0])])
def test_wrong_hint_does_not_delay_the_fix(world_map, world_drive, world_fixes, off):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0] @ off)
    fixes = follow(localizer, world_drive, 4)
    assert first_fix(fixes) == first_fix(world_fixes)
    for fix, usual in zip(fixes, world_fixes, strict=False):
        assert fix.evidence.station == usual.evidence.station
        if fix.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body, usual.T_map_body, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("share", [(12, -4), (-14, 9)])
def test_wrong_hint_is_not_accepted_without_other_candidates(world_map, world_drive, monkeypatch, share):
    localizer = voteless(Localizer(world_map), monkeypatch)
    localizer.hint_pose(pose_from(rot_z(0.4), [*share, small_world.SENSOR_HEIGHT]))
    assert first_fix(follow(localizer, world_drive, 8)) is None


@pytest.mark.slow
def test_hint_gives_no_pose_off_the_map(world_map, world_drive, elsewhere):
    localizer = Localizer(world_map)
    localizer.hint_pose(world_drive.T_map_body[0])
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


@pytest.mark.slow
def test_hint_of_lookalike_place_is_never_accepted(lookalike_map, world_drive):
    plain = follow(Localizer(lookalike_map), world_drive, 8)
    localizer = Localizer(lookalike_map)
    localizer.hint_pose(pose_from(np.eye(3), [2 * small_world.HALF, 0, 0]) @ world_drive.T_map_body[0])
    fixes = follow(localizer, world_drive, 8)
    # a hint is one more rank for the wrong place, which may take some keyframes more to refute
    assert first_fix(plain) <= first_fix(fixes)
    for fix, truth in zip(fixes, world_drive.T_map_body, strict=False):
        assert fix.T_map_body is None or pose_error(fix.T_map_body, truth)[0] < 0.1


@pytest.mark.slow
def test_lookalike_hint_waits_for_votes_of_the_true_place(lookalike_map, world_drive, monkeypatch):
    """The right place comes up with the fourth keyframe's votes; by itself the wrong one would have won before."""
    localizer = Localizer(lookalike_map)
    consensus = localizer.search.coview.consensus
    found = consensus.hypotheses
    monkeypatch.setattr(consensus, "hypotheses", lambda: found() if len(consensus) > 3 else [])
    localizer.hint_pose(pose_from(np.eye(3), [2 * small_world.HALF, 0, 0]) @ world_drive.T_map_body[0])
    fixes = follow(localizer, world_drive, 8)
    assert all(f.evidence.confidence > 0.5 for f in fixes[:3])  # in the wrong one, and it was alone
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
def test_invalid_hint_pose_is_refused(world_map, bad):
    with pytest.raises(RunError, match="T_map_body"):
        Localizer(world_map).hint_pose(bad)


def test_farthest_accepted_hint_does_no_harm(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    localizer.hint_pose(pose_from(np.eye(3), [9.9e6, -9.9e6, 9.9e6]))
    assert first_fix(follow(localizer, world_drive, 4)) == first_fix(world_fixes)


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
