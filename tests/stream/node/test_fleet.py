"""Fleets: who serves a robot, which robots move when nodes come and go, and how a place is handed on."""

import json
import time

import numpy as np
import pytest
from fake_node import Site
from fake_robot import SHA, T_MAP_ODOM, Robot, pose

from coview_stream.errors import TransportError
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.messages.types import Sample
from coview_stream.stream.node.fleet import Fleet, FleetMembers, owner
from coview_stream.stream.node.health import NodeHealth
from coview_stream.stream.node.last_place import LastPlace
from coview_stream.stream.transport.keys import NodeIdentity
from coview_stream.stream.transport.memory_transport import MemoryTransport

NODES = [f"node{k}" for k in range(5)]
ROBOTS = [f"r{k}" for k in range(1000)]
PREFIX = "coview/fleet/f"


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
    assert members.look(["a", "b"], "b")
    assert not members.look(["a"])
    assert members.alive == {"a", "b"}
    assert members.look(["a"])
    assert members.alive == {"a"}
    members.look(["a", "b"], "b")
    for _ in range(5):
        assert not members.look([], "b")  # cut off
        assert not members.look(["b"], "b")
    assert members.alive == {"a", "b"}
    assert not members.look(["a"])
    assert not members.look(["a", "b"], "b")  # it was slow
    assert not members.look(["a"])


def test_token_without_messages_counts_for_nothing():
    members = FleetMembers("a")
    assert not members.look(["a", "ghost"])
    assert not members.settled  # it may be a node that serves robots: it has the time to say so
    for _ in range(100):
        assert not members.look(["a", "ghost"])
    assert members.settled
    members.look(["a", "b"], ["b", "stranger"])
    assert members.alive == {"a", "b"}
    looks = [members.look(["a", "b"]) for _ in range(100)]
    assert looks.index(True) in range(25, 35)  # three seconds after its last message
    assert members.alive == {"a"}


class Member(Site):
    """A node of a fleet on a network that all its nodes are on."""

    def __init__(self, net, name, robots):
        super().__init__(*robots, net=net, shared=True)
        self.node.reporter.identity = NodeIdentity(name)
        self.node.declare()
        self.ready = True
        self.fleet = Fleet(PREFIX, name, self.node.endpoints, net, ready=lambda: self.ready)

    @staticmethod
    def look(*nodes):
        """All nodes of a fleet tell and look, in turns, until each has heard the others."""
        for _ in range(3):
            Member.tell(*nodes)
            for node in nodes:
                node.fleet.look()

    @staticmethod
    def tell(*nodes):
        for node in nodes:
            node.fleet.tell()
            node.node.reporter.publish(time.monotonic())

    @property
    def serves(self):
        return {name for name, robot in self.node.endpoints.items() if robot.serving}


def test_each_robot_is_served_by_one_node_and_moves_with_its_place():
    net, robots = MemoryTransport(), ROBOTS[:20]
    nodes = {name: Member(net, name, robots) for name in ("a", "b")}
    for node in nodes.values():
        node.node.reporter.publish(time.monotonic())
    assert net.samples("coview/r1/out/status") == []  # nobody serves anybody yet
    Member.look(*nodes.values())
    a, b = nodes["a"], nodes["b"]
    assert a.serves | b.serves == set(robots)
    assert not a.serves & b.serves
    assert a.serves
    assert b.serves
    for robot in robots:
        ids = {json.loads(sample.payload)["node"]["id"] for sample in net.samples(f"coview/{robot}/out/status")}
        assert ids == {"a" if robot in a.serves else "b"}

    mover = min(b.serves)
    net.publish(Sample(f"{PREFIX}/places/b", b"\xff{", "application/json"))
    told = {mover: LastPlace(SHA, T_map_odom=T_MAP_ODOM @ pose(3.0)).to_message(), "stranger": 3}
    net.publish(Sample(f"{PREFIX}/places/b", json.dumps(told).encode(), "application/json"))
    net.withdraw(f"{PREFIX}/nodes/b")
    a.fleet.look()
    assert mover not in a.serves
    a.fleet.look()
    assert a.serves == set(robots)
    a.sees(mover, 1.0)
    a.fleet.look()  # its odometry has come
    hint = a.sessions[mover].take_job("track").hint
    np.testing.assert_allclose(hint, T_MAP_ODOM @ pose(3.0) @ pose(2.0), atol=1e-9)


