"""Which codec reads a sample: option > Encoding > key > hint > magic."""

import pytest
from codec_bytes import POINTS, STAMP, XYZ, cdr_cloud

from coview_stream import messages as codecs
from coview_stream.errors import ConfigError, EncodingError, MessageError
from coview_stream.messages import OversizedError
from coview_stream.messages.choose import codec_for
from coview_stream.messages.types import Sample

NATIVE = "coview/r1/in/cloud"
RMW = "0/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_9198cabf"
RMW_ODOM = "0/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported"
KEELSON = "rise/@v0/boat/pubsub/point_cloud/lidar/0"


def cloud_codec(payload=b"?", encoding="", key=NATIVE, option=None, hint=None):
    return codec_for("cloud", codecs.CLOUD_CODECS, Sample(key, payload, encoding), option, hint)


def odometry_codec(payload=b"?", encoding="", key="coview/r1/in/odom", option=None, hint=None):
    return codec_for("odometry", codecs.ODOMETRY_CODECS, Sample(key, payload, encoding), option, hint)


@pytest.mark.parametrize(
    ("codec", "encoding", "name"),
    [
        (cloud_codec, "application/octet-stream;layout=xyz", "xyz"),
        (cloud_codec, 'Application/Octet-Stream ; Layout = "XYZI"', "xyzi"),
        (cloud_codec, "zenoh/bytes;layout=xyz", "xyz"),
        (cloud_codec, "application/cdr", "cdr"),
        (cloud_codec, "application/cdr;sensor_msgs/msg/PointCloud2", "cdr"),
        (cloud_codec, "application/cdr; sensor_msgs::msg::dds_::PointCloud2_", "cdr"),
        (cloud_codec, "application/cdr;schema='sensor_msgs/PointCloud2'", "cdr"),
        (cloud_codec, "application/protobuf;foxglove.PointCloud", "foxglove"),
        (cloud_codec, "application/protobuf; schema=foxglove.PointCloud", "foxglove"),
        (cloud_codec, 'application/x-protobuf;schema="foxglove.PointCloud"; v=1', "foxglove"),
        (cloud_codec, "application/protobuf", "foxglove"),
        (cloud_codec, "application/protobuf;core.Envelope", "keelson"),
        (odometry_codec, "application/json", "json"),
        (odometry_codec, "text/json; charset=utf-8", "json"),
        (odometry_codec, "application/cdr;nav_msgs/msg/Odometry", "cdr"),
        (odometry_codec, "application/protobuf;foxglove.PoseInFrame", "foxglove"),
        (odometry_codec, "application/protobuf;foxglove.FrameTransform", "foxglove"),
    ],
)
def test_common_spellings_of_encodings(codec, encoding, name):
    assert codec(encoding=encoding) == name


@pytest.mark.parametrize(
    ("encoding", "named"),
    [
        ("application/cbor", "application/cbor"),
        ("application/octet-stream;layout=xyzrgb", "xyzrgb"),
        ("application/protobuf;foxglove.LaserScan", "foxglove.laserscan"),
        ("application/cdr;nav_msgs/msg/Odometry", "nav_msgs/msg/Odometry"),
        ("application/cdr;foxglove_msgs/msg/PointCloud", "foxglove_msgs/msg/PointCloud"),
        ("application/cdr;foxglove.PointCloud", "contradicts itself"),
        ("application/json", "application/json"),
        ("application/cdr;" + 300 * "x", "application/cdr;xxx"),
    ],
)
def test_encoding_not_usable_for_clouds_is_named(encoding, named):
    with pytest.raises(EncodingError) as caught:
        cloud_codec(encoding=encoding)
    assert named in str(caught.value)
    assert NATIVE in str(caught.value)
    assert len(str(caught.value)) < 300


