"""The view in Foxglove: a recording is read back, and a client of the server sees the same topics."""

import socket

import numpy as np
import pytest

from coview_stream.basemap.summary import MapView
from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.clouds.trajectory import write_tum
from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages.types import HypothesesMessage, PoseMessage
from coview_stream.viewers.foxglove_sink import FoxgloveSink, record_world
from coview_stream.viewers.scene import Scan

pytest.importorskip("foxglove", reason="foxglove-sdk is not there; pip install 'coview-stream[foxglove]'")
ORIGIN = np.array([500_000.0, 5_400_000.0, 100.0])
T = pose_from(rot_z(0.5), np.add(ORIGIN, (12.0, -3.0, 1.5)))
POINTS = np.random.default_rng(1).uniform(-20, 20, (500, 3)).astype(np.float32)
TOPICS = {"/map", "/tf", *(f"/robots/r1/{name}" for name in ("pose", "scene", "scan", "hypotheses", "status", "state"))}


def shown(sink):
    sink.map(MapView(ORIGIN, POINTS, POINTS[:, 2] < 0, "EPSG:25832", "ab"))
    sink.status("r1", {"state": "SEARCHING", "reason": "too little has been seen"})
    places = np.array([[*T[:3, 3], 0.5, 0.9, 12.0], [*(T[:3, 3] + 5.0), 0.1, 0.05, 3.0]])
    sink.hypotheses(HypothesesMessage(5_000_000_000, "r1", places, 0.05, "ab"))
    sink.status("r1", {"state": "TRACKING", "reason": "found"})
    sink.pose(PoseMessage(6_000_000_000, "r1", "TRACKING", T, np.eye(6) * 0.01, 0.99, "ab"))
    sink.scan(Scan("r1", 6_000_000_000, POINTS, T))


def recorded(path):
    """Messages of a recording by topic, each as (stamp, name of the schema, bytes); and the rows of its map."""
    reader = pytest.importorskip("mcap.reader", reason="mcap is not there; pip install mcap")
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    messages = {}
    with path.open("rb") as stream:
        for schema, channel, message in reader.make_reader(stream).iter_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, schema and schema.name, message.data))
    return messages, np.frombuffer(PointCloud.FromString(messages["/map"][0][2]).data, "<f4").reshape(-1, 4)


def test_recording_holds_every_topic_in_schemas_of_foxglove(tmp_path):
    sink = FoxgloveSink()
    sink.record(tmp_path / "a.mcap")
    shown(sink)
    sink.close()
    messages, rows = recorded(tmp_path / "a.mcap")
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

    assert set(messages) == TOPICS
    assert messages["/map"][0][1] == "foxglove.PointCloud"
    np.testing.assert_array_equal(rows[:, :3], POINTS)
    poses = PosesInFrame.FromString(messages["/robots/r1/hypotheses"][0][2]).poses
    assert [round(each.position.x, 3) for each in poses] == [12.0, 17.0]  # about the map's origin
    assert len(messages["/robots/r1/state"]) == 2


def test_recording_of_nothing_is_not_left_behind(tmp_path):
    sink = FoxgloveSink()
    sink.record(tmp_path / "a.mcap")
    sink.close()
    assert not (tmp_path / "a.mcap").exists()


def test_recording_does_not_overwrite_and_names_what_is_wrong(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"mine")
    with pytest.raises(InputError, match=r"a\.mcap: is there already"):
        FoxgloveSink().record(tmp_path / "a.mcap")
    with pytest.raises(InputError, match="cannot be written"):
        FoxgloveSink().record(tmp_path / "none" / "a.mcap")


def test_server_listens_where_it_is_told_and_says_where_it_cannot():
    sink = FoxgloveSink()
    port = sink.serve("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            pass
        shown(sink)
        with pytest.raises(ConfigError, match=f"--foxglove 127.0.0.1:{port}"):
            FoxgloveSink().serve("127.0.0.1", port)
    finally:
        sink.close()


ODOMETRY = [pose_from(rot_z(0.1 * k), (0.5 * k, 0.0, 0.0)) for k in range(3)]
T_MAP_ODOM = pose_from(rot_z(2.0), np.add(ORIGIN, (5.0, 6.0, 0.0)))


def world(folder):
    """A world as ``simulate`` writes it, with three frames, and odometry without drift."""
    (folder / "run" / "frames").mkdir(parents=True)
    rng = np.random.default_rng(3)
    points = rng.uniform(-20.0, 20.0, (4000, 3))
    points[:, 2] = np.where(np.arange(4000) < 2000, 0.0, 10.0)
    write_cloud(folder / "base.laz", points, origin=ORIGIN)
    for k in range(3):
        write_cloud(folder / "run" / "frames" / f"{k:06d}.pcd", rng.uniform(-9.0, 9.0, (50, 3)))
    write_tum(folder / "run" / "odometry.tum", [10.0, 10.1, 10.2], ODOMETRY)
    write_tum(folder / "truth.tum", [10.0, 10.1, 10.2], [T_MAP_ODOM @ T for T in ODOMETRY])
    return folder


def test_recording_holds_survey_truth_scans_and_odometry_at_their_stamps(tmp_path):
    assert record_world(world(tmp_path / "world"), tmp_path / "a.mcap") == 3
    messages, rows = recorded(tmp_path / "a.mcap")
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

    stamps = [10_000_000_000, 10_100_000_000, 10_200_000_000]
    for topic in ("/robots/truth/pose", "/robots/truth/scan", "/robots/odometry/pose"):
        assert [stamp for stamp, _, _ in messages[topic]] == stamps
    origin = read_cloud(tmp_path / "world" / "base.laz").origin
    assert np.abs(rows[:, :3] + origin - ORIGIN).max() < 20.1
    assert 0.3 < rows[:, 3].mean() < 0.7  # half of it is the ground
    for topic in ("/robots/truth/pose", "/robots/odometry/pose"):
        last = PoseInFrame.FromString(messages[topic][-1][2]).pose.position
        expected = (T_MAP_ODOM @ ODOMETRY[-1])[:3, 3] - origin
        np.testing.assert_allclose([last.x, last.y, last.z], expected, atol=1e-5)
