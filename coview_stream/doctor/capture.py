"""What was received of a robot, message by message, without the bytes; the other modules judge it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.errors import EncodingError, MessageError
from coview_stream.geometry.transforms import Pose
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, decode_cloud, decode_odometry
from coview_stream.messages.choose import Channel, codec_for
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample
from coview_stream.stream.node.decoding import received
from coview_stream.stream.transport.keys import RobotKeys

_PLAUSIBLE = 1000.0  # metres: farther no lidar sees; bytes read in the wrong format hold numbers of any size


@dataclass(frozen=True)
class Seen:
    """One message.

    Attributes:
        arrived: local time, seconds.
        key: that it came on.
        encoding: that it named, empty if none.
        size: bytes.
        codec: that read it; empty if none could.
        trouble: name of the counter it falls under if it cannot be read, else empty.
        reason: why it cannot be read.
        readable_as: codec that could read it if it were named, empty if there is none.
        stamp_ns: sensor time, None if it cannot be read.
        points: number of points, finite ones.
        distance: median distance of the points, metres, NaN without points.
        sweep: seconds after the stamp of the first and the last point, None without a time per point.
        T_odom_body: (4, 4) odometry, None for clouds.
    """

    arrived: float
    key: str
    encoding: str
    size: int
    codec: str = ""
    trouble: str = ""
    reason: str = ""
    readable_as: str = ""
    stamp_ns: int | None = None
    points: int = 0
    distance: float = float("nan")
    sweep: tuple[float, float] | None = None
    T_odom_body: Pose | None = None


@dataclass
class Heard:
    """What was heard of one robot between two local times (seconds).

    Attributes:
        keys: where.
        clouds: in order of arrival.
        odometry: likewise.
        status: newest of the node, None if it said nothing.
        alive: whether a node holds the liveliness token.
        began: when listening began.
        ended: when it ended.
    """

    keys: RobotKeys
    clouds: list[Seen] = field(default_factory=list)
    odometry: list[Seen] = field(default_factory=list)
    status: dict[str, Any] | None = None
    alive: bool = False
    began: float = 0.0
    ended: float = 0.0


def see_cloud(sample: Sample, arrived: float, option: str | None = None, hint: str | None = None) -> Seen:
    """Read a lidar frame as the node would, and keep what describes it."""
    seen, message = _see("cloud", CLOUD_CODECS, decode_cloud, sample, arrived, option, hint)
    if message is None:
        return seen
    distances = np.linalg.norm(message.points, axis=1)
    distances = distances[np.isfinite(distances)]
    sweep = None
    if message.times is not None and np.isfinite(message.times).any():
        sweep = float(np.nanmin(message.times)), float(np.nanmax(message.times))
    return replace(
        seen,
        stamp_ns=message.stamp_ns,
        points=len(distances),
        distance=float(np.median(distances)) if len(distances) else float("nan"),
        sweep=sweep,
    )


def see_odometry(sample: Sample, arrived: float, option: str | None = None, hint: str | None = None) -> Seen:
    """Read an odometry sample as the node would."""
    seen, message = _see("odometry", ODOMETRY_CODECS, decode_odometry, sample, arrived, option, hint)
    return (
        seen if message is None else replace(seen, stamp_ns=message.stamp_ns, T_odom_body=message.T_odom_body)
    )


def _see(
    channel: Channel,
    codecs: Mapping[str, Any],
    decode: Callable[[Sample, str | None, str | None], Any],
    sample: Sample,
    arrived: float,
    option: str | None,
    hint: str | None,
) -> tuple[Seen, Any]:
    message, trouble, reason = received(sample, decode, option, hint, NodeConfig().max_payload)
    seen = Seen(arrived, sample.key, sample.encoding, len(sample.payload), trouble=trouble, reason=reason)
    if message is not None:
        return replace(seen, codec=codec_for(channel, codecs, sample, option, hint)), message
    if trouble == "oversized":
        return seen, None
    return replace(seen, readable_as=_readable_as(codecs, decode, sample)), None


def _readable_as(
    codecs: Mapping[str, Any], decode: Callable[[Sample, str | None, str | None], Any], sample: Sample
) -> str:
    """Name of the codec that makes sense of a sample; the formats that check most come first, raw rows last."""
    raw = ("xyzi", "xyz")
    for name in [name for name in codecs if name not in raw] + [name for name in raw if name in codecs]:
        try:
            message = decode(sample, name, None)
        except (EncodingError, MessageError):
            continue
        if _makes_sense(message):
            return name
    return ""


def _makes_sense(message: CloudMessage | OdometryMessage) -> bool:
    if isinstance(message, OdometryMessage):
        return True
    size = np.abs(message.points)
    # denormal numbers and integers read as float32 are next to zero, text and protobuf beyond all lidars
    plain = np.isnan(size) | (size == 0) | ((size > 1e-6) & (size < _PLAUSIBLE))
    return len(size) > 0 and bool(plain.all())
