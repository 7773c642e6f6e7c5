"""RobotClient in threads and in event loops, on the fake network and over real sockets; and its queue."""

import asyncio
import json
import struct
import threading
from contextlib import closing

import numpy as np
import pytest
from sockets import free_endpoint, until

from coview_stream import RobotClient
from coview_stream.errors import ConfigError, InputError, TransportError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import decode_cloud, decode_odometry, encode_pose
from coview_stream.messages.types import Encoded, PoseMessage, Sample
from coview_stream.stream.client import client as client_module
from coview_stream.stream.client.client import MAX_UNREAD_POSES
from coview_stream.stream.client.latest_queue import LatestQueue
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.stream.transport.zenoh_transport import open_transport

T = pose_from(rot_z(0.3), [1.0, -2.0, 0.5])
CLOUD = np.arange(12, dtype=np.float32).reshape(4, 3)


def pose_message(stamp_ns=5, robot="r1"):
    return PoseMessage(stamp_ns, robot, "TRACKING", T, np.eye(6), 0.9, "ab" * 32, 0.1)


def published(net, encoded, key="coview/r1/out/pose"):
    net.publish(Sample(key, encoded.payload, encoded.encoding, encoded.attachment))


@pytest.fixture
def net():
    return MemoryTransport()


@pytest.fixture
def client(net):
    with RobotClient("r1", transport=net) as robot:
        yield robot


def test_sent_cloud_has_the_documented_layout(client, net):
    client.send_cloud(CLOUD, 1_700_000_000.25)
    (sample,) = net.published
    assert sample.key == "coview/r1/in/cloud"
    assert sample.encoding == "application/octet-stream;layout=xyz"
    assert sample.payload == struct.pack("<12f", *range(12))
    assert sample.attachment == struct.pack("<q", 1_700_000_000_250_000_000)
    assert {p.key: p.urgency for p in net.publishers} == {"coview/r1/in/cloud": "bulk", "coview/r1/in/odom": "data"}


def test_equivalent_arrays_are_accepted(client, net):
    client.send_cloud(np.column_stack([CLOUD, np.ones(4)]).astype(np.float64), 1)
    client.send_cloud(np.asfortranarray(CLOUD), 1.0)
    client.send_cloud(CLOUD.tolist(), np.float32(1.0))
    assert len({(s.payload, s.attachment) for s in net.published}) == 1
    client.send_cloud(np.vstack([CLOUD, [np.nan] * 3]), 2.0)  # directions without an echo are no error
    assert len(net.published[-1].payload) == 5 * 12


def test_sent_odometry_has_the_documented_layout(client, net):
    client.send_odometry(T, 0.1)
    (sample,) = net.published
    assert (sample.key, sample.encoding) == ("coview/r1/in/odom", "application/json")
    fields = json.loads(sample.payload)
    assert len(sample.payload) < 400  # a microcontroller writes it too
    assert set(fields) == {"stamp_ns", "position", "orientation"}
    assert fields["stamp_ns"] == 100_000_000
    assert fields["position"] == pytest.approx([1.0, -2.0, 0.5])
    assert fields["orientation"] == pytest.approx([0, 0, np.sin(0.15), np.cos(0.15)])


def test_point_times_are_sent(client, net):
    times = np.array([0.0, 0.01, 0.02, 0.03])
    client.send_cloud(CLOUD, 3.0, times)
    message = decode_cloud(net.published[0])
    assert message.times == pytest.approx(times, abs=1e-7)
    np.testing.assert_array_equal(message.points, CLOUD)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda c: c.send_cloud(np.zeros((4, 2)), 1.0), "shape"),
        (lambda c: c.send_cloud(None, 1.0), "shape"),
        (lambda c: c.send_cloud([["a", "b", "c"]], 1.0), "cloud is not an array of numbers"),
        (lambda c: c.send_cloud(np.zeros((0, 3)), 1.0), "0 points"),
        (lambda c: c.send_cloud(np.full((4, 3), np.nan), 1.0), "4 points, none of them finite"),
        (lambda c: c.send_cloud(np.where(np.eye(3), np.inf, 1.0), 1.0), "none of them finite"),
        (lambda c: c.send_cloud(CLOUD, 1.0, np.zeros(3)), "times"),
        (lambda c: c.send_cloud(CLOUD, 1.0, ["x"] * 4), "times is not an array of numbers"),
        (lambda c: c.send_cloud(CLOUD, None), "stamp None: give seconds"),
        (lambda c: c.send_cloud(CLOUD, np.zeros(2)), "seconds"),
        (lambda c: c.send_odometry(np.eye(4), None), "stamp None: give seconds"),
        (lambda c: c.send_odometry("here", 1.0), "T_odom_body"),
        (lambda c: c.send_cloud(CLOUD, 1_700_000_000_000_000_000), "seconds"),
        (lambda c: c.send_cloud(CLOUD, float("nan")), "seconds"),
        (lambda c: c.send_odometry(np.zeros((4, 4)), 1.0), "T_odom_body"),
    ],
)
def test_invalid_clouds_and_odometry_are_refused(client, net, call, text):
    with pytest.raises(InputError, match=text):
        call(client)
    assert net.published == []


