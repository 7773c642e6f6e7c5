"""Discovery: keys and tokens of the four conventions, and the options that lead to them."""

from __future__ import annotations

import pytest

from coview_stream.doctor.network_checks import Candidate, candidates_text, discover, from_key, from_token
from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.stream.transport.rmw import publisher_token

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
