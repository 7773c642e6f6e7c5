"""Open places: how rare they are, among scored places and all over a map, and what another one is worth then."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_scans import CHANCE, PASSED, observation
from trackers import observed

from coview_stream.localization.evidence.background import Background
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.open_places import OpenPlaces

KNOWN = Background(CHANCE, PASSED, (0.8, 8.0), (30.0, 60.0))
ROUGH = observation(np.tile(CHANCE, (3900, 1)), passed=PASSED, ground=0.05)
CLEAR = observation(np.tile(CHANCE, (300, 1)), passed=0.0, ground=0.95)


def at(observations):
    """Stations a metre apart."""
    return np.column_stack([np.arange(len(observations)), np.zeros(len(observations))])


def share(scored, *keyframes):
    """The share by scored places, and by stations at each keyframe."""
    places = OpenPlaces()
    for stations in keyframes:
        places.add(stations, at(stations))
        found = places.share(scored, KNOWN)
    return found


def test_share_is_presumed_then_counted_over_the_keyframes():
    assert share(ROUGH[:300], ROUGH[:0]) == pytest.approx(0.01)
    assert share(ROUGH[:300], ROUGH) == pytest.approx(1 / 4000, rel=0.05)
    assert share(ROUGH[:300], ROUGH, ROUGH) == pytest.approx(1 / 7900, rel=0.05)
    assert share(ROUGH[:300], ROUGH, np.concatenate([ROUGH, CLEAR])) == pytest.approx(301 / 8200, rel=0.05)


def test_scored_places_that_are_open_count_however_rare_others_are():
    some = np.concatenate([ROUGH[:285], CLEAR[:15]])
    assert share(some, ROUGH) == pytest.approx(15 / 300, rel=0.05)


def test_stations_in_sight_of_the_leader_are_left_out():
    places = OpenPlaces()
    places.add(np.concatenate([CLEAR[:30], ROUGH[:870]]), at(ROUGH[:900]))
    assert places.share(ROUGH[:300], KNOWN) == pytest.approx(31 / 1000, rel=0.05)
    assert places.share(ROUGH[:300], KNOWN, np.zeros(4)) == pytest.approx(1 / (1000 - 36), rel=0.05)


def test_the_same_background_asked_twice_counts_stations_once():
    places = OpenPlaces()
    places.add(ROUGH, at(ROUGH))
    once = places.share(ROUGH[:300], KNOWN)
    np.testing.assert_array_equal(places.share(ROUGH[:300], KNOWN), once)
    places.clear()
    places.add(ROUGH[:0], at(ROUGH[:0]))
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


@pytest.mark.parametrize("climb", [0.0, 5.0])
def test_a_place_counts_while_all_keyframes_find_it_open(climb, world_map, world_drive):
    """A few drives stand for all that are level; of those that climb hardly any is left."""
    first = observed(world_drive.clouds[0], world_drive.T_map_body[0], voxels=False)
    T = np.array(world_drive.T_map_body[4])
    T[2, 3] += climb
    then = observed(world_drive.clouds[4], T, voxels=False)
    level = world_drive.T_map_body[0][2, 3] - world_map.stations[0, 2]
    places, background = OpenPlaces(), replace(KNOWN, ground=(4.0, 4.0))
    places.look(world_map.field, world_map.stations, [], first, level)
    once = places.share(ROUGH[:300], background).max()
    places.look(world_map.field, world_map.stations, [first], then, level)
    twice = places.share(ROUGH[:300], background).max()
    assert once > 0.5
    assert twice == pytest.approx(once, rel=0.3) if climb == 0.0 else twice < 0.1 * once, (once, twice)
