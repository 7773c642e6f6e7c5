import pytest
import zenoh
from zenoh.ext import Int64, z_deserialize, z_serialize

from coview_stream.messages.types import Encoded, Sample
from coview_stream.messages.validation import read_attachment
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.stream.transport.rmw import (
    RmwPublisher,
    attachment,
    dds_type,
    gid_of,
    node_token,
    publisher_token,
    type_hash,
)

ZID = "aac3178e146ba6f1fc6e6a4085e77f21"
GID = bytes(range(16))


def test_rmw_attachment_golden_bytes():
    data = attachment(5, 1_700_000_000_123_456_789, GID)
    assert data.hex() == "0500000000000000" + "15cd853dfe9c9717" + "10" + GID.hex()
    assert read_attachment(data) == (1_700_000_000_123_456_789, 5)


def test_rmw_attachment_equals_zenoh_serialization():
    theirs = z_serialize((Int64(-3), Int64(2**62), GID))
    assert attachment(-3, 2**62, GID) == theirs.to_bytes()
    decoded = z_deserialize(tuple[Int64, Int64, bytes], zenoh.ZBytes(attachment(7, 8, GID)))
    assert tuple(decoded) == (7, 8, GID)


@pytest.mark.parametrize("data", [b"", bytes(33), attachment(1, 2, GID)[:-1], attachment(1, 2, GID) + b"x"])
def test_other_attachments_are_not_rmw_attachments(data):
    assert read_attachment(data) == (None, None)


def test_dds_type_names_and_type_hashes():
    assert dds_type("sensor_msgs/msg/PointCloud2") == "sensor_msgs::msg::dds_::PointCloud2_"
    for name, digest in {
        "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
        "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
        "geometry_msgs/msg/PoseWithCovarianceStamped": (
            "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
        ),
    }.items():
        assert type_hash(name) == f"RIHS01_{digest}"
        assert type_hash(name, humble=True) == "TypeHashNotSupported"


def test_liveliness_tokens_match_rmw_zenoh():
    # the example of rmw_zenoh's own design notes
    assert node_token(0, ZID, "listener") == f"@ros2_lv/0/{ZID}/0/0/NN/%/%/listener"
    key = robot_keys("rmw_zenoh", "coview", "bot1", domain=7).pose
    assert publisher_token(key, ZID, "coview", 10) == (
        f"@ros2_lv/7/{ZID}/0/10/MP/%/%/coview/%bot1%coview%pose/"
        "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/"
        "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e/::,10:,:,:,,"
    )


def test_rmw_publisher_adds_sequence_and_gid_without_encoding():
    net = MemoryTransport()
    keys = [robot_keys("rmw_zenoh", "coview", name, domain=7).pose for name in ("a", "b")]
    tokens = [publisher_token(key, ZID, "coview", number) for number, key in enumerate(keys, 1)]
    for token in (*tokens, node_token(7, ZID, "coview")):
        assert str(zenoh.KeyExpr(token)) == token
    first, second = (
        RmwPublisher(net.publisher(key, "realtime"), token, lambda: 123)
        for key, token in zip(keys, tokens, strict=True)
    )
    first.put(Encoded(b"x", "application/cdr;unknown"))
    first.put(Encoded(b"y"))
    second.put(Encoded(b"z"))
    second.close()
    second.put(Encoded(b"late"))
    gids = [gid_of(token) for token in tokens]
    assert len(set(gids)) == 2
    assert net.published == [
        Sample(keys[0], b"x", "", attachment(1, 123, gids[0])),
        Sample(keys[0], b"y", "", attachment(2, 123, gids[0])),
        Sample(keys[1], b"z", "", attachment(1, 123, gids[1])),
    ]
