"""Bytes that must never change, in both directions: literal, or composed by hand in codec_bytes."""

import json

import numpy as np
import pytest
from codec_bytes import POINTS, STAMP, T_TURN, cdr_odometry, cdr_pose, envelope, pb_in_frame, pb_transform

from coview_stream import messages as codecs
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.messages.types import CloudMessage, OdometryMessage, PoseMessage, Sample

ATTACHMENT = bytes.fromhex("15cd853dfe9c9717")
ROWS = "0000803f0000004000004040000080c00000b0400000c8c0"
FOXGLOVE_CLOUD = (
    "0a0b0880e2cfaa0610959aef3a" "1209626173655f6c696e6b" "250c000000"
    "2a050a01781807" "2a0a0a0179150400000018072a0a0a017a15080000001807" "3218"
) + ROWS  # fmt: skip
CDR_CLOUD = (
    "0001000000f1536515cd5b07" "0a000000626173655f6c696e6b000000" "0100000002000000" "03000000"
    "0200000078000000000000000700000001000000" "0200000079000000040000000700000001000000"
    "020000007a000000080000000700000001000000" "000000000c0000001800000018000000"
) + ROWS + "01"  # fmt: skip
FOXGLOVE_ODOMETRY = (
    "0a0b0880e2cfaa0610959aef3a" "12046f646f6d" "1a43" "0a1b09000000000000f03f110000000000000040190000000000000840"
    "122409000000000000e03f11000000000000e03f19000000000000e03f21000000000000e03f"
)  # fmt: skip
JSON_ODOMETRY = b'{"stamp_ns":1700000000123456789,"position":[1.0,2.0,3.0],"orientation":[0.5,0.5,0.5,0.5]}'
COVARIANCE = np.arange(36.0).reshape(6, 6)
JSON_POSE = (
    b'{"stamp_ns":1700000000123456789,"robot":"r1","state":"TRACKING","position":[1.0,2.0,3.0],'
    b'"orientation":[0.5,0.5,0.5,0.5],"covariance":['
    + b",".join(b"%d.0" % i for i in range(36))
    + b'],"confidence":0.75,"map_sha256":"ab","age_s":0.1,"frame_id":"map","protection_level":null,"T_map_odom":null}'
)

CLOUDS = {
    "xyz": ("application/octet-stream;layout=xyz", bytes.fromhex(ROWS)),
    "xyzi": ("application/octet-stream;layout=xyzi", bytes.fromhex(ROWS[:24] + 8 * "0" + ROWS[24:] + 8 * "0")),
    "foxglove": ("application/protobuf;foxglove.PointCloud", bytes.fromhex(FOXGLOVE_CLOUD)),
    "cdr": ("application/cdr;sensor_msgs/msg/PointCloud2", bytes.fromhex(CDR_CLOUD)),
    "keelson": ("application/protobuf;core.Envelope", envelope(bytes.fromhex(FOXGLOVE_CLOUD))),
}
ODOMETRY = {
    "json": ("application/json", JSON_ODOMETRY),
    "foxglove": ("application/protobuf;foxglove.PoseInFrame", bytes.fromhex(FOXGLOVE_ODOMETRY)),
    "cdr": ("application/cdr;nav_msgs/msg/Odometry", cdr_odometry()),
    "keelson": ("application/protobuf;core.Envelope", envelope(pb_transform())),
}
POSES = {
    "json": ("application/json", JSON_POSE),
    "foxglove": ("application/protobuf;foxglove.PoseInFrame", pb_in_frame("map")),
    "cdr": (
        "application/cdr;geometry_msgs/msg/PoseWithCovarianceStamped",
        cdr_pose(covariance=tuple(range(36))).done(),
    ),
    "keelson": ("application/protobuf;core.Envelope", envelope(pb_transform("map", "r1"))),
}


def test_every_codec_has_golden_bytes():
    assert (set(CLOUDS), set(ODOMETRY), set(POSES)) == (
        set(codecs.CLOUD_CODECS),
        set(codecs.ODOMETRY_CODECS),
        set(codecs.POSE_CODECS),
    )


