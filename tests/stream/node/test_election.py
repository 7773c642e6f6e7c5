"""Which of several nodes serves a robot: as a pure rule, and by the statuses on a network."""

from __future__ import annotations

import json
import logging
import random
from dataclasses import replace

import pytest
from fake_node import Site

from coview_stream.messages.types import Encoded
from coview_stream.stream.node.election import Claim, Election, Elections, claim_in
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport


class Network:
    """Nodes that hear each other once a second, unless they are apart or stopped."""

    def __init__(self, *names):
        self.now = 0.0
        self.nodes = {name: Election(name, 1.0, 0.0) for name in names}
        self.parts = [set(names)]
        self.stopped = set()
        self.deaf = set()  # those that do not hear the robot
        self.history = []

    def start(self, name):
        self.nodes[name] = Election(name, 1.0, self.now)
        self.parts[0].add(name)

    def run(self, seconds):
        for _ in range(round(4 * seconds)):
            self.now += 0.25
            running = {name: node for name, node in self.nodes.items() if name not in self.stopped}
            for name in running.keys() - self.deaf:
                self.nodes[name].hear_robot(self.now)
            claims = {name: node.tick(self.now) for name, node in running.items()}
            self.history.append({name for name, claim in claims.items() if claim})
            if self.now % 1.0 == 0.0:
                for name, claim in claims.items():
                    for other, node in running.items():
                        if claim and any({name, other} <= part for part in self.parts):
                            node.hear(claim, self.now)

    @property
    def serving(self):
        return self.history[-1]


def test_one_node_serves_after_it_has_listened():
    net = Network("a")
    net.run(3.75)
    assert net.serving == set()
    net.run(0.5)
    assert net.serving == {"a"}
    net.run(60.0)
    assert net.nodes["a"].claim.term == 1


def test_first_keeps_and_second_takes_over_and_first_does_not_take_back():
    net = Network("b")
    net.run(6.0)
    net.start("a")
    net.run(20.0)
    assert net.serving == {"b"}
    assert all(served == {"b"} for served in net.history[20:])
    del net.nodes["b"]
    net.run(5.25)
    assert net.serving == {"a"}
    net.start("b")
    net.run(20.0)
    assert net.serving == {"a"}


def test_two_that_start_at_once_are_one_within_a_second():
    net = Network("b", "a", "c")
    net.run(6.0)
    assert net.serving == {"a"}
    assert sum(len(served) > 1 for served in net.history) <= 4
    net.run(30.0)
    assert net.serving == {"a"}


def test_network_that_was_in_two_parts_has_one_again():
    net = Network("a", "b")
    net.run(5.0)
    assert net.serving == {"a"}
    net.parts = [{"a"}, {"b"}]
    net.run(7.0)
    assert net.serving == {"a", "b"}
    net.parts = [{"a", "b"}]
    net.run(1.25)
    assert net.serving == {"b"}  # of the later term
    net.run(30.0)
    assert net.serving == {"b"}


def test_node_that_is_cut_off_from_the_robot_too_does_not_take_over():
    net = Network("a", "b")
    net.run(7.0)
    net.parts, net.deaf = [{"a"}, {"b"}], {"b"}
    net.run(60.0)
    assert net.serving == {"a"}
    net.parts, net.deaf = [{"a", "b"}], set()
    since = len(net.history)
    net.run(20.0)
    assert all(served == {"a"} for served in net.history[since:])


def test_robot_that_comes_back_after_its_node_died_is_served():
    net = Network("a", "b")
    net.run(7.0)
    net.stopped, net.deaf = {"a"}, {"b"}
    net.run(20.0)
    assert net.serving == set()
    net.deaf = set()
    net.run(4.5)
    assert net.serving == {"b"}


def test_node_that_was_stopped_finds_that_it_has_been_replaced():
    net = Network("a", "b")
    net.run(5.0)
    net.stopped = {"a"}
    net.run(10.0)
    assert net.serving == {"b"}
    net.stopped, since = set(), len(net.history)
    net.run(6.0)
    assert all(served == {"b"} for served in net.history[since:])  # it listens before it says anything


