"""A node of several maps: poses, places and guesses are in the frame of the one that they are of."""

import math
from dataclasses import replace

import numpy as np
import pytest
from fake_robot import SHA, T_MAP_ODOM, Robot, pose, search_request, search_result, unknown

from coview_stream.basemap.map_parts import MapPart, MapParts
from coview_stream.errors import InputError
from coview_stream.localization.search.acceptance import Considered
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.messages.json_messages import decode_hypotheses, encode_hypotheses
from coview_stream.messages.types import Sample
from coview_stream.stream.node.last_place import guess_of_fields
from coview_stream.stream.node.status import hypotheses, status
from coview_stream.stream.transport.transport import Connection

WEST, EAST = np.array([-5000.0, 10.0, 0.0]), np.array([40.0, 0.0, -2.0])
PARTS = MapParts([
    MapPart("west", "1" * 64, "EPSG:32632", tuple(WEST), -500.0, 50.0),
    MapPart("east", "2" * 64, None, tuple(EAST), 50.0, 900.0),
])  # fmt: skip


@pytest.fixture
def robot():
    return Robot(parts=PARTS)


def test_pose_is_in_the_frame_of_its_map_which_it_names(robot):
    robot.localized(0.0)
    robot.drive(0.05, 0.4)
    sent = robot.session.pose()
    assert sent.frame_id == "east"  # x is 100 and more
    joined = T_MAP_ODOM @ pose(0.8)
    np.testing.assert_allclose(sent.T_map_body[:3, 3], joined[:3, 3] - EAST, atol=1e-9)
    np.testing.assert_allclose(sent.T_map_body[:3, :3], joined[:3, :3], atol=1e-9)
    np.testing.assert_allclose(sent.T_map_odom[:3, 3], T_MAP_ODOM[:3, 3] - EAST, atol=1e-9)
    assert sent.map_sha256 == SHA


def test_status_says_the_map_while_a_place_is_known(robot):
    def told():
        return status(robot.session, Connection((), ()), 0, 0.0, 0.0)["map"]

    assert told() is None
    robot.localized(0.0)
    counted = robot.counters.poses
    assert told() == "east"
    assert robot.counters.poses == counted  # asking for the map is no pose
    robot.session.restart_search("asked to search again", forget=True)
    assert told() is None
    assert "map" not in status(Robot().session, Connection((), ()), 0, 0.0, 0.0)


def test_places_that_a_search_considers_are_each_on_a_map(robot):
    robot.moved(0.0)
    robot.frame(0.1, lambda job: unknown(job, ask=search_request()))
    places = np.array([[60.0, 2.0, 3.0, 0.5, 0.7, 9.0], [-20.0, 5.0, 6.0, -0.5, 0.1, 2.0]])
    result = replace(search_result(), considered=Considered(1.5, places, 0.2))
    robot.session.handle_result(robot.session.take_job("search"), result, robot.now)
    message = hypotheses(robot.session)
    assert message.maps == ("east", "west")
    np.testing.assert_allclose(message.places[:, :3], places[:, :3] - np.array([EAST, WEST]))
    again = decode_hypotheses(Sample("k", encode_hypotheses(message).payload, "application/json"))
    assert again.maps == message.maps


def test_guess_names_its_map(robot):
    assert robot.session.guess_place(PlaceGuess(1.0, 2.0, map="west"))
    assert robot.session.guess_place(PlaceGuess(1.0, 2.0, map="west", within=1e6))
    part, area = robot.session.parts.named("west"), robot.session.hints.guess.area(np.zeros(3))
    beside = np.array([[part.begin + 1.0, 2.0], [part.end - 1.0, 2.0], [part.begin - 1.0, 2.0], [part.end + 1.0, 2.0]])
    np.testing.assert_array_equal(area.holds(beside), [True, True, False, False])
    taken = robot.session.hints.guess
    assert (taken.x, taken.y, taken.map) == (1.0 + WEST[0], 2.0 + WEST[1], None)
    with pytest.raises(InputError, match="no map is named: this node has west, east"):
        robot.session.guess_place(PlaceGuess(1.0, 2.0))
    with pytest.raises(InputError, match="no map is called 'north'"):
        robot.session.guess_place(guess_of_fields({"x": "1", "y": "2", "map": "north"}))
    assert guess_of_fields({"x": 1, "y": 2, "yaw": math.pi / 2, "map": "east"}).map == "east"
    with pytest.raises(InputError, match="map is '3'"):
        guess_of_fields({"x": 1, "y": 2, "map": 3})
    assert Robot().session.guess_place(guess_of_fields({"x": 1, "y": 2, "map": "map"}))
    with pytest.raises(InputError, match="give it in 'map'"):
        Robot().session.guess_place(PlaceGuess(1.0, 2.0, map="any"))
