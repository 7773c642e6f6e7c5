"""A map laid side by side is as large as it should be, and every place in it has its likeness in the original."""

import numpy as np
import pytest

from bench.forest.chains import APART, chosen, of_places, of_volume
from bench.forest.scale import CUT, home, repeated, scale_table
from coview_stream.geometry.transforms import pose_from, rot_z, transform, yaw_of
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.request import SearchRequest


def query_at(xyz):
    none = np.empty((0, 3), dtype=np.float32)
    return SearchRequest(0.0, pose_from(rot_z(0.2), xyz), none, none, none, 0.0)


def test_tiles_are_repeated_in_both_directions():
    column, row = np.indices((6, 6)).reshape(2, -1)
    tiles, low = np.stack([column, row], axis=1) - 3, np.array([-2, -1])
    which, places = repeated(tiles, low, 10)
    assert len(which) == len({tuple(place) for place in places.tolist()}) == 100
    assert places.min(axis=0).tolist() == [-2, -1]
    assert places.max(axis=0).tolist() == [7, 8]
    np.testing.assert_array_equal(tiles[which] - low, (places - low) % CUT)
    with pytest.raises(ValueError, match="nothing in tile"):
        repeated(tiles, np.array([1, 1]), 10)


@pytest.mark.parametrize("copy", [(0, 0), (1, 0), (2, 3)])
def test_a_place_in_a_copy_comes_home(copy):
    query, low = query_at([10.0, -4.0, 1.0]), np.array([-2, -2])
    robot = np.array([-50.0, 30.0, 2.0])  # in the original, which begins at -64 m
    there = robot + np.array([*copy, 0]) * CUT * 32.0
    T = pose_from(rot_z(1.0), there) @ pose_from(np.eye(3), -query.position)
    back = home(Hypothesis(T, 7, 3, 0.5), query, low)
    np.testing.assert_allclose(transform(back.T_map_odom, query.position[None])[0], robot, atol=1e-9)
    assert yaw_of(back.T_map_odom) == pytest.approx(1.0)
    assert (back.station, back.shift, back.score) == (7, 3, 0.5)


def test_hypotheses_put_the_robot_on_the_chosen_stations():
    stations = np.array([[0, 0, 5], [4, 0, 6], [40, 0, 7], [0, 40, 8]], dtype=np.float32)
    volume = np.full((4, 36), 9.0, dtype=np.float32)
    volume[[0, 1, 2, 3], [3, 4, 35, 0]] = [2.0, 1.0, 3.0, 4.0]
    centre = np.array([100.0, 50.0, -1.0])
    found = of_volume(volume, stations, centre)
    assert [each.station for each in found] == [1, 2, 3]  # station 0 is too near
    for each in found:
        at = transform(each.T_map_odom, centre[None])[0]
        np.testing.assert_allclose(at, stations[each.station], atol=1e-5)
    assert np.degrees(yaw_of(found[0].T_map_odom)) == pytest.approx(-40.0)
    assert np.degrees(yaw_of(found[1].T_map_odom)) == pytest.approx(10.0)


def test_places_stand_on_the_ground_of_the_station_next_to_them():
    stations = np.array([[0, 0, 5], [40, 0, 7]], dtype=np.float32)
    xy, score = np.array([[1.0, 1.0], [39.0, 1.0], [39.0, 2.0]]), np.array([0.3, 0.8, 0.9])
    centre = np.array([3.0, 0.0, -2.0])
    found = of_places(xy, score, np.array([0.1, 0.2, 0.3]), stations, centre)
    np.testing.assert_allclose(transform(found[0].T_map_odom, centre[None])[0], [39.0, 2.0, 7.0])
    np.testing.assert_allclose(transform(found[1].T_map_odom, centre[None])[0], [1.0, 1.0, 5.0])
    assert [yaw_of(each.T_map_odom) for each in found] == pytest.approx([0.3, 0.1])


def test_chosen_places_are_apart():
    xy = np.array([[0.0, 0.0], [APART - 0.1, 0.0], [APART, 0.0]])
    assert chosen(xy, np.array([3.0, 2.0, 1.0])) == [0, 2]
    assert chosen(xy, np.full(3, -np.inf)) == []


def test_the_table_has_every_part():
    row = {
        "km2": 0.1024, "stations": 9, "prepare": 1.0, "total": 0.3, "limit": 0.4, "threads": "two", "view": 0.1,
        "correlation": 0.05, "consensus": 0.01, "sharpening": 0.04, "registration": 0.1,
    }  # fmt: skip
    lines = scale_table([row]).splitlines()
    assert [cell.strip() for cell in lines[2].strip("|").split("|")] == [
        "0.10", "9", "1.00", "0.100", "0.050", "0.010", "0.040", "0.100", "0.30", "0.4",
    ]  # fmt: skip
    assert lines[-1].startswith("two; ")