def test_stopped_node_without_another_goes_on_after_it_has_listened():
    node = Election("a", 1.0, 0.0)
    assert node.tick(4.5) == Claim(1, "a")
    assert node.tick(8.4) == Claim(1, "a")
    assert node.tick(12.5) is None
    assert [node.tick(12.5 + k / 2) for k in (2, 4, 6)] == [None, None, None]
    assert node.tick(16.5) == Claim(2, "a")


@pytest.mark.parametrize("seed", range(40))
def test_after_any_faults_one_node_serves_within_six_seconds_and_stays_the_only_one(seed):
    rng = random.Random(seed)
    names = ["a", "b", "c", "d"][: rng.randint(2, 4)]
    net = Network(*names)
    for _ in range(8):
        net.run(rng.choice([0.25, 1.0, 2.75, 6.0]))
        split = set(rng.sample(names, rng.randint(0, len(names) - 1)))
        net.parts = [split, set(names) - split]
        net.stopped = {name for name in names if rng.random() < 0.3}
        net.deaf = {name for name in names if rng.random() < 0.3}
        if rng.random() < 0.3:
            net.start(name := rng.choice(names))  # it was killed
            net.parts[0].discard(name)
            net.parts[1].add(name)
    net.parts, net.stopped, net.deaf = [set(names)], set(), set()
    net.run(6.0)
    since = len(net.history)
    net.run(20.0)
    assert len(net.serving) == 1
    assert all(served == net.serving for served in net.history[since:])


def test_node_that_says_that_it_ends_is_followed_at_once():
    standing = Election("b", 1.0, 0.0)
    standing.hear(Claim(3, "a"), 1.0)
    assert standing.tick(3.4) is None
    standing.hear(replace(Claim(3, "a"), ending=True), 3.4)
    assert standing.tick(3.4) == Claim(4, "b")


def test_lower_node_that_ends_is_not_the_one_that_is_waited_for():
    standing = Election("c", 1.0, 0.0)
    standing.hear(Claim(5, "a"), 1.0)
    standing.hear(Claim(3, "b"), 1.5)
    standing.hear(replace(Claim(3, "b"), ending=True), 2.0)
    assert standing.tick(2.0) is None
    assert standing.other == Claim(5, "a")
    standing.hear_robot(4.9)
    assert standing.tick(4.9) is None
    assert standing.tick(5.1) == Claim(6, "c")


def test_node_of_slow_statuses_listens_as_long_as_they_take():
    node = Election("a", 10.0, 0.0)
    assert node.tick(39.0) is None
    assert node.tick(41.0) == Claim(1, "a", 10.0)


def test_slow_statuses_are_waited_for():
    standing = Election("b", 1.0, 0.0)
    standing.hear(Claim(1, "a", period=10.0), 1.0)
    standing.hear_robot(40.0)
    assert standing.tick(40.9) is None
    assert standing.tick(41.1) == Claim(2, "b")


def test_own_statuses_are_not_another_nodes():
    node = Election("a", 1.0, 0.0)
    assert node.tick(4.5) == Claim(1, "a")
    node.hear(Claim(7, "a"), 4.5)
    assert node.tick(4.6) == Claim(1, "a")


@pytest.mark.parametrize(
    "status",
    [
        b"", b"{", b"[]", b"7", b"null", b'{"node": 3}', b"[" * 100_000, b" " * 70_000,
        *(
            json.dumps({"node": {"id": "a", "term": 1, "period_s": 1.0, "ending": False} | wrong}).encode()
            for wrong in (
                {"term": -1}, {"term": 1.5}, {"term": True}, {"term": 10**30}, {"id": ""}, {"id": 4}, {"id": "x" * 65},
                {"period_s": 0}, {"period_s": -1.0}, {"period_s": 1e9}, {"period_s": float("nan")}, {"period_s": None},
                {"ending": 1}, {"id": "a\nb"}, {"host": "\x1b[2J"}, {"host": 3}, {"host": "x" * 65},
            )
        ),
    ],
)  # fmt: skip
def test_what_is_no_status_of_a_node_is_no_claim(status):
    assert claim_in(status) is None


