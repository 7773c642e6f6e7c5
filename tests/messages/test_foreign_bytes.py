"""Bytes of foreign encoders (Cyclone DDS, JavaScript, Foxglove) are read, or refused by name."""

from pathlib import Path

import numpy as np
import pytest

from coview_stream.errors import MessageError
from coview_stream.geometry.transforms import pose_to_tum
from coview_stream.messages import decode_cloud, decode_odometry, decode_pose, encode_cloud
from coview_stream.messages.types import CloudMessage, Sample

FOREIGN = Path(__file__).parent / "foreign"
POINTS = np.load(FOREIGN / "pts.npy")
CLOUD_NS, POSE_NS = 1_700_000_000_123_456_789, 1_700_000_000_000_000_005
PLACE = np.array([1.5, -2.25, 0.125])
TURN = np.array([0.1, -0.2, 0.3, 0.9]) / np.linalg.norm([0.1, -0.2, 0.3, 0.9])
CLOUD, ODOMETRY, POSE = (
    f"application/cdr;{name}"
    for name in ("sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
)


def sample(path, encoding="", options=None):
    payload = path.read_bytes()
    if options is not None:
        payload = payload[:2] + options + payload[4:]
    return Sample("coview/r1/in/any", payload, encoding)


def named(pattern, *more):
    paths = sorted(path for glob in (pattern, *more) for path in FOREIGN.glob(glob) if "_x2" not in path.name)
    assert paths
    return pytest.mark.parametrize("path", paths, ids=lambda path: path.stem)


def check_place(T):
    tum = pose_to_tum(T)
    np.testing.assert_allclose(tum[:3], PLACE, atol=1e-12)
    np.testing.assert_allclose(tum[3:] * np.sign(tum[6]), TURN, atol=1e-9)


@pytest.mark.parametrize("encoding", ["", CLOUD])
@named("cloud_*.bin", "js_PointCloud2.bin")
def test_cloud_in_cdr(path, encoding):
    read = decode_cloud(sample(path, encoding))
    np.testing.assert_array_equal(read.points, POINTS)
    assert read.stamp_ns == CLOUD_NS
    if "full" in path.name:
        assert read.times is not None


@named("odom_*.bin", "js_Odometry.bin")
def test_odometry_in_cdr(path):
    read = decode_odometry(sample(path, ODOMETRY))
    assert read.stamp_ns == (POSE_NS if path.name.startswith("odom") else CLOUD_NS)
    check_place(read.T_odom_body)


@named("pose_*.bin")
def test_pose_in_cdr(path):
    read = decode_pose(sample(path, POSE))
    assert read.stamp_ns == POSE_NS
    check_place(read.T_map_body)
    np.testing.assert_array_equal(read.covariance, np.arange(36.0).reshape(6, 6))


@pytest.mark.parametrize("kind", ["cloud", "odom", "pose"])
@pytest.mark.parametrize("encoding", ["named", "silent"])
def test_xcdr2_is_named_as_such(kind, encoding):
    decode = {"cloud": decode_cloud, "odom": decode_odometry, "pose": decode_pose}[kind]
    name = {"cloud": CLOUD, "odom": ODOMETRY, "pose": POSE}[kind] if encoding == "named" else ""
    paths = sorted(FOREIGN.glob(f"{kind}_*_x2.bin"))
    assert paths
    for path in paths:
        with pytest.raises(MessageError, match=r"XCDR2.*publish with XCDR1"):
            decode(sample(path, name))


@pytest.mark.parametrize("options", [b"\0\1", b"\0\2", b"\0\3"])
@pytest.mark.parametrize("encoding", ["named", "silent"])
def test_option_bytes_of_the_header_are_ignored(options, encoding):
    for end in ("Little_x1", "Big_x1"):
        cloud = sample(FOREIGN / f"cloud_full_0_{end}.bin", CLOUD if encoding == "named" else "", options)
        np.testing.assert_array_equal(decode_cloud(cloud).points, POINTS)
        check_place(decode_odometry(sample(FOREIGN / f"odom_1_{end}.bin", ODOMETRY, options)).T_odom_body)


@pytest.mark.parametrize(("head", "says"), [(b"\0\3\0\0", "PL_CDR"), (b"\1\1\0\0", "0x0101"), (b"\0\1", "truncated")])
def test_other_encapsulations_are_named(head, says):
    with pytest.raises(MessageError, match=says):
        decode_odometry(Sample("k", head + bytes(100 if len(head) == 4 else 0), ODOMETRY))


def test_messages_of_foxglove():
    cloud = decode_cloud(sample(FOREIGN / "fox_pc.raw", "application/protobuf;foxglove.PointCloud"))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.stamp_ns == CLOUD_NS
    for name, schema in (("fox_pf", "PoseInFrame"), ("fox_ft", "FrameTransform")):
        read = decode_odometry(sample(FOREIGN / f"{name}.raw", f"application/protobuf;foxglove.{schema}"))
        assert read.stamp_ns == POSE_NS
        check_place(read.T_odom_body)


def test_keelson_reads_our_envelope():
    keelson = pytest.importorskip("keelson", reason="keelson is not here; pip install keelson")
    ours = encode_cloud(CloudMessage(CLOUD_NS, POINTS, None), "keelson")
    opened = keelson.uncover(ours.payload)
    assert opened is not None
    assert POINTS.tobytes() in bytes(opened[-1])


def test_foxglove_sdk_reads_our_messages():
    """Its encoder writes the same message; protobuf's canonical forms are compared."""
    foxglove = pytest.importorskip("foxglove.messages", reason="pip install foxglove-sdk")
    ours = encode_cloud(CloudMessage(CLOUD_NS, POINTS, None), "foxglove")
    types = foxglove.PackedElementFieldNumericType
    zero, straight = foxglove.Vector3(x=0, y=0, z=0), foxglove.Quaternion(x=0, y=0, z=0, w=1)
    theirs = foxglove.PointCloud(
        timestamp=foxglove.Timestamp(1_700_000_000, 123_456_789),
        frame_id="lidar",
        pose=foxglove.Pose(position=zero, orientation=straight),
        point_stride=12,
        fields=[foxglove.PackedElementField(name=n, offset=4 * i, type=types.Float32) for i, n in enumerate("xyz")],
        data=POINTS.tobytes(),
    ).encode()
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    one, other = PointCloud.FromString(ours.payload), PointCloud.FromString(theirs)
    assert (one.timestamp, one.point_stride, one.data) == (other.timestamp, other.point_stride, other.data)
    assert [(f.name, f.offset, f.type) for f in one.fields] == [(f.name, f.offset, f.type) for f in other.fields]