def test_option_beats_encoding_beats_key_beats_hint_beats_magic():
    cdr = b"\0\1\0\0"
    said = "application/octet-stream;layout=xyz"
    assert cloud_codec(cdr, said, KEELSON, option="xyzi", hint="foxglove") == "xyzi"
    assert cloud_codec(cdr, said, KEELSON, hint="foxglove") == "xyz"
    assert cloud_codec(cdr, "", KEELSON, hint="foxglove") == "keelson"
    assert cloud_codec(cdr, "", NATIVE, hint="foxglove") == "foxglove"
    assert cloud_codec(cdr, "", NATIVE) == "cdr"


@pytest.mark.parametrize("mute", ["", "zenoh/bytes", "zenoh/string", "application/octet-stream", " Zenoh/Bytes "])
def test_generic_encodings_fall_back_to_key_hint_and_magic(mute):
    assert cloud_codec(b"?", mute, RMW) == "cdr"
    assert cloud_codec(b"?", mute, NATIVE, hint="xyz") == "xyz"
    assert cloud_codec(b"\0\0\0\0", mute) == "cdr"
    assert odometry_codec(b'{"stamp_ns":1}', mute) == "json"
    for payload in (b"\1\2\3\4", b"{}"):  # JSON is not a cloud
        with pytest.raises(EncodingError, match=r"no encoding is set|json .*cannot carry"):
            cloud_codec(payload, mute)


def test_bare_protobuf_is_decided_by_key_or_hint():
    assert cloud_codec(encoding="application/protobuf", key=KEELSON, hint="foxglove") == "keelson"
    assert cloud_codec(encoding="application/protobuf", hint="keelson") == "keelson"
    assert cloud_codec(encoding="application/protobuf", hint="cdr") == "foxglove"


@pytest.mark.parametrize(
    "key",
    [RMW_ODOM, "0/x/tf2_msgs::msg::dds_::TFMessage_/RIHS01_ab", KEELSON.replace("point_cloud", "frame_transform")],
)
def test_key_with_non_cloud_type_is_an_error_naming_it(key):
    with pytest.raises(EncodingError, match=r"cannot carry|no codec knows") as caught:
        cloud_codec(b"\0\1\0\0", "", key)
    assert key in str(caught.value)


def test_odometry_codec_from_key():
    assert odometry_codec(b"?", "", RMW_ODOM) == "cdr"
    assert odometry_codec(b"?", "", KEELSON.replace("point_cloud", "frame_transform")) == "keelson"


@pytest.mark.parametrize("where", ["option", "hint"])
@pytest.mark.parametrize("name", ["pcd", "json", ""])
def test_option_or_hint_of_wrong_channel_is_refused(where, name):
    with pytest.raises(ConfigError, match=r"xyz, xyzi, foxglove, cdr, keelson"):
        cloud_codec(**{where: name})
    with pytest.raises(ConfigError):
        codecs.encode_pose(None, "xyz")


def test_an_rmw_attachment_gives_stamp_and_sequence():
    attachment = (41).to_bytes(8, "little") + STAMP.to_bytes(8, "little") + b"\x10" + bytes(16)
    raw = Sample(NATIVE, POINTS.tobytes(), "application/octet-stream;layout=xyz", attachment)
    assert codecs.decode_cloud(raw).stamp_ns == STAMP
    assert codecs.decode_cloud(raw).sequence == 41
    cdr = Sample(RMW, cdr_cloud(POINTS.tobytes(), XYZ, 12, 2), "", attachment[:16] + b"\x11" + bytes(16))
    assert codecs.decode_cloud(cdr).sequence is None


def test_oversized_payload_raises_its_own_error_naming_the_key():
    with pytest.raises(OversizedError, match=f"{NATIVE}: a cloud of 4294967295 points"):
        codecs.decode_cloud(Sample(NATIVE, cdr_cloud(POINTS.tobytes(), XYZ, 12, 2**32 - 1, row_step=0)))
    with pytest.raises(OversizedError, match="67108865 bytes"):
        codecs.decode_cloud(Sample(NATIVE, bytes(codecs.MAX_PAYLOAD + 1)))
    assert issubclass(OversizedError, MessageError)
    assert not issubclass(OversizedError, EncodingError)
