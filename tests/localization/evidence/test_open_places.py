"""Open places: how rare they are, among scored places and all over a map, and what another one is worth then."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_scans import CHANCE, PASSED, observation
from trackers import observed

from coview_stream.localization.evidence.background import Background
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.evidence.open_places import OpenPlaces

KNOWN = Background(CHANCE, PASSED, (0.8, 8.0), (30.0, 60.0))
ROUGH = observation(np.tile(CHANCE, (3900, 1)), passed=PASSED, ground=0.05)
CLEAR = observation(np.tile(CHANCE, (300, 1)), passed=0.0, ground=0.95)


def at(observations):
    """Poses a metre apart."""
    return np.column_stack([np.arange(len(observations)), np.zeros((len(observations), 3))])


def share(scored, *drives):
    """The share by scored places, and by drives of one keyframe that are added one part after the other."""
    places = OpenPlaces()
    for stations in drives:
        places.add(stations[:, None], at(stations))
        found = places.share(scored, KNOWN)
    return found


def test_share_is_presumed_then_counted_over_all_drives():
    assert share(ROUGH[:300], ROUGH[:0]) == pytest.approx(0.01)
    assert share(ROUGH[:300], ROUGH) == pytest.approx(1 / 4000, rel=0.05)
    assert share(ROUGH[:300], ROUGH, ROUGH) == pytest.approx(1 / 7900, rel=0.05)
    assert share(ROUGH[:300], ROUGH, np.concatenate([ROUGH, CLEAR])) == pytest.approx(301 / 8200, rel=0.05)


def test_scored_places_that_are_open_count_however_rare_others_are():
    some = np.concatenate([ROUGH[:285], CLEAR[:15]])
    assert share(some, ROUGH) == pytest.approx(15 / 300, rel=0.05)


def test_stations_in_sight_of_the_leader_are_left_out():
    places = OpenPlaces()
    places.add(np.concatenate([CLEAR[:30], ROUGH[:870]])[:, None], at(ROUGH[:900]))
    assert places.share(ROUGH[:300], KNOWN) == pytest.approx(31 / 1000, rel=0.05)
    assert places.share(ROUGH[:300], KNOWN, np.zeros(4)) == pytest.approx(1 / (1000 - 36), rel=0.05)


def test_the_same_background_asked_twice_counts_stations_once():
    places = OpenPlaces()
    places.add(ROUGH[:, None], at(ROUGH))
    once = places.share(ROUGH[:300], KNOWN)
    np.testing.assert_array_equal(places.share(ROUGH[:300], KNOWN), once)
    places.clear()
    places.add(ROUGH[:0, None], at(ROUGH[:0]))
    assert places.share(ROUGH[:300], KNOWN) == pytest.approx(0.01)


def test_another_open_place_is_worth_as_much_as_open_places_are_rare():
    few, usual, many = (
        log_likelihood_ratios(CLEAR[:1], replace(KNOWN, open=found))[0]
        for found in (share(ROUGH[:300], ROUGH), 0.01, share(CLEAR[:300], ROUGH))
    )
    assert few == pytest.approx(usual + np.log(40.0), abs=0.5)
    assert many < 0.1


def test_stations_of_a_level_site_are_open_to_a_robot_on_its_ground(world_map, world_drive):
    """The small world is level; a robot that is held forty metres above its place has the ground of none."""
    scan, places = (observed(world_drive.clouds[0], world_drive.T_map_body[0], voxels=False), OpenPlaces())
    level = world_drive.T_map_body[0][2, 3] - world_map.stations[0, 2]
    places.look(world_map.field, world_map.stations, [], scan, level)
    found = places.share(ROUGH[:300], KNOWN)
    places.clear()
    places.look(world_map.field, world_map.stations, [], scan, level + 40.0)
    assert found.min() > 10.0 * places.share(ROUGH[:300], KNOWN).max()


@dataclass(frozen=True)
class Points:
    structure: tuple = ()
    low: tuple = (0,)


@dataclass(frozen=True)
class EastwardRoads:
    """A part of a scan that fits a map of roads to the east, 100 m high, all of them or west of ``end`` only."""

    end: float = np.inf
    points: Points = Points()

    def look_up(self, field, poses, move):
        x, _, z, heading = poses.T
        fits = (np.abs(z - 100.0) < 1.0) & (np.cos(heading) > 0.8) & (x < self.end)
        return SimpleNamespace(poses=poses, shares=np.where(fits[:, None], CLEAR[:1], ROUGH[:1]))


@dataclass(frozen=True)
class Keyframe:
    """A robot's keyframe after ``x`` metres along its own road."""

    x: float
    few: EastwardRoads = EastwardRoads()

    poses = ObservedScan.poses
    transforms = ObservedScan.transforms

    @property
    def body(self):
        return np.array([self.x, 0.0, 0.0])


STATIONS = np.column_stack([np.linspace(0.0, 1000.0, 500), np.zeros(500), np.full(500, 98.5)]).astype(np.float32)


def over_drive(*keyframes):
    """The largest share after each keyframe of a drive."""
    places, found = OpenPlaces(), []
    for k, keyframe in enumerate(keyframes):
        places.look(None, STATIONS, keyframes[:k], keyframe, 1.5)
        found.append(places.share(ROUGH[:300], KNOWN).max())
    return found


def test_drives_that_stay_open_are_as_many_at_every_keyframe():
    """A hundred that are followed stand for all: a fifth of the headings are along the roads."""
    first, *rest = over_drive(*(Keyframe(3.0 * k) for k in range(6)))
    assert first == pytest.approx(0.2, abs=0.02)
    assert rest == pytest.approx([first] * 5, rel=0.1)


def test_a_place_counts_only_while_all_keyframes_find_it_open():
    """The roads end: a drive of four keyframes of which one is on a road and three beyond is none on roads."""
    half = EastwardRoads(end=500.0)
    usual = over_drive(*(Keyframe(3.0 * k) for k in range(4)))[-1]
    then_beyond = over_drive(Keyframe(0.0), *(Keyframe(3.0 * k, half) for k in (1, 2, 3)))[-1]
    once_beyond = over_drive(*(Keyframe(3.0 * k, half) for k in (0, 1, 2)), Keyframe(9.0))[-1]
    assert then_beyond == pytest.approx(0.5 * usual, rel=0.15)
    assert once_beyond == pytest.approx(0.5 * usual, rel=0.15)


def test_share_is_a_probability_on_a_map_no_wider_than_the_sight():
    """All stations are in sight of the leader; the drives from them have left it."""
    places, near = OpenPlaces(), STATIONS[:10]
    for k, keyframe in enumerate(keyframes := [Keyframe(0.0), Keyframe(60.0)]):
        places.look(None, near, keyframes[:k], keyframe, 1.5)
        found = places.share(ROUGH[:300], KNOWN, np.zeros(4))
    assert (found > 0.0).all()
    assert (found <= 1.0).all()
