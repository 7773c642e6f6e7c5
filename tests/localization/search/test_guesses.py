"""Guesses of a place: tried, judged like any other, never trusted."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.transforms import pose_from, rot_z, yaw_of
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.localization.state import State


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
    [{"x": float("nan")}, {"x": "1"}, {"x": True}, {"y": 1e9}, {"distance": 0.0}, {"distance": 100.0}, {"yaw": np.inf}],
)
def test_impossible_guesses_are_refused(fields):
    with pytest.raises(ConfigError):
        PlaceGuess(**{"x": 1.0, "y": 2.0, **fields})


def test_transforms_put_the_robot_where_it_is_guessed():
    T_odom_body, origin = pose_from(rot_z(0.7), [3.0, -2.0, 1.0]), np.array([100.0, 200.0, 5.0])
    guess = PlaceGuess(112.0, 205.0, -0.4)
    T_map_body = guess.transforms(origin, T_odom_body)[0] @ T_odom_body
    np.testing.assert_allclose(T_map_body[:2, 3], [12.0, 5.0])
    assert yaw_of(T_map_body) == pytest.approx(-0.4)


def drive(localizer, world_drive, guess):
    if guess is not None:
        localizer.guess_place(guess)
    fixes = []
    for cloud, T, k in zip(world_drive.clouds, world_drive.T_odom_body, range(6), strict=False):
        fixes.append(localizer.step(cloud, T, 0.5 * k))
    return fixes


@pytest.mark.slow
def test_wrong_guess_changes_nothing_of_where_and_when_the_robot_is_found(world_map, world_drive, world_fixes):
    true = next(fix for fix in world_fixes if fix.T_map_body is not None)
    away = true.T_map_body[:2, 3] + (15.0, -12.0)
    found = drive(Localizer(world_map), world_drive, PlaceGuess(*away.tolist(), 2.0))
    for fix, plain in zip(found, world_fixes, strict=False):
        assert fix.state is plain.state
        if fix.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body[:3, 3], plain.T_map_body[:3, 3], atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("yaw", ["known", "open"])
def test_right_guess_finds_a_place_that_no_vote_has_named(world_map, world_drive, world_fixes, yaw, monkeypatch):
    true = next(fix for fix in world_fixes if fix.T_map_body is not None)
    T, place = true.T_map_body, (true.T_map_body[:3, 3] - world_map.origin)[:2]

    def without_the_right_one(localizer):
        search, asked = localizer.search, []
        vote, propose = search._vote, search._propose

        def far_away():
            named, ranks = propose()
            T_odom_body = asked[-1].T_odom_body
            far = [np.linalg.norm((each.T_map_odom @ T_odom_body)[:2, 3] - place) > 15.0 for each in named]
            return [n for n, away in zip(named, far, strict=True) if away], [
                r for r, away in zip(ranks, far, strict=True) if away
            ]

        monkeypatch.setattr(search, "_vote", lambda request: (asked.append(request), vote(request)))
        monkeypatch.setattr(search, "_propose", far_away)
        return localizer

    lost = drive(without_the_right_one(Localizer(world_map)), world_drive, None)
    assert all(fix.state is not State.TRACKING for fix in lost)
    x, y = T[:2, 3] + (2.0, -1.5)
    guess = PlaceGuess(float(x), float(y), yaw_of(T) + 0.25 if yaw == "known" else None)
    found = drive(without_the_right_one(Localizer(world_map)), world_drive, guess)
    fix = next(fix for fix in found if fix.T_map_body is not None)
    plain = world_fixes[[f.stamp for f in world_fixes].index(fix.stamp)]
    assert plain.T_map_body is None or np.linalg.norm(fix.T_map_body[:3, 3] - plain.T_map_body[:3, 3]) < 0.3


def test_guess_beside_the_map_is_refused(world_map):
    with pytest.raises(InputError, match="no ground within 5 m"):
        Localizer(world_map).guess_place(PlaceGuess(9000.0, 9000.0))
