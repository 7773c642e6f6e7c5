"""Fleets: who serves a robot, what moves when nodes come and go, and how a robot is handed on."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fake_robot import SHA, T_MAP_ODOM, Robot, pose

from coview_stream.messages.types import Sample
from coview_stream.stream.node.fleet import FleetMembers, FleetShares, owner
from coview_stream.stream.node.fleet_member import FleetMember
from coview_stream.stream.node.handover import Handover
from coview_stream.stream.transport.memory_transport import MemoryTransport

NODES = [f"node{k}" for k in range(5)]
ROBOTS = [f"r{k}" for k in range(1000)]


def test_robots_are_shared_evenly_and_only_those_of_a_node_that_goes_move():
    before = {robot: owner(robot, NODES) for robot in ROBOTS}
    counts = [list(before.values()).count(node) for node in NODES]
    assert min(counts) > 150  # 200 each, with a deviation of 13
    after = {robot: owner(robot, NODES[:-1]) for robot in ROBOTS}
    moved = {robot for robot in ROBOTS if after[robot] != before[robot]}
    assert moved == {robot for robot in ROBOTS if before[robot] == NODES[-1]}
    gained = [sum(after[robot] == node for robot in moved) for node in NODES[:-1]]
    assert min(gained) > 0.15 * len(moved)  # to all others alike
    assert owner("r1", []) is None
    assert {owner(r, reversed(NODES)) == before[r] for r in ROBOTS} == {True}


def test_node_is_gone_after_two_looks_and_a_look_without_oneself_tells_nothing():
    members = FleetMembers("a")
    assert members.look(["a", "b"])
    assert not members.look(["a"])
    assert members.alive == {"a", "b"}
    assert members.look(["a"])
    assert members.alive == {"a"}
    members.look(["a", "b"])
    for _ in range(5):
        assert not members.look([])  # cut off
        assert not members.look(["b"])
    assert members.alive == {"a", "b"}
    assert not members.look(["a"])
    assert not members.look(["a", "b"])  # it was slow
    assert not members.look(["a"])


class Endpoints:
    """What a member does to a robot's endpoints."""

    def __init__(self, name):
        self.session = Robot().session
        self.name = name
        self.listening = False

    def listen(self):
        self.listening = True

    def stop_listening(self):
        self.listening = False


@pytest.fixture
def net():
    return MemoryTransport()


def test_each_robot_is_listened_to_by_one_node_and_moves_with_its_place(net):
    nodes = {}
    for name in ("a", "b"):
        robots = {robot: Endpoints(robot) for robot in ROBOTS[:20]}
        shares = FleetShares("f", [], "coview", 1.0, name)
        shares._robots = list(robots)
        shares._owners = dict.fromkeys(robots)
        shares.declare(net)
        nodes[name] = robots, FleetMember(shares, robots, net)
    for _ in range(3):
        for _, each in nodes.values():
            each.look()
    of = {robot: [name for name, (robots, _) in nodes.items() if robots[robot].listening] for robot in ROBOTS[:20]}
    assert {len(names) for names in of.values()} == {1}
    assert {names[0] for names in of.values()} == {"a", "b"}

    mover = next(robot for robot, names in of.items() if names == ["b"])
    T = T_MAP_ODOM @ pose(3.0)
    told = {mover: Handover(SHA, T).to_json(), "stranger": 3}
    net.publish(Sample("coview/fleet/f/places/b", json.dumps(told).encode(), "application/json"))
    net.publish(Sample("coview/fleet/f/places/b", b"\xff{", "application/json"))
    net._tokens.remove("coview/fleet/f/nodes/b")
    robots, survivor = nodes["a"]
    survivor.look()
    assert not robots[mover].listening
    survivor.look()
    assert all(each.listening for each in robots.values())
    assert survivor._arriving[mover].T_map_odom.tolist() == T.tolist()
    survivor.look()  # no odometry yet
    assert mover in survivor._arriving


def test_place_that_is_handed_on_is_a_hypothesis_for_the_next_frame():
    giver, taker = Robot(), Robot()
    assert giver.session.handover() is None
    giver.localized(0.0)
    place = giver.session.handover()
    np.testing.assert_allclose(place.T_map_odom, T_MAP_ODOM)
    again = Handover.from_json(json.loads(json.dumps(place.to_json())))
    np.testing.assert_allclose(again.T_map_odom, place.T_map_odom)
    assert (again.map_sha256, again.calibration) == (place.map_sha256, place.calibration)

    assert not taker.session.take_over(again)  # nothing has come yet
    taker.moved(1.0, x=2.0)
    assert taker.session.take_over(again)
    np.testing.assert_allclose(taker.session._hint.pending, T_MAP_ODOM @ taker.session.odometry.newest.T_odom_body)
    assert taker.session.pose() is None  # nothing is believed before it is verified
    giver.session.give_up()
    assert giver.session.handover() is None
    assert giver.session.pose() is None
    giver.moved(5.0)
    assert giver.session.take_over(again)  # it may come back
    twice = (2 * np.eye(4)).tolist()
    for broken in ({}, {"T_map_odom": [1], "map_sha256": SHA}, {"T_map_odom": twice, "map_sha256": SHA}):
        with pytest.raises((ValueError, KeyError)):
            Handover.from_json(broken)