@pytest.mark.parametrize(
    ("preset", "cloud_key", "has_encoding"),
    [
        ("native", "coview/r1/in/cloud", True),
        ("ros2dds", "r1/points", False),
        ("rmw_zenoh", "0/r1/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_", False),
        ("keelson", "coview/@v0/r1/pubsub/point_cloud/robot", False),
    ],
)
def test_every_preset_reaches_a_node_of_that_preset(net, preset, cloud_key, has_encoding):
    keys = robot_keys(preset, "coview", "r1")
    clouds, odometry = [], []
    net.subscribe(keys.cloud, lambda s: clouds.append(decode_cloud(s, hint=keys.hint)), "newest")
    net.subscribe(keys.odometry, lambda s: odometry.append(decode_odometry(s, hint=keys.hint)), "all")
    with RobotClient("r1", transport=net, preset=preset) as robot:
        robot.send_odometry(T, 12.5)
        robot.send_cloud(CLOUD, 12.5)
        sent = net.published[-1]
        assert sent.key.startswith(cloud_key)
        assert bool(sent.encoding) is has_encoding
        assert (sent.attachment is None) is (preset in ("ros2dds", "keelson"))
        assert net.raised == []
        (cloud,), (odom,) = clouds, odometry
        assert cloud.stamp_ns == odom.stamp_ns == 12_500_000_000
        np.testing.assert_array_equal(cloud.points, CLOUD)
        assert odom.T_odom_body == pytest.approx(T)
        # and back
        published(net, encode_pose(pose_message(), keys.pose_format), keys.pose)
        assert robot.latest_pose is not None
        assert robot.latest_pose.robot == "r1"
        assert robot.latest_pose.T_map_body == pytest.approx(T)


def test_poses_and_statuses_come_in_order(client, net):
    assert client.latest_pose is None
    assert client.latest_status is None
    for k in range(3):
        published(net, encode_pose(pose_message(k), "json"))
        published(net, Encoded(json.dumps({"state": "TRACKING", "n": k}).encode()), "coview/r1/out/status")
    assert [pose.stamp_ns for pose in client.poses(timeout=0)] == [0, 1, 2]
    assert [status["n"] for status in client.statuses(timeout=0)] == [0, 1, 2]
    assert client.latest_pose.stamp_ns == 2
    assert client.latest_status == {"state": "TRACKING", "n": 2}
    assert list(client.poses(timeout=0)) == []


def test_unread_poses_are_bounded(client, net):
    for k in range(MAX_UNREAD_POSES + 5):
        published(net, encode_pose(pose_message(k), "json"))
    stamps = [pose.stamp_ns for pose in client.poses(timeout=0)]
    assert stamps == list(range(5, MAX_UNREAD_POSES + 5))


def test_other_robots_and_undecodable_messages_are_ignored(client, net, caplog):
    published(net, encode_pose(pose_message(robot="r2"), "json"), "coview/r2/out/pose")
    for payload in (b"", b"\xff\x00", b"{}", b"[1]", b"[" * 50_000):
        published(net, Encoded(payload))
        published(net, Encoded(payload), "coview/r1/out/status")
    assert client.latest_pose is None
    assert client.malformed == 9  # an empty object is a status without fields
    assert len(caplog.records) == 1
    assert net.raised == []


