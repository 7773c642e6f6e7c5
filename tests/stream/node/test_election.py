"""Which of several nodes serves a robot: as a pure rule, and by the statuses on a network."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from coview_stream.messages.types import Encoded
from coview_stream.stream.node.election import Claim, Election, Elections, claim_in
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport


class Network:
    """Nodes that hear each other once a second, unless they are apart or stopped."""

    def __init__(self, *names):
        self.now = 0.0
        self.nodes = {name: Election(name, 1.0, 0.0) for name in names}
        self.parts = [set(names)]
        self.stopped = set()
        self.history = []

    def start(self, name):
        self.nodes[name] = Election(name, 1.0, self.now)
        self.parts[0].add(name)

    def run(self, seconds):
        for _ in range(round(4 * seconds)):
            self.now += 0.25
            running = {name: node for name, node in self.nodes.items() if name not in self.stopped}
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
    net.run(2.25)
    assert net.serving == set()
    net.run(0.5)
    assert net.serving == {"a"}
    net.run(60.0)
    assert net.nodes["a"].claim.term == 1


def test_first_keeps_and_second_takes_over_and_first_does_not_take_back():
    net = Network("b")
    net.run(4.0)
    net.start("a")
    net.run(20.0)
    assert net.serving == {"b"}
    assert all(served == {"b"} for served in net.history[12:])
    del net.nodes["b"]
    net.run(3.5)
    assert net.serving == {"a"}
    net.start("b")
    net.run(20.0)
    assert net.serving == {"a"}


def test_two_that_start_at_once_are_one_within_a_second():
    net = Network("b", "a", "c")
    net.run(4.0)
    assert net.serving == {"a"}
    assert sum(len(served) > 1 for served in net.history) <= 4
    net.run(30.0)
    assert net.serving == {"a"}


def test_network_that_was_in_two_parts_has_one_again():
    net = Network("a", "b")
    net.run(5.0)
    assert net.serving == {"a"}
    net.parts = [{"a"}, {"b"}]
    net.run(5.0)
    assert net.serving == {"a", "b"}
    net.parts = [{"a", "b"}]
    net.run(1.25)
    assert net.serving == {"b"}  # of the later term
    net.run(30.0)
    assert net.serving == {"b"}


def test_node_that_was_stopped_finds_that_it_has_been_replaced():
    net = Network("a", "b")
    net.run(5.0)
    net.stopped = {"a"}
    net.run(10.0)
    assert net.serving == {"b"}
    net.stopped = set()
    net.run(1.25)
    assert net.serving == {"b"}


def test_node_that_says_that_it_ends_is_followed_at_once():
    standing = Election("b", 1.0, 0.0)
    standing.hear(Claim(3, "a"), 1.0)
    assert standing.tick(3.4) is None
    standing.hear(replace(Claim(3, "a"), ending=True), 3.4)
    assert standing.tick(3.4) == Claim(4, "b")


def test_slow_statuses_are_waited_for():
    standing = Election("b", 1.0, 0.0)
    standing.hear(Claim(1, "a", period=10.0), 1.0)
    assert standing.tick(25.9) is None
    assert standing.tick(26.1) == Claim(2, "b")


def test_own_statuses_are_not_another_nodes():
    node = Election("a", 1.0, 0.0)
    assert node.tick(3.0) == Claim(1, "a")
    node.hear(Claim(7, "a"), 3.0)
    assert node.tick(3.1) == Claim(1, "a")


@pytest.mark.parametrize(
    "status",
    [
        b"", b"{", b"[]", b"7", b"null", b'{"node": 3}', b"[" * 100_000, b" " * 70_000,
        *(
            json.dumps({"node": {"id": "a", "term": 1, "period_s": 1.0, "ending": False} | wrong}).encode()
            for wrong in (
                {"term": -1}, {"term": 1.5}, {"term": True}, {"term": 10**30}, {"id": ""}, {"id": 4}, {"id": "x" * 65},
                {"period_s": 0}, {"period_s": -1.0}, {"period_s": 1e9}, {"period_s": float("nan")}, {"period_s": None},
                {"ending": 1},
            )
        ),
    ],
)  # fmt: skip
def test_what_is_no_status_of_a_node_is_no_claim(status):
    assert claim_in(status) is None


def test_claim_is_read_as_it_was_written():
    claim = Claim(4, "abc", 0.5, True)
    assert claim_in(json.dumps({"state": "LOST", "node": claim.to_json()}).encode()) == claim


def test_status_of_another_node_silences_this_one_for_its_robot_only(caplog):
    net, now = MemoryTransport(), [0.0]
    keys = [robot_keys("native", "coview", name) for name in ("r1", "r2")]
    elections = Elections(keys, 1.0, lambda: now[0])
    elections.declare(net)
    assert (elections.claim("r1"), elections.served_by("r1")) == (None, None)
    now[0] = 3.0
    assert elections.claim("r1").term == elections.claim("r2").term == 1
    status = json.dumps({"node": Claim(2, "other").to_json()}).encode()
    net.publisher(keys[0].status, "report").put(Encoded(status, "application/json"))
    assert elections.claim("r1") is None
    assert elections.served_by("r1") == "other"
    assert elections.claim("r2") is not None
    now[0] = 6.0
    assert elections.claim("r1").term == 3
    assert elections.served_by("r1") == elections.node
    said = [record.getMessage() for record in caplog.records]
    assert said == [
        "r1: node other serves it: standing by, to take over when that one is gone",
        "r1: node other is gone: serving it now",
    ]