@pytest.mark.parametrize("name", CLOUDS)
def test_cloud_golden_bytes(name):
    encoding, payload = CLOUDS[name]
    attachment = ATTACHMENT if name.startswith("xyz") else None
    written = codecs.encode_cloud(CloudMessage(STAMP, POINTS), name)
    assert (written.payload, written.encoding, written.attachment) == (payload, encoding, attachment)
    read = codecs.decode_cloud(Sample("coview/r1/in/cloud", payload, encoding, attachment))
    assert read.stamp_ns == STAMP
    assert read.points.dtype == np.float32
    assert read.points.flags.c_contiguous
    np.testing.assert_array_equal(read.points, POINTS)
    assert (read.times, read.rings, read.sequence) == (None, None, None)


@pytest.mark.parametrize("name", ODOMETRY)
def test_odometry_golden_bytes(name):
    encoding, payload = ODOMETRY[name]
    written = codecs.encode_odometry(OdometryMessage(STAMP, T_TURN), name)
    assert (written.payload, written.encoding, written.attachment) == (payload, encoding, None)
    read = codecs.decode_odometry(Sample("coview/r1/in/odom", payload, encoding))
    assert read.stamp_ns == STAMP
    np.testing.assert_array_equal(read.T_odom_body, T_TURN)


@pytest.mark.parametrize("name", POSES)
def test_pose_golden_bytes(name):
    encoding, payload = POSES[name]
    message = PoseMessage(STAMP, "r1", "TRACKING", T_TURN, COVARIANCE, 0.75, "ab", 0.1)
    written = codecs.encode_pose(message, name)
    assert (written.payload, written.encoding, written.attachment) == (payload, encoding, None)
    read = codecs.decode_pose(Sample("coview/r1/out/pose", payload, encoding))
    assert (read.stamp_ns, read.state, read.frame_id) == (STAMP, "TRACKING", "map")
    np.testing.assert_array_equal(read.T_map_body, T_TURN)
    if name in ("json", "cdr"):
        np.testing.assert_array_equal(read.covariance, COVARIANCE)
    else:  # unknown is not certain
        assert np.isnan(read.covariance).all()
    if name == "json":
        assert (read.robot, read.confidence, read.map_sha256, read.age) == ("r1", 0.75, "ab", 0.1)
    else:
        assert (read.robot, read.map_sha256) == ("", "")
        assert np.isnan([read.confidence, read.age]).all()


def test_json_pose_has_the_documented_fields():
    level = ProtectionLevel(0.25, 1.5, 0.2, 0.15)
    message = PoseMessage(STAMP, "r1", "TRACKING", T_TURN, COVARIANCE, 0.75, "ab", 0.1, "utm", level)
    fields = json.loads(codecs.encode_pose(message, "json").payload)
    assert list(fields) == [
        "stamp_ns", "robot", "state", "position", "orientation", "covariance", "confidence", "map_sha256",
        "age_s", "frame_id", "protection_level", "T_map_odom",
    ]  # fmt: skip
    assert fields["frame_id"] == "utm"
    assert fields["protection_level"] == {"m": 0.25, "deg": 1.5, "horizontal_m": 0.2, "vertical_m": 0.15}
    again = codecs.decode_pose(Sample("k", json.dumps(fields).encode()))
    assert (again.frame_id, again.protection) == ("utm", level)


@pytest.mark.parametrize("name", ["xyz", "foxglove", "cdr", "keelson"])
def test_packed_points_are_a_view_of_the_payload(name):
    encoding, payload = CLOUDS[name]
    read = codecs.decode_cloud(Sample("k", payload, encoding, ATTACHMENT))
    assert np.shares_memory(read.points, np.frombuffer(payload, np.uint8))
    assert not read.points.flags.writeable


@pytest.mark.slow
def test_importing_the_codecs_imports_neither_rosbags_nor_protobuf():
    import subprocess
    import sys

    code = (
        "import sys, coview_stream.messages\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('rosbags', 'foxglove_schemas_protobuf', 'google')])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
