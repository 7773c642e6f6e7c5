"""Nothing but a message or a MessageError comes out of any bytes."""

import json
import struct
import tracemalloc

import numpy as np
import pytest
from codec_bytes import (
    POINTS,
    STAMP,
    T_TURN,
    XYZ,
    Cdr,
    cdr_cloud,
    cdr_odometry,
    cdr_pose,
    doubles,
    envelope,
    header,
    pb_cloud,
    pb_in_frame,
    pb_transform,
    sized,
    stamp,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream import messages as codecs
from coview_stream.errors import MessageError
from coview_stream.messages import OversizedError
from coview_stream.messages.types import CloudMessage, OdometryMessage, PoseMessage, Sample

ROWS = POINTS.tobytes()
DECODERS = [
    *((codecs.decode_cloud, name) for name in codecs.CLOUD_CODECS),
    *((codecs.decode_odometry, name) for name in codecs.ODOMETRY_CODECS),
    *((codecs.decode_pose, name) for name in codecs.POSE_CODECS),
]
VALID = {
    "xyz": ROWS,
    "xyzi": ROWS + bytes(8),
    "foxglove": pb_cloud(ROWS, XYZ, 12),
    "cdr": cdr_cloud(ROWS, XYZ, 12, 2),
    "keelson": envelope(pb_cloud(ROWS, XYZ, 12)),
    "json": b'{"stamp_ns":1,"position":[1,2,3],"orientation":[0,0,0,1]}',
}
OTHER_VALID = [pb_in_frame(), pb_transform(), envelope(pb_transform()), cdr_odometry(), cdr_pose().done()]


def refused(decode, payload, name, attachment=bytes(8)):
    with pytest.raises(MessageError) as caught:
        decode(Sample("some/key", payload, "", attachment), option=name)
    assert str(caught.value).startswith("some/key: ")
    return str(caught.value)


@pytest.mark.parametrize(
    ("payload", "attachment", "reason"),
    [
        (ROWS, None, "no stamp"),
        (ROWS, b"", "no stamp"),
        (ROWS, bytes(7), "no stamp"),
        (ROWS, bytes(33), "no stamp"),
        (ROWS[:-1], bytes(8), "not a whole number"),
    ],
)
def test_malformed_raw_clouds_are_refused(payload, attachment, reason):
    assert reason in refused(codecs.decode_cloud, payload, "xyz", attachment)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\0\1\0\0", "truncated"),
        (VALID["cdr"][:-30], "PointCloud2"),
        (VALID["cdr"] + bytes(9), "PointCloud2"),
        (b"\0\7" + VALID["cdr"][2:], "PointCloud2"),  # XCDR2
        (cdr_cloud(ROWS, XYZ, 12, 2, nanos=10**9), "nanoseconds"),
        (cdr_cloud(ROWS, XYZ, 12, 3), "truncated"),
        (cdr_cloud(ROWS, XYZ[:2], 12, 2), "'z'"),
        (cdr_cloud(ROWS, [*XYZ[:2], ("z", 8, 9)], 12, 2), "'z'"),
        (cdr_cloud(ROWS, [*XYZ, ("x", 0, 7)], 12, 2), "'x' occurs twice"),
        (cdr_cloud(ROWS, [*XYZ[:2], ("z", 9, 7)], 12, 2), "exceeds a point"),
        (cdr_cloud(ROWS, [*XYZ[:2], ("z", 2**32 - 1, 7)], 12, 2), "exceeds a point"),
        (cdr_cloud(ROWS, XYZ, 0, 2), "exceeds a point"),
        (cdr_cloud(ROWS, XYZ, 12, 1, height=2, row_step=11), "row step"),
        (cdr_cloud(ROWS, XYZ, 12, 1, height=2, row_step=13), "truncated"),
        (cdr_cloud(ROWS, XYZ, 12, 2**32 - 1, height=2**32 - 1, row_step=2**32 - 1), "at most"),
        (header().put("I", 1, 1, 2**32 - 1).done(), "fields"),
        (header().put("I", 1, 1, 1).put("I", 2**31).done(), "PointCloud2"),
        (header().put("I", 1, 1, 0).put("B", 0).put("I", 12, 12, 2**32 - 1).done(), "PointCloud2"),
        (VALID["cdr"].replace(b"base_link", b"\xff\xfe\xfd\xfclink_"), "PointCloud2"),
        (Cdr().put("i", 1).put("I", 1, 2**32 - 1).done(), "PointCloud2|truncated"),
    ],
)
def test_malformed_point_cloud_2_is_refused(payload, reason):
    message = refused(codecs.decode_cloud, payload, "cdr")
    assert any(part in message for part in reason.split("|"))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xff", "truncated"),
        (b"\x0b", "not a protobuf"),  # a group
        (b"\x02\x00", "malformed"),  # field number 0
        (VALID["foxglove"][:-1], "truncated"),
        (b"\x32\xff\xff\xff\xff\x0f", "truncated"),  # 4 GiB of points announced
        (300 * sized(5, b""), "more than 256"),
        (pb_cloud(ROWS, XYZ, 0), "rows of 0 bytes"),
        (pb_cloud(ROWS, XYZ, 13), "rows of 13 bytes"),
        (pb_cloud(ROWS, XYZ[:2], 12), "'z'"),
        (pb_cloud(ROWS, [*XYZ[:2], ("z", 8, 99)], 12), "'z'"),
        (pb_cloud(ROWS, XYZ, 12, head=b""), "no timestamp"),
        (pb_cloud(ROWS, XYZ, 12, head=stamp(2**63 - 1)), "int64"),
        (pb_cloud(ROWS, XYZ, 12, head=stamp(1, -1)), "nanoseconds"),
        (pb_cloud(ROWS, [*XYZ, ("x", 0, 7)], 12), "'x' occurs twice"),
        (stamp() + sized(2, b"\xff"), "PointCloud"),
        (pb_cloud(ROWS, XYZ, 12, pose=sized(1, doubles(np.nan, 0, 0))), "not finite"),
    ],
)
def test_malformed_foxglove_clouds_are_refused(payload, reason):
    assert reason in refused(codecs.decode_cloud, payload, "foxglove")
    assert reason in refused(codecs.decode_cloud, envelope(payload), "keelson")


