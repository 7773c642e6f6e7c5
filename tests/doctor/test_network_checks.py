"""Collecting over a fake network, without time; and what plain TCP says."""

import json
import socket

import numpy as np
import pytest
from captured_robot import KEYS, cloud, odometry, steps

from coview_stream.config.mount import parse_mount
from coview_stream.doctor.network_checks import (
    Candidate,
    candidates_text,
    connection_finding,
    discover,
    from_key,
    from_token,
    listen,
    robots_findings,
    try_tcp,
)
from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.stream.transport.rmw import publisher_token


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
    return list(robots_findings(listen(net, keys, seconds, wait=time.wait, clock=time.clock), **more))


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


@pytest.mark.parametrize(("mount", "verdict"), [(None, "FAIL"), ("180,0,0", "ok")])
def test_clouds_are_judged_as_a_node_with_the_mount_takes_them(mount, verdict):
    floor = np.random.default_rng(2).uniform([-15.0, -15.0, 1.49], [15.0, 15.0, 1.51], (4000, 3)).astype(np.float32)
    sent = [
        *((t, odometry(t, np.eye(4))) for t in steps(50)),
        *((t + 0.05, cloud(t, np.concatenate([floor, 0.3 * floor - 3.0]))) for t in steps(10)),
    ]
    found = findings(MemoryTransport(), sent, mount=mount and parse_mount(mount))
    assert [f.verdict for f in found if f.what in ("ground", "mount")] == [verdict]


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
    assert found[0].found.endswith(other.cloud)
    assert found[0].remedy == "clouds come on coview/r1/in/cloud: try --robot r1"
    assert "does the robot publish" in found[1].remedy


@pytest.mark.parametrize("at", ["coview/r1", "coview/rover", "my/r1"])
def test_silent_robot_is_told_any_key_with_its_name_or_base_that_has_data(at):
    elsewhere = [Sample(f"{at}/lidar", cloud(0.0).payload), Sample(f"{at}/odom", odometry(0.0).payload)]
    own = Sample(f"{at}/out/pose", odometry(0.0).payload)
    found = findings(MemoryTransport(), [(3.5, sample) for sample in (*elsewhere, own)])
    assert found[0].remedy == f"clouds come on {at}/lidar: try --cloud-key {at}/lidar"
    assert found[1].remedy.startswith(f"odometry comes on {at}/odom: try --odometry-key {at}/odom. If")


def test_robots_on_the_network_are_listed_without_robot_option():
    found = findings(MemoryTransport(), [(0.5, cloud(0.0))], keys=[])
    assert [(f.verdict, f.found) for f in found] == [("ok", "clouds come on coview/r1/in/cloud: try --robot r1")]
    assert [f.verdict for f in findings(MemoryTransport(), [], keys=[])] == ["warn"]


@pytest.mark.slow
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
    assert "not a host" in try_tcp("tcp/no-such-host.invalid:7447")
    assert try_tcp("udp/127.0.0.1:7447") == "does not answer"


PC2 = "sensor_msgs::msg::dds_::PointCloud2_"
ODOM = "nav_msgs::msg::dds_::Odometry_"


@pytest.mark.parametrize(
    ("key", "channel", "options"),
    [
        ("coview/r2/in/cloud", "cloud", "--robot r2"),
        ("site/hall3/r2/in/odom", "odometry", "--robot r2 --base site/hall3"),
        (f"7/r2/points/{PC2}/RIHS01_9198", "cloud", "--preset rmw_zenoh --robot r2 --domain 7"),
        (f"0/odom/{ODOM}/h", "odometry", f"--preset rmw_zenoh --odometry-key '{{domain}}/odom/{ODOM}/*'"),
        ("r2/points", "cloud", "--preset ros2dds --robot r2"),
        ("hq/@v0/ship/pubsub/point_cloud/os", "cloud", "--preset keelson --robot ship --base hq"),
        ("coview/@v0/ship/pubsub/frame_transform/odometry/x", "odometry", "--preset keelson --robot ship"),
    ],
)
def test_known_keys_are_recognised(key, channel, options):
    candidate = from_key(key)
    assert (candidate.channel, candidate.options) == (channel, options)