def test_claim_is_read_as_it_was_written():
    claim = Claim(4, "abc", 0.5, True, "machine-7")
    assert claim_in(json.dumps({"state": "LOST", "node": claim.to_json()}).encode()) == claim


def test_status_of_another_node_silences_this_one_for_its_robot_only(caplog):
    net, now = MemoryTransport(), [0.0]
    keys = [robot_keys("native", "coview", name) for name in ("r1", "r2")]
    elections = Elections(keys, 1.0, lambda: now[0])
    elections.declare(net)

    def pass_time(until):
        while now[0] < until:
            now[0] += 0.5
            elections.hear_robot("r1")
            elections.claim("r1"), elections.claim("r2")

    assert (elections.claim("r1"), elections.served_by("r1")) == (None, None)
    pass_time(4.5)
    assert elections.claim("r1").term == elections.claim("r2").term == 1
    status = json.dumps({"node": Claim(2, "other").to_json()}).encode()
    net.publisher(keys[0].status, "report").put(Encoded(status, "application/json"))
    assert elections.claim("r1") is None
    assert elections.served_by("r1") == "other"
    assert elections.claim("r2") is not None
    pass_time(9.0)
    assert elections.claim("r1").term == 3
    assert elections.served_by("r1") == elections.node
    said = [record.getMessage() for record in caplog.records]
    assert said == [
        "r1: node other serves it: standing by, to take over when that one is gone",
        "r1: node other is gone: serving it now",
    ]


def test_nobody_takes_over_by_what_is_not_heard_while_the_network_is_away():
    net, now = MemoryTransport(), [0.0]
    keys = [robot_keys("native", "coview", "r1")]
    elections = Elections(keys, 1.0, lambda: now[0], needs_connection=True)
    elections.declare(net)
    net.go_away()

    def pass_time(until):
        while now[0] < until:
            now[0] += 0.5
            elections.claim("r1")

    pass_time(20.0)
    assert elections.claim("r1") is None
    net.come_back()
    pass_time(21.5)
    assert elections.claim("r1") is None  # there was no time yet to hear anybody
    pass_time(25.0)
    assert elections.claim("r1").term == 1
    net.go_away()
    pass_time(30.0)
    assert elections.claim("r1").term == 1  # who serves goes on to


def test_status_goes_out_at_once_when_a_node_takes_over_and_when_a_lower_one_is_heard():
    site, now = Site("r1"), [0.0]
    keys = [session.keys for session in site.node.sessions]
    elections = Elections(keys, 1.0, lambda: now[0])
    elections.declare(site.net)
    reporter = Reporter(site.node.sessions, site.net, RateLimitedErrors(logging.getLogger(__name__)), elections)
    reporter.declare(site.node.sessions[0])

    def statuses():
        return [json.loads(sample.payload) for sample in site.net.samples(keys[0].status)]

    reporter.publish(0.0)
    reporter.report_change(site.node.sessions[0])
    assert (statuses(), reporter.changed.is_set()) == ([], False)
    for now[0] in (2.5, 4.0):
        reporter.report_change(site.node.sessions[0])
    assert reporter.changed.is_set()
    reporter.changed.clear()
    reporter.publish(0.0, all_robots=False)
    assert [status["node"]["id"] for status in statuses()] == [elections.node]
    reporter.report_change(site.node.sessions[0])
    assert not reporter.changed.is_set()
    lower = json.dumps({"node": Claim(0, "other").to_json()}).encode()
    site.net.publisher(keys[0].status, "report").put(Encoded(lower, "application/json"))
    reporter.report_change(site.node.sessions[0])
    assert reporter.changed.is_set()
    reporter.publish(0.0, all_robots=False)
    assert [status["node"]["id"] for status in statuses()] == [elections.node, "other", elections.node]
