"""The feed of a session: what comes over the network, decoded and handed to every sink."""

import json
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_robot import KEYS, SHA, cloud, ns
from sockets import until

from coview_stream.basemap.summary import MapView
from coview_stream.cli.view import feed_of_node
from coview_stream.config.mount import Mount
from coview_stream.errors import ConfigError, TransportError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import encode_pose
from coview_stream.messages.json_messages import encode_hypotheses
from coview_stream.messages.types import HypothesesMessage, PoseMessage, Sample
from coview_stream.stream.node.serve import CodecOptions, ServeOptions
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.viewers.scene import PoseTrack, Sink
from coview_stream.viewers.session_feed import MAX_ROBOTS, SessionFeed, asked_of_node, topics_of_base, topics_of_robots

VIEW = MapView(np.zeros(3), np.ones((4, 3), dtype=np.float32), np.ones(4, dtype=bool), None, SHA)


class Kept(Sink):
    """Keeps all that comes, by its kind."""

    def __init__(self):
        self.seen = {kind: [] for kind in ("map", "pose", "status", "hypotheses", "scan")}
        self.map, self.pose = self.seen["map"].append, self.seen["pose"].append
        self.hypotheses, self.scan = self.seen["hypotheses"].append, self.seen["scan"].append
        self.closed = False

    def status(self, robot, status):
        self.seen["status"].append((robot, status))

    def close(self):
        self.closed = True

    def wait(self, kind, count=1):
        until(lambda: len(self.seen[kind]) >= count)
        return self.seen[kind].copy()


class Broken(Sink):
    def pose(self, pose):
        raise RuntimeError("not drawn")


def pose_at(seconds, x=0.0, robot="r1"):
    T = pose_from(rot_z(0.0), [x, 0.0, 0.0])
    return PoseMessage(ns(seconds), robot, "TRACKING", T, np.eye(6), 0.99, SHA)


def put(net, key, encoded):
    net.publish(Sample(key, encoded.payload, encoded.encoding))


def put_status(net, key, **fields):
    net.publish(Sample(key, json.dumps(fields).encode(), "application/json"))


@pytest.fixture
def net():
    return MemoryTransport()


@pytest.fixture
def kept():
    return Kept()


def feed(net, kept, topics=None, **options):
    made = SessionFeed(net, topics or topics_of_robots([KEYS]), **options)
    made.add(kept)
    return made


def test_everything_comes_decoded_and_a_broken_sink_silences_no_other(net, kept):
    made = feed(net, kept, map_view=VIEW)
    made.add(Broken())
    with made:
        put(net, KEYS.pose, encode_pose(pose_at(0.0), "json"))
        put_status(net, KEYS.status, state="SEARCHING")
        message = HypothesesMessage(ns(0.0), "", np.array([[1.0, 2, 3, 0, 0.5, 4]]), 0.5, SHA)
        put(net, KEYS.hypotheses, encode_hypotheses(message))
        assert kept.wait("map")[0] is VIEW
        assert kept.wait("pose")[0].robot == "r1"
        assert kept.wait("status")[0] == ("r1", {"state": "SEARCHING"})
        assert kept.wait("hypotheses")[0].robot == "r1"
    assert kept.closed


@pytest.mark.slow
def test_a_sink_that_hangs_holds_up_no_publisher(net, kept):
    going_on = threading.Event()
    kept.pose = lambda pose: going_on.wait(20.0)
    with feed(net, kept, policy="newest"):
        for k in range(5000):
            put(net, KEYS.pose, encode_pose(pose_at(0.1 * k), "json"))
            net.publish(cloud(0.1 * k))
        assert not going_on.is_set()  # all have been published meanwhile
        assert net.raised == []
        going_on.set()


def test_names_from_the_network_fill_no_memory(net, kept):
    with feed(net, kept, topics_of_base("coview")) as made:
        for k in range(MAX_ROBOTS + 20):
            put_status(net, f"coview/r{k}/out/status", state="LOST")
            net.publish(cloud(0.0, keys=robot_keys("native", "coview", f"c{k}")))
        kept.wait("status", 1)
        put_status(net, "coview/r0/out/status", state="TRACKING")
        until(lambda: ("r0", {"state": "TRACKING"}) in kept.wait("status"))
        assert len({robot for robot, _ in kept.wait("status")}) <= MAX_ROBOTS
        assert len(made._robots) + len(made._next_scan) <= 2 * MAX_ROBOTS