@pytest.mark.parametrize("talk", [False, True])
def test_ghosts_take_no_robot_and_leave_none_unserved(talk):
    net, robots = MemoryTransport(), ROBOTS[:8]
    nodes = [Member(net, name, robots) for name in ("a", "b", "c")]
    a, b, _ = nodes
    Member.look(*nodes)
    held = []

    def passes(seconds, *nodes):
        for at in range(round(10 * seconds)):
            if at % 10 == 0:
                Member.tell(*nodes)
                held.append(f"ghost{len(held)}")  # one that nobody has missed yet
                net.announce(f"{PREFIX}/nodes/{held[-1]}")
                told = json.dumps({"r1": LastPlace(SHA, T_map_odom=T_MAP_ODOM).to_message()})
                for ghost in held if talk else ():
                    net.publish(Sample(f"{PREFIX}/places/{ghost}", told.encode(), "application/json"))
            for node in nodes:
                node.fleet.look()

    passes(8.0, *nodes)
    assert NodeHealth(a.node, fleet=a.fleet).ready_reasons() == []
    assert sorted(robot for node in nodes for robot in node.serves) == sorted(robots)
    net.withdraw(f"{PREFIX}/nodes/c")
    passes(2.0, a, b)
    reasons = NodeHealth(a.node, fleet=a.fleet).ready_reasons()  # a ghost should serve them
    assert [reason.startswith("no node of the fleet serves r") for reason in reasons] == [True] * talk
    passes(2.0, a, b)
    assert not a.fleet.unserved
    assert sorted([*a.serves, *b.serves]) == sorted(robots)
    late = Member(net, "d", robots)
    passes(5.0, a, b, late)  # it does not wait for ghosts for ever
    assert late.serves or talk  # ghosts rank first for all
    assert sorted([*a.serves, *b.serves, *late.serves]) == sorted(robots)


def test_node_without_engines_gives_its_robots_up_while_there_are_others():
    net, robots = MemoryTransport(), ROBOTS[:20]
    a, b = (Member(net, name, robots) for name in ("a", "b"))
    Member.look(a, b)
    before = a.serves
    assert before
    assert b.serves == set(robots) - before
    a.ready = False

    def looks(number):
        for k in range(number):
            if k % 10 == 0:
                Member.tell(a, b)
            for node in (a, b):
                node.fleet.look()

    looks(60)
    assert a.serves == before  # its engines may be starting again
    looks(60)
    assert (a.serves, b.serves) == (set(), set(robots))
    net.withdraw(f"{PREFIX}/nodes/b")
    looks(5)
    assert a.serves == set(robots)  # nobody else would
    net.announce(f"{PREFIX}/nodes/b")
    a.ready = True
    looks(20)
    assert a.serves == before


def test_node_that_comes_takes_its_robots_with_their_places():
    net, robots = MemoryTransport(), ROBOTS[:4]
    first = Member(net, "a", robots)
    first.fleet.look()
    assert first.serves == set(robots)
    for name in robots:
        first.frame(name, 0.0)
    second = Member(net, "b", robots)
    first.fleet.tell()
    Member.look(first, second)
    assert second.serves
    assert first.serves == set(robots) - second.serves
    for name in second.serves:
        assert first.poses(name) == []  # given up and forgotten
        second.moves(name, 1.0)
        second.fleet.look()
        second.sees(name, 1.1)
        np.testing.assert_allclose(second.sessions[name].take_job("track").hint, T_MAP_ODOM @ pose(2.0), atol=1e-9)
        assert second.poses(name) == []  # nothing is believed before it is verified


def test_message_of_a_place_is_read_as_it_was_written():
    giver, taker = Robot(), Robot()
    assert giver.session.last_place() is None
    giver.localized(0.0)
    place = giver.session.last_place()
    np.testing.assert_allclose(place.T_map_odom, T_MAP_ODOM)
    again = LastPlace.from_message(json.loads(json.dumps(place.to_message())))
    np.testing.assert_allclose(again.T_map_odom, place.T_map_odom)
    assert (again.map_sha256, again.calibration) == (place.map_sha256, place.calibration)

    assert not taker.session.offer(again)  # no odometry yet
    taker.moved(1.0, x=2.0)
    assert taker.session.offer(again)
    giver.session.reset(forget=False)
    assert giver.session.last_place() is None
    giver.moved(5.0)
    assert giver.session.offer(again)  # it may come back
    twice = (2 * np.eye(4)).tolist()
    for broken in ({}, {"T_map_odom": [1], "map_sha256": SHA}, {"T_map_odom": twice, "map_sha256": SHA}):
        with pytest.raises((ValueError, KeyError)):
            LastPlace.from_message(broken)


def test_only_the_node_that_serves_a_robot_acts_on_its_queries_and_guesses():
    net, robots = MemoryTransport(), ROBOTS[:4]
    nodes = {name: Member(net, name, robots) for name in ("a", "b")}
    Member.look(*nodes.values())
    assert all(node.serves for node in nodes.values())

    def guesses(robot):
        return {name: guess.x for name, node in nodes.items() if (guess := node.sessions[robot].hints.guess)}

    for robot in robots:
        server = owner(robot, nodes)
        assert net.query(f"coview/{robot}/rpc/suggest", {"x": "1", "y": "2"})["taken"]
        assert guesses(robot) == {server: 1.0}
        net.publish(Sample(f"coview/{robot}/in/initial_pose", b'{"x": 3.0, "y": 4.0}'))
        assert guesses(robot) == {server: 3.0}
        for name in ("relocalize", "reset"):
            for node in nodes.values():
                node.sessions[robot].guess_place(PlaceGuess(5.0, 6.0))
            assert net.query(f"coview/{robot}/rpc/{name}")["ok"]
            assert guesses(robot) == {name: 5.0 for name in nodes if name != server}
            for node in nodes.values():
                node.sessions[robot].reset()
    for robot in nodes["a"].serves:
        nodes["a"].node.endpoints[robot].end_serving()
        with pytest.raises(TransportError, match="no answer"):
            net.query(f"coview/{robot}/rpc/reset")