def test_close_ends_iterators_and_keeps_given_transport_open(net):
    robot = RobotClient("r1", transport=net)
    published(net, encode_pose(pose_message(1), "json"))
    poses = robot.poses()
    assert next(poses).stamp_ns == 1
    robot.close()
    robot.close()
    assert list(poses) == []
    assert not net.closed
    assert len(net.published) == 1


@pytest.mark.parametrize(
    "call",
    [
        lambda c: c.send_cloud(CLOUD, 1.0),
        lambda c: c.send_odometry(T, 1.0),
        lambda c: c.relocalize(),
        lambda c: c.reset(),
        lambda c: c.wait_for_node(0.0),
    ],
)
def test_closed_client_raises(net, call):
    robot = RobotClient("r1", transport=net)
    robot.close()
    with pytest.raises(TransportError, match="'r1' is closed"):
        call(robot)
    assert net.published == []


def status(net, state):
    net.publish(Sample("coview/r1/out/status", json.dumps({"state": state}).encode()))


@pytest.mark.parametrize("state", ["LOST", "SEARCHING", "AMBIGUOUS"])
def test_latest_pose_is_none_after_tracking_ends(client, net, state):
    status(net, "TRACKING")
    published(net, encode_pose(pose_message(1), "json"))
    assert client.latest_pose.stamp_ns == 1
    for after in (state, "TRACKING", state):  # a stale pose does not return
        status(net, after)
        assert client.latest_pose is None
    published(net, encode_pose(pose_message(2), "json"))  # was under way when the state changed
    assert client.latest_pose is None
    status(net, "TRACKING")
    published(net, encode_pose(pose_message(3), "json"))
    assert client.latest_pose.stamp_ns == 3