def test_empty_keelson_envelope_is_refused():
    assert "no payload" in refused(codecs.decode_cloud, stamp(), "keelson")


@pytest.mark.parametrize(
    ("position", "quaternion", "reason"),
    [
        ((np.nan, 0, 0), (0, 0, 0, 1), "not finite"),
        ((0, 0, 0), (0, 0, 0, np.inf), "not finite"),
        ((0, 0, 2e8), (0, 0, 0, 1), "from its origin"),
        ((0, 0, 0), (0, 0, 0, 0), "norm 0"),
        ((0, 0, 0), (0, 0, 0, 1.02), "norm 1.02"),
    ],
)
def test_odometry_with_invalid_pose_is_refused(position, quaternion, reason):
    pose = {"position": position, "quaternion": quaternion}
    assert reason in refused(codecs.decode_odometry, cdr_odometry(**pose), "cdr")
    assert reason in refused(codecs.decode_odometry, pb_in_frame(**pose), "foxglove")
    text = json.dumps({"stamp_ns": 1, "position": position, "orientation": quaternion})
    if "NaN" not in text and "Infinity" not in text:
        assert reason in refused(codecs.decode_odometry, text.encode(), "json")


def test_float32_quaternion_is_normalized():
    read = codecs.decode_odometry(Sample("k", cdr_odometry(quaternion=(0.501, 0.501, 0.501, 0.501))))
    np.testing.assert_allclose(read.T_odom_body, T_TURN, atol=1e-12)


def test_quaternions_match_scipy():
    from scipy.spatial.transform import Rotation

    for rotation in Rotation.random(20, random_state=1):
        read = codecs.decode_odometry(Sample("k", cdr_odometry(quaternion=rotation.as_quat())))
        np.testing.assert_allclose(read.T_odom_body[:3, :3], rotation.as_matrix(), atol=1e-12)


def odometry_json(**changes):
    return json.dumps({"stamp_ns": 1, "position": [1, 2, 3], "orientation": [0, 0, 0, 1], **changes}).encode()


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "no JSON"),
        (b"[]", "not an object"),
        (b"\xff\xfe{", "no JSON"),
        (b"[" * 60_000, "no JSON"),
        (b'{"stamp_ns":' + b"9" * 5000 + b"}", "no JSON"),
        (b'{"stamp_ns":1,"stamp_ns":1}', "twice"),
        (odometry_json(position=[1, 2, float("nan")]), "NaN"),
        (odometry_json(position=[1, 2, float("-inf")]), "-Infinity"),
        (odometry_json().replace(b"3]", b"1e999]"), "position"),
        (odometry_json(position=[1, 2, 10**400]), "position"),
        (odometry_json(position=[1, 2]), "3 numbers"),
        (odometry_json(position=[1, 2, True]), "position"),
        (odometry_json(position=[1, 2, "3"]), "position"),
        (odometry_json(position={"x": 1}), "3 numbers"),
        (odometry_json(orientation=[0, 0, 1]), "4 numbers"),
        (odometry_json(stamp_ns=1.0), "type float"),
        (odometry_json(stamp_ns=True), "type bool"),
        (odometry_json(stamp_ns=None), "type NoneType"),
        (odometry_json(stamp_ns=2**63), "int64"),
        (odometry_json().replace(b'"stamp_ns": 1', b'"stamp_ns": ' + b"[" * 400 + b"]" * 400), "type list"),
    ],
)
def test_malformed_json_odometry_is_refused(payload, reason):
    assert reason in refused(codecs.decode_odometry, payload, "json")


