"""Conventions of rmw_zenoh (ROS 2 over zenoh): type names, attachments and liveliness tokens.

A ROS 2 subscription drops samples without the attachment, and ``ros2 topic list`` shows only topics whose publisher
holds a token. Formats as in ROS 2 Jazzy and newer; Humble differs only in the type hash.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable

from coview_stream.errors import require_library
from coview_stream.messages.types import Encoded
from coview_stream.stream.transport.transport import Publisher

NO_HASH = "TypeHashNotSupported"
"""Replaces the type hash in ROS 2 Humble."""

_GID = 16
_ATTACHMENT = struct.Struct("<qqB16s")  # sequence, source time in ns, length of the gid, gid
_QOS = "::,10:,:,:,,"  # empty fields mean rmw_zenoh's defaults: reliable, volatile; keep the last 10
_NODE_ID = 0  # each of our sessions has one ROS node
_ROOT = "%"  # stands for '/' in a token; alone, it is the root enclave or the root namespace


def dds_type(name: str) -> str:
    """Spell a type such as ``sensor_msgs/msg/PointCloud2`` as DDS does: ``sensor_msgs::msg::dds_::PointCloud2_``."""
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def type_hash(name: str, humble: bool = False) -> str:
    """Return the RIHS01 hash of a ROS 2 message type, or Humble's placeholder."""
    if humble:
        return NO_HASH
    typesys = require_library("rosbags.typesys", "rosbags>=0.11", "the preset rmw_zenoh")
    return str(typesys.get_typestore(typesys.Stores.ROS2_JAZZY).hash_rihs01(name))


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """Pack 33 bytes: sequence number from 1, source time in nanoseconds, and the publisher's 16-byte identity."""
    return _ATTACHMENT.pack(sequence, stamp_ns, _GID, gid)


def gid_of(token: str) -> bytes:
    """Return a 16-byte publisher identity. ROS compares it but never recomputes it: any hash of the token is valid."""
    return hashlib.blake2b(token.encode(), digest_size=_GID).digest()


def node_token(domain: int, zid: str, node: str) -> str:
    """Return the liveliness token of a ROS 2 node in the root namespace; ``zid`` is our zenoh session's identity."""
    return f"@ros2_lv/{domain}/{zid}/{_NODE_ID}/{_NODE_ID}/NN/{_ROOT}/{_ROOT}/{node}"


def publisher_token(key: str, zid: str, node: str, entity_id: int) -> str:
    """Return the token of a publisher on ``key``, ``domain/topic.../type/hash``; ``entity_id`` must be unique."""
    domain, *topic, kind, digest = key.split("/")
    name = _ROOT + _ROOT.join(topic)
    return f"@ros2_lv/{domain}/{zid}/{_NODE_ID}/{entity_id}/MP/{_ROOT}/{_ROOT}/{node}/{name}/{kind}/{digest}/{_QOS}"


class RmwPublisher:
    """Publisher like a ROS 2 node's: with the attachment and without Encoding, as rmw_zenoh sets none.

    The identity in the attachment derives from ``token``, the publisher's liveliness token. ``now_ns`` returns the
    wall clock, nanoseconds: the source time from which ROS tools measure latency.
    """

    def __init__(self, inner: Publisher, token: str, now_ns: Callable[[], int]) -> None:
        self._inner = inner
        self._gid = gid_of(token)
        self._now_ns = now_ns
        self._sequence = 0

    def put(self, message: Encoded) -> None:
        """Publish with the next sequence number; on one thread at a time."""
        self._sequence += 1
        extra = attachment(self._sequence, self._now_ns(), self._gid)
        self._inner.put(Encoded(message.payload, "", extra))

    def close(self) -> None:
        """Undeclare."""
        self._inner.close()