def test_rubbish_ends_nothing(net, kept):
    with feed(net, kept):
        for key in (KEYS.pose, KEYS.status, KEYS.hypotheses, KEYS.cloud):
            net.publish(Sample(key, b"\xff\x00rubbish"))
        put(net, KEYS.pose, encode_pose(pose_at(0.0), "json"))
        kept.wait("pose")


def test_robots_of_a_base_are_told_by_their_keys(net, kept):
    with feed(net, kept, topics_of_base("site/hall3")):
        put(net, "site/hall3/rover9/out/pose", encode_pose(pose_at(0.0, robot="liar"), "json"))
        assert kept.wait("pose")[0].robot == "rover9"


def test_a_base_that_is_none_is_refused():
    with pytest.raises(ConfigError, match="--base"):
        topics_of_base("a//b")


def test_clouds_without_an_encoding_are_read_by_the_nodes_codec(net, kept):
    node = SimpleNamespace(transport=net, map_files={}, map_sha256=SHA)
    options = ServeOptions(Path("site.coview"), [KEYS], codecs=CodecOptions(cloud="xyz"))
    with closing(feed_of_node(node, options, [kept])):
        net.publish(replace(cloud(0.0), encoding=""))
        kept.wait("scan")


def test_a_scan_comes_with_the_pose_of_its_time_and_mounted(net, kept):
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]], dtype=np.float32)
    with feed(net, kept, mount=Mount(yaw=np.pi)):
        for seconds, x in ((0.0, 0.0), (0.2, 2.0)):
            put(net, KEYS.pose, encode_pose(pose_at(seconds, x), "json"))
        net.publish(cloud(0.1, points))
        (scan,) = kept.wait("scan")
        net.publish(replace(cloud(0.15, points), mount=Mount(x=1.0)))  # by /tf_static
        mounted = kept.wait("scan", 2)[1]
    assert np.allclose(scan.points, [[-1.0, -2.0, 3.0]], atol=1e-5)
    assert np.allclose(mounted.points, [[2.0, 2.0, 3.0]], atol=1e-5)
    assert np.allclose(scan.T_map_body[:3, 3], [1.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_a_scan_of_a_robot_without_a_pose_comes_without(net, kept):
    with feed(net, kept):
        net.publish(cloud(0.0))
        assert kept.wait("scan")[0].T_map_body is None


def test_clouds_are_not_asked_for_unless_wanted(net, kept):
    with feed(net, kept, clouds=False):
        assert KEYS.cloud not in net.subscribed


def test_a_map_is_asked_for_once_a_status_names_it(net, kept):
    net.answer(KEYS.map_view, lambda parameters: VIEW.to_json())
    with feed(net, kept, map_source=asked_of_node(net, "coview")):
        for _ in range(3):
            put_status(net, KEYS.status, map_sha256=SHA)
        assert kept.wait("map")[0].sha256 == SHA
        kept.wait("status", 3)
    assert len(kept.wait("map")) == 1


def test_a_node_without_a_map_view_is_no_end(net, kept, caplog):
    def nothing(robot):
        raise TransportError("no answer")

    with feed(net, kept, map_source=nothing):
        put_status(net, KEYS.status, map_sha256=SHA)
        put_status(net, KEYS.status, map_sha256=SHA, state="LOST")
        kept.wait("status", 2)


def test_poses_are_found_by_stamp():
    track = PoseTrack()
    assert track.at(0) is None
    for second in (0, 1, 5):
        track.add(second * 10**9, pose_from(np.eye(3), [float(second), 0.0, 0.0]))
    assert track.at(500_000_000)[0, 3] == pytest.approx(0.5)
    assert track.at(3 * 10**9) is None  # a pause
    assert track.at(5_100_000_000)[0, 3] == 5.0
    assert track.at(6 * 10**9) is None
    assert track.reaches(5 * 10**9)
    track.add(0, np.eye(4))  # the run began again
    assert not track.reaches(10**9)