@pytest.mark.parametrize("key", ["", "in", "r1/out/pose", "a/b/in/image", "points", "@v0/x", "a/@v0/b", "b/?/in/cloud"])
def test_unknown_keys_are_ignored(key):
    assert from_key(key) is None


def test_preset_keys_are_recognised_as_their_preset():
    for preset in ("native", "ros2dds", "rmw_zenoh", "keelson"):
        keys = robot_keys(preset, "coview", "r9")
        for channel, key in (("cloud", keys.cloud), ("odometry", keys.odometry)):
            candidate = from_key(key.replace("/**", "/s").replace("/*", "/h"))
            assert candidate is not None
            assert candidate.channel == channel
            assert "--robot r9" in candidate.options
            assert (preset == "native") == ("--preset" not in candidate.options)


def test_liveliness_tokens_are_recognised():
    token = publisher_token(f"3/r2/points/{PC2}/RIHS01_9198", "ab12", "driver", 5)
    assert from_token(token) == Candidate("cloud", "/r2/points", "--preset rmw_zenoh --robot r2 --domain 3")
    token = publisher_token(f"0/livox/lidar/{PC2}/x", "ab12", "driver", 5)
    assert from_token(token).options == f"--preset rmw_zenoh --cloud-key '{{domain}}/livox/lidar/{PC2}/*'"
    bridge = "@/ab12/@ros2_lv/MP/bot1\xa7lidar\xa7points/sensor_msgs\xa7msg\xa7PointCloud2/:1:"
    assert from_token(bridge) == Candidate(
        "cloud", "/bot1/lidar/points", "--preset ros2dds --cloud-key 'bot1/lidar/points'"
    )
    bridge = "@/ab12/@ros2_lv/MP/r2\xa7odom/nav_msgs\xa7msg\xa7Odometry/:1:"
    assert from_token(bridge) == Candidate("odometry", "/r2/odom", "--preset ros2dds --robot r2")


@pytest.mark.parametrize(
    "token",
    [
        "coview/r1/alive",
        "@ros2_lv/0/ab/0/0/NN/%/%/driver",
        publisher_token("0/r2/image/sensor_msgs::msg::dds_::Image_/x", "ab12", "driver", 5),
        publisher_token(f"0/r2/points/{PC2}/x", "ab12", "driver", 5).replace("/MP/", "/MS/"),
        "@/ab12/@ros2_lv/MS/r2\xa7odom/nav_msgs\xa7msg\xa7Odometry/:1:",
        "@/ab12/@ros2_lv",
        "",
    ],
)
def test_unknown_tokens_are_ignored(token):
    assert from_token(token) is None


def test_discovery_uses_keys_and_tokens():
    net = MemoryTransport()
    net.announce(publisher_token(f"0/r3/odom/{ODOM}/x", "ab12", "driver", 5))
    net.announce("@/ab12/@ros2_lv/MP/r4\xa7points/sensor_msgs\xa7msg\xa7PointCloud2/:1:")

    def wait(seconds):
        assert seconds == 2.0
        for _ in range(3):
            net.publish(Sample("coview/r2/in/cloud", b"x"))
        net.publish(Sample("hq/@v0/ship/pubsub/point_cloud/os", b"x"))

    candidates = discover(net, wait=wait)
    assert [o.where for o in candidates] == [
        "/r4/points",
        "coview/r2/in/cloud",
        "hq/@v0/ship/pubsub/point_cloud/os",
        "/r3/odom",
    ]
    assert candidates_text(candidates, "odometry") == "odometry comes on /r3/odom: try --preset rmw_zenoh --robot r3"
    assert candidates_text(candidates, "cloud").count(": try ") == 3
    assert net.raised == []


def test_suggested_options_stay_short():
    candidates = [Candidate("cloud", f"k{n}", f"--robot r{n}") for n in range(9)]
    assert candidates_text(candidates, "cloud").endswith("; and 6 more")
    assert candidates_text(candidates, "odometry") == ""