def test_latest_pose_expires(client, net, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(client_module, "monotonic", lambda: now[0])
    published(net, encode_pose(pose_message(1), "json"))
    now[0] += 1.9
    assert client.latest_pose.stamp_ns == 1
    now[0] += 0.2
    assert client.latest_pose is None
    published(net, encode_pose(pose_message(2), "json"))
    assert client.latest_pose.stamp_ns == 2


def test_reset_and_relocalize_requests(client, net):
    with pytest.raises(TransportError, match="no answer"):
        client.relocalize()
    net.answer("coview/r1/rpc/relocalize", lambda parameters: {"ok": True, "parameters": parameters})
    assert client.relocalize() == {"ok": True, "parameters": {}}

    def refuse(parameters):
        raise ValueError("not now")

    net.answer("coview/r1/rpc/reset", refuse)
    with pytest.raises(TransportError, match="not now"):
        client.reset()


@pytest.mark.parametrize("options", [{"robot": "a/b"}, {"cloud_encoding": "zip"}, {"odometry_encoding": "xyz"}])
def test_bad_client_options_are_refused(net, options):
    with pytest.raises(ConfigError):
        RobotClient(**({"robot": "r1", "transport": net} | options))


@pytest.mark.slow
def test_client_over_real_sockets():
    endpoint = free_endpoint()
    with closing(open_transport(listen=[endpoint])) as node, RobotClient("r1", endpoint) as robot:
        assert not robot.wait_for_node(0.05)
        # odometry first, as the node does: the client waits for a subscriber to its clouds
        node.subscribe("coview/r1/in/odom", print, "all")
        assert not robot.wait_for_node(0.2)
        node.subscribe("coview/r1/in/cloud", print, "newest")
        node.answer("coview/r1/rpc/reset", lambda parameters: {"ok": True})
        pose_out = node.publisher("coview/r1/out/pose", "realtime")
        status_out = node.publisher("coview/r1/out/status", "data")
        assert robot.wait_for_node(5)

        pose_out.put(encode_pose(pose_message(9), "cdr"))
        status_out.put(Encoded(b'{"state": "TRACKING"}', "application/json"))
        pose = next(robot.poses(timeout=5))
        assert (pose.stamp_ns, pose.robot) == (9, "r1")
        assert next(robot.statuses(timeout=5)) == {"state": "TRACKING"}

        until(lambda: answers(robot))
        with pytest.raises(TransportError, match="no answer"):
            robot.relocalize(timeout=0.5)


def answers(robot):
    """Whether the reset queryable has become known to the client's session, and replies."""
    try:
        return robot.reset(timeout=1) == {"ok": True}
    except TransportError:
        return False


def test_last_large_frame_is_sent_before_close():
    """Measured: without waiting, a 1 MB frame put just before closing never arrives."""
    endpoint = free_endpoint()
    clouds = []
    with closing(open_transport(listen=[endpoint])) as node:
        node.subscribe("coview/r1/in/cloud", lambda s: clouds.append(len(s.payload)), "newest")
        with RobotClient("r1", endpoint) as robot:
            assert robot.wait_for_node(5)
            robot.send_cloud(np.ones((100_000, 3), np.float32), 1.0)
        until(lambda: clouds)
        assert clouds == [1_200_000]


def run(main):
    """Run a coroutine; one that waits for ever fails."""
    return asyncio.run(asyncio.wait_for(main, 20.0))


def publish(net, *stamps):
    """Publish from another thread, as a network does."""

    def send():
        for stamp in stamps:
            published(net, encode_pose(pose_message(stamp), "json"))

    thread = threading.Thread(target=send)
    thread.start()
    return thread


def test_poses_come_by_async_for_until_none_come(net):
    async def drive():
        async with RobotClient("r1", transport=net) as robot:
            publish(net, 1, 2).join()
            stamps = []
            async for pose in robot.poses(timeout=0.05):
                stamps.append(pose.stamp_ns)
                if pose.stamp_ns == 2:
                    thread = publish(net, 3)  # while the loop waits
            thread.join()
        with pytest.raises(TransportError, match="closed"):
            robot.send_cloud(np.zeros((9, 3)), 1.0)
        return stamps

    assert run(drive()) == [1, 2, 3]


def test_cancelled_reader_takes_no_pose(net):
    async def drive():
        async with RobotClient("r1", transport=net) as robot:
            poses = robot.poses()
            waiting = asyncio.ensure_future(anext(poses))
            await asyncio.sleep(0)
            publish(net, 8).join()  # it has arrived, and the reader has not run since
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            assert not robot._poses._waking
            return (await anext(poses)).stamp_ns

    assert run(drive()) == 8


def test_closing_ends_async_iteration_and_what_was_unread_is_given(net):
    async def drive():
        robot = RobotClient("r1", transport=net)
        publish(net, 1, 2).join()
        robot.close()
        return [pose.stamp_ns async for pose in robot.poses()]

    assert run(drive()) == [1, 2]


def test_queue_outlives_the_loop_of_a_reader():
    queue = LatestQueue(3)

    async def give_up():
        return await queue.next(timeout=0.01)

    assert run(give_up()) is None
    queue.put(5)
    assert run(queue.next()) == 5
    queue.close()
    assert run(queue.next()) is None


def test_iterator_that_has_ended_stays_so(net):
    with RobotClient("r1", transport=net) as robot:
        poses = robot.poses(timeout=0.0)
        assert list(poses) == []
        publish(net, 1).join()
        assert list(poses) == []
        assert [pose.stamp_ns for pose in robot.poses(timeout=0.0)] == [1]


def test_client_says_what_it_is_in_one_line(net):
    with RobotClient("r1", transport=net) as robot:
        assert repr(robot) == "RobotClient('r1', sends on coview/r1/in/cloud, no status yet)"
        net.publish(Sample("coview/r1/out/status", b'{"state": "LOST"}', "application/json"))
        assert "state LOST" in repr(robot)
    assert repr(robot).endswith(", closed)")


def test_latest_queue_keeps_order_and_drops_oldest():
    queue = LatestQueue(3)
    for k in range(5):
        queue.put(k)
    assert [queue.get(0), queue.get(0), queue.get(0), queue.get(0)] == [2, 3, 4, None]
    assert queue.dropped == 2


def test_put_and_close_wake_a_reader_and_close_keeps_items():
    queue = LatestQueue(3)
    items = []
    reader = threading.Thread(target=lambda: [items.append(queue.get()) for _ in range(2)])
    reader.start()
    queue.put(4)
    until(lambda: items)
    queue.close()
    reader.join(5)
    assert items == [4, None]

    full = LatestQueue(3)
    full.put(1)
    full.close()
    full.put(2)
    assert [full.get(), full.get()] == [1, None]