def test_json_over_64_kib_is_oversized_and_extra_fields_are_ignored():
    assert codecs.decode_odometry(Sample("k", odometry_json(twist=[1, None], note="x"))).stamp_ns == 1
    with pytest.raises(OversizedError):
        codecs.decode_odometry(Sample("k", odometry_json(note=65536 * "x")))


@pytest.mark.parametrize(
    "changes",
    [
        {"robot": 1},
        {"state": None},
        {"covariance": [0] * 35},
        {"confidence": "1"},
        {"age_s": None},
        {"map_sha256": "\ud800"},
        {"protection_level": 0.1},
        {"T_map_odom": [1, 2, 3]},
        {"T_map_odom": {"position": [1, 2, 3]}},
        {"protection_level": {"m": 0.1, "deg": 1.0}},
    ],
)
def test_malformed_json_poses_are_refused(changes):
    message = PoseMessage(STAMP, "r1", "TRACKING", T_TURN, np.eye(6), 0.75, "ab")
    fields = json.loads(codecs.encode_pose(message, "json").payload)
    for name, value in changes.items():
        fields[name] = value
        assert name in refused(codecs.decode_pose, json.dumps(fields).encode(), "json")


def test_encoding_refuses_unrepresentable_messages():
    lost = np.full((4, 4), np.nan)
    lost[:3, :3] = np.eye(3)
    with pytest.raises(MessageError, match="NaN"):
        codecs.encode_odometry(OdometryMessage(STAMP, lost), "json")
    with pytest.raises(MessageError, match="32-bit"):
        codecs.encode_cloud(CloudMessage(2**62, POINTS), "cdr")


@pytest.mark.parametrize("name", ["cdr", "foxglove", "keelson"])
def test_huge_field_counts_allocate_no_memory(name):
    many = 300_000
    field = struct.pack("<I", 1) + bytes(4) + bytes(4) + b"\7\0\0\0" + bytes(4)
    payload = {
        "cdr": header().put("I", 1, 1, many).done() + many * field,
        "foxglove": stamp() + many * sized(5, b""),
        "keelson": envelope(stamp() + many * sized(5, b"")),
    }[name]
    codecs.prepare(name)
    tracemalloc.start()
    try:
        refused(codecs.decode_cloud, payload, name)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def message_error(decode, sample, **choice):
    """Return the text of the MessageError; None if a message came out. Any other error fails the test."""
    try:
        decode(sample, **choice)
    except MessageError as error:
        return str(error)
    return None


@settings(max_examples=40, deadline=None)
@given(payload=st.binary(max_size=400), attachment=st.none() | st.binary(max_size=40))
@pytest.mark.parametrize(("decode", "name"), DECODERS)
def test_random_bytes_raise_message_error(decode, name, payload, attachment):
    said = message_error(decode, Sample("some/key", payload, "", attachment), option=name)
    assert said is None or said.startswith("some/key: ")


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(data=st.data())
@pytest.mark.parametrize(("decode", "name"), DECODERS)
def test_mutated_messages_raise_only_message_error(decode, name, data):
    payload = bytearray(data.draw(st.sampled_from([*VALID.values(), *OTHER_VALID])))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]))
    cut = data.draw(st.sampled_from([0, 0, 1, 5]))
    sample = Sample("some/key", bytes(payload[: len(payload) - cut]), "", bytes(8))
    said = message_error(decode, sample, option=name)
    assert said is None or said.startswith("some/key: ")


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(payload=st.binary(max_size=60), encoding=st.text(max_size=40), key=st.text(max_size=40))
@pytest.mark.parametrize("decode", [codecs.decode_cloud, codecs.decode_odometry, codecs.decode_pose])
def test_random_encodings_and_keys_raise_only_message_error(decode, payload, encoding, key):
    for said in (encoding, "application/cdr;" + encoding, "application/octet-stream;" + encoding):
        problem = message_error(decode, Sample(key, payload, said))
        assert problem is None or key in problem
