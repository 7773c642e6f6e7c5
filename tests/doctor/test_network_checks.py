"""Collecting over a fake network, without time; and what plain TCP says."""

from __future__ import annotations

import json
import socket

from captured_robot import KEYS, cloud, odometry, steps

from coview_stream.doctor.network_checks import connection_finding, robots_findings, try_tcp
from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport


class Time:
    """A clock that runs while somebody waits, and a robot that sends meanwhile."""

    def __init__(self, net, *messages):
        self.now, self._net = 50.0, net
        self._messages = sorted(messages, key=lambda m: m[0])

    def clock(self):
        return self.now

    def wait(self, seconds):
        begin, end = self.now, self.now + seconds
        while self._messages and 50.0 + self._messages[0][0] < end:
            at, sample = self._messages.pop(0)
            self.now = max(begin, 50.0 + at)
            self._net.publish(sample)
        self.now = end


def findings(net, messages, keys=(KEYS,), seconds=3.0, **more):
    time = Time(net, *messages)
    return list(robots_findings(net, keys, seconds, wait=time.wait, clock=time.clock, **more))


DRIVE = [*((t, odometry(t)) for t in steps(50)), *((t + 0.05, cloud(t)) for t in steps(10))]


def test_findings_of_a_robot_and_its_node():
    net = MemoryTransport()
    net.announce(KEYS.alive)
    status = {"state": "SEARCHING", "reason": "too few keyframes", "map_sha256": "ab"}
    said = [(0.5, Sample(KEYS.status, json.dumps(status).encode())), (0.6, Sample(KEYS.status, b"\xff"))]
    found = findings(net, [*DRIVE, *said])
    assert {f.what: f.verdict for f in found} == {
        "clouds": "ok",
        "cloud stamps": "ok",
        "odometry": "ok",
        "odometry stamps": "ok",
        "gravity": "ok",
        "ground": "warn",  # noise has none
        "one clock": "ok",
        "pairing": "ok",
        "node": "warn",  # it says no version
    }
    assert "SEARCHING: too few keyframes" in found[-1].found
    assert net.raised == []
    assert set(net.subscribed) == {KEYS.cloud, KEYS.odometry, KEYS.status}  # no other robot's are asked for


def test_messages_after_the_capture_are_not_counted():
    # clouds alone, so that it goes on to look for others while they still come
    found = findings(MemoryTransport(), [(t / 2, cloud(t / 2)) for t in range(10)], seconds=2.0)
    assert found[0].found.startswith("2.0 Hz")
    assert [f.what for f in found] == ["clouds", "cloud stamps", "odometry", "node"]
    assert "on coview/r1/in/odom" in found[2].found


def test_silent_robot_is_told_keys_of_other_robots():
    other = robot_keys("native", "coview", "r2")
    found = findings(MemoryTransport(), [(3.5, Sample(KEYS.cloud, b"x"))], keys=[other])
    assert [(f.verdict, f.what) for f in found] == [("FAIL", "clouds"), ("FAIL", "odometry"), ("warn", "node")]
    assert found[0].remedy == "clouds come on coview/r1/in/cloud: try --robot r1"
    assert "does the robot publish" in found[1].remedy


def test_robots_on_the_network_are_listed_without_robot_option():
    found = findings(MemoryTransport(), [(0.5, cloud(0.0))], keys=[])
    assert [(f.verdict, f.found) for f in found] == [("ok", "clouds come on coview/r1/in/cloud: try --robot r1")]
    assert [f.verdict for f in findings(MemoryTransport(), [], keys=[])] == ["warn"]


def test_fault_of_one_robot_does_not_affect_another():
    other = robot_keys("native", "coview", "r2")
    found = findings(MemoryTransport(), DRIVE, keys=[KEYS, other])
    assert {f.robot for f in found if f.verdict == "FAIL"} == {"r2"}


def test_connection_finding_explains_unreachable_endpoint():
    net = MemoryTransport()
    assert connection_finding(net, []).found == "connected: 1 router"
    net.go_away()
    with socket.socket() as shut:
        shut.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{shut.getsockname()[1]}"
        found = connection_finding(net, [endpoint], lambda seconds: None)
        assert found.verdict == "FAIL"
        assert f"{endpoint} refuses" in found.found
        shut.listen()
        assert "TLS" in connection_finding(net, [endpoint], lambda seconds: None).remedy
    assert "nothing has connected" in connection_finding(net, [], lambda seconds: None).found


def test_tcp_probe_of_unknown_host_and_other_protocol():
    assert "no host" in try_tcp("tcp/no-such-host.invalid:7447")
    assert try_tcp("udp/127.0.0.1:7447") == "does not answer"
