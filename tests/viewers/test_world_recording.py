"""A simulated world recorded in MCAP: survey, truth with the scans, odometry from the same beginning, by stamp."""

import numpy as np
import pytest

from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.clouds.trajectory import write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.viewers.foxglove_sink import record_world

pytest.importorskip("foxglove", reason="foxglove-sdk is not there; pip install 'coview-stream[foxglove]'")
ORIGIN = np.array([412_000.0, 5_318_000.0, 240.0])
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
    reader = pytest.importorskip("mcap.reader", reason="mcap is not there; pip install mcap")
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

    messages = {}
    with (tmp_path / "a.mcap").open("rb") as stream:
        for _, channel, message in reader.make_reader(stream).iter_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, message.data))
    stamps = [10_000_000_000, 10_100_000_000, 10_200_000_000]
    for topic in ("/robots/truth/pose", "/robots/truth/scan", "/robots/odometry/pose"):
        assert [stamp for stamp, _ in messages[topic]] == stamps
    rows = np.frombuffer(PointCloud.FromString(messages["/map"][0][1]).data, "<f4").reshape(-1, 4)
    origin = read_cloud(tmp_path / "world" / "base.laz").origin
    assert np.abs(rows[:, :3] + origin - ORIGIN).max() < 20.1
    assert 0.3 < rows[:, 3].mean() < 0.7  # half of it is the ground
    for topic in ("/robots/truth/pose", "/robots/odometry/pose"):
        last = PoseInFrame.FromString(messages[topic][-1][1]).pose.position
        expected = (T_MAP_ODOM @ ODOMETRY[-1])[:3, 3] - origin
        np.testing.assert_allclose([last.x, last.y, last.z], expected, atol=1e-5)


def test_recording_of_a_world_does_not_overwrite(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"mine")
    with pytest.raises(InputError, match="is there already"):
        record_world(world(tmp_path / "world"), tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == b"mine"
