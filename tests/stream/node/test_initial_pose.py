"""Guesses of a robot's place from the network: bounded, checked, handed to the engine once, and told where refused."""

import math

import numpy as np
import pytest
from fake_node import declared
from fake_robot import KEYS, Robot, unknown
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream.errors import InputError, TransportError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.stream.client.client import RobotClient
from coview_stream.stream.node.last_place import decode_guess, guess_of_fields


def sample(payload):
    return Sample(KEYS.initial_pose, payload)


def test_json_and_parameters_name_a_place():
    assert decode_guess(sample(b'{"x": 1.5, "y": -2, "yaw": null}')) == PlaceGuess(1.5, -2.0)
    assert guess_of_fields({"x": "1.5", "y": "-2", "yaw": "0.5", "distance": "3"}) == PlaceGuess(1.5, -2.0, 0.5, 3.0)
    assert decode_guess(sample(b'{"x": 1.5, "y": -2, "map": ""}')) == PlaceGuess(1.5, -2.0)
    assert decode_guess(sample(b'{"x": 1, "y": 2, "within": 800}')) == PlaceGuess(1.0, 2.0, within=800.0)
    assert guess_of_fields({"x": 1, "y": 2, "within": None}) == PlaceGuess(1.0, 2.0)


def test_pose_of_rviz_names_a_place_and_how_far_it_may_be_off():
    T = pose_from(rot_z(0.7), [412_000.5, 5_318_000.25, 0.0])
    covariance = np.diag([4.0, 4.0, 0, 0, 0, 0.04])
    message = encode_pose(PoseMessage(5, "r1", "TRACKING", T, covariance, 0.9, "", 0.0), "cdr")
    guess = decode_guess(sample(message.payload))
    assert (guess.x, guess.y, guess.yaw) == pytest.approx((412_000.5, 5_318_000.25, 0.7))
    assert guess.distance == pytest.approx(4.0)
    assert guess.angle == pytest.approx(0.4)


@pytest.mark.parametrize(
    "payload",
    [
        b"", b"{", b"[]", b"{}", b'{"x": 1}',
        b'{"x": 1, "y": "no"}', b'{"x": 1, "y": 2, "z": 3}', b'{"x": true, "y": 2}',
        b'{"x": NaN, "y": 2}', b'{"x": 1e12, "y": 2}', b'{"x": 1, "y": 2, "distance": 500}',
        b'{"x": 1, "y": 2, "within": 3}', b"{" * 3000, b"{" * 5000,
        b"\0\1\0\0" + b"\xff" * 300,
    ],
)  # fmt: skip
def test_what_names_no_place_is_refused(payload):
    with pytest.raises(InputError):
        decode_guess(sample(payload))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes_are_a_place_or_an_input_error(payload):
    for start in (b"", b"{", b"\0\1\0\0"):
        try:
            decode_guess(sample(start + payload))
        except InputError:
            continue


def test_guess_that_comes_while_the_place_is_known_is_not_taken():
    robot = Robot().localized(0.0)
    assert not robot.session.guess_place(PlaceGuess(1.0, 2.0))


def test_questions_and_messages_reach_the_session(pair):
    reply = pair.net.query("coview/r1/rpc/suggest", {"x": "1.0", "y": "2.0"})
    assert (reply["ok"], reply["taken"]) == (True, True)
    with pytest.raises(TransportError):
        pair.net.query("coview/r1/rpc/suggest", {"x": "1.0"})
    session = pair.sessions["r1"]
    pair.net.publish(sample(b'{"x": 5.0}'))
    assert any("initial poses of no use" in text for text in session.errors.texts)


def test_guess_where_the_map_has_no_ground_is_refused_with_a_note(world_map):
    net = declared("r1", session={"base_map": world_map}).net
    client = RobotClient("r1", transport=net)
    x, y = world_map.origin[:2]
    for within in (60.0, None):
        reply = client.suggest(x + 5000.0, y, within=within)
        assert not reply["taken"]
        assert f"the map has no ground within {within or 5:g} m" in reply["note"]
    assert (client.suggest(x, y, within=60.0)["taken"], net.raised) == (True, [])
    for wrong in ({"x": math.nan}, {"within": 5}, {"distance": 50}, {"yaw": "north"}, {"map": 3}):
        with pytest.raises(InputError, match="initial pose"):
            client.suggest(**{"x": 0.0, "y": 0.0, **wrong})
    assert net.raised == []


def test_guess_is_told_again_to_an_engine_that_begins_anew():
    robot, guess = Robot(), PlaceGuess(1.0, 2.0, within=300.0)
    assert robot.session.guess_place(guess)
    assert robot.frame(0.0, unknown).guess is guess
    robot.session.restart_search("odometry jumped")
    assert robot.frame(0.1, unknown).guess == PlaceGuess(1.0, 2.0)  # how far it is from the circle is not known
    assert robot.frame(0.2, unknown).guess is None
    robot.session.restart_search("asked to search again", forget=True)
    assert robot.frame(0.3, unknown).guess is None


def test_guess_that_waits_is_forgotten_by_a_node_that_gives_the_robot_up(robot):
    assert robot.session.guess_place(PlaceGuess(1.0, 2.0, within=300.0))
    robot.session.reset(forget=False)
    assert robot.frame(0.0, unknown).guess is None
