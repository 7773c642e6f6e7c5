"""Messages received from robots, described without their bytes; the modules ``*_checks`` judge them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.config.node import NodeConfig
from coview_stream.errors import MessageError
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, decode_cloud, decode_odometry, prepare
from coview_stream.messages.choose import MessageKind, codec_for
from coview_stream.messages.json_messages import read_status
from coview_stream.messages.types import OdometryMessage, Sample
from coview_stream.stream.node.counters import counter_of
from coview_stream.stream.transport.keys import NodeIdentity, RobotKeys
from coview_stream.stream.transport.transport import Transport

Wait = Callable[[float], object]
"""Waits for some seconds."""

Codecs = tuple[str | None, str | None]
"""Codecs of all clouds and all odometry; None: the codec that the message names."""

# limits on memory
_MAX_MESSAGES = 20_000  # per channel: enough for 30 s of the fastest IMU odometry
_MAX_KEPT = 30_000  # points kept of a cloud
_MAX_CLOUDS = 300  # clouds kept with their points
_MAX_COORDINATE = 1000.0  # metres: no lidar reaches farther; bytes read in a wrong format may have any size


@dataclass(frozen=True)
class CapturedMessage:
    """Description of one message."""

    arrived: float  # local time, seconds
    key: str  # key that it was published on
    encoding: str  # named by the sample; empty without one
    size: int  # bytes of the payload
    codec: str = ""  # codec that read it; empty if none could
    counter: str = ""  # name of the node's counter for a message that cannot be read
    reason: str = ""  # why it cannot be read
    readable_as: str = ""  # another codec that could read it
    stamp_ns: int | None = None  # sensor time; None if unreadable
    points: int = 0  # number of finite points
    distance: float = float("nan")  # median distance of the points, metres; NaN without points
    # first and last point, seconds after the stamp; None without a time per point
    sweep: tuple[float, float] | None = None
    T_odom_body: Pose | None = None  # (4, 4) odometry; None for clouds
    cloud: Points | None = None  # (N, 3) float32, some of the finite points; None after the first 300 clouds
    doubles: bool = False  # float32 rows that only make sense as float64


@dataclass
class RobotCapture:
    """Messages of one robot between the local times ``began`` and ``ended``, seconds, in order of arrival.

    ``status`` is the newest one, ``servers`` are the nodes that published any; ``alive``: a node holds its token.
    """

    keys: RobotKeys
    clouds: list[CapturedMessage] = field(default_factory=list)
    odometry: list[CapturedMessage] = field(default_factory=list)
    status: dict[str, Any] | None = None
    servers: set[str] = field(default_factory=set)
    alive: bool = False
    began: float = 0.0
    ended: float = 0.0
    ended_ns: int = 0  # wall clock, as in the status; 0 if nothing was captured


def capture_robots(
    transport: Transport,
    keys: Sequence[RobotKeys],
    seconds: float,
    codecs: Codecs = (None, None),
    wait: Wait = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> list[RobotCapture]:
    """Receive the robots' messages for ``seconds``; ``codecs`` override the ones that the messages name."""
    prepare(*CLOUD_CODECS, *ODOMETRY_CODECS)
    captures = [RobotCapture(k) for k in keys]
    over = False

    def keep(
        messages: list[CapturedMessage], describe: Callable[[Sample, float], CapturedMessage]
    ) -> Callable[[Sample], None]:
        def handler(sample: Sample) -> None:
            if not over and len(messages) < _MAX_MESSAGES:
                message = describe(sample, clock())
                messages.append(message if len(messages) < _MAX_CLOUDS else replace(message, cloud=None))

        return handler

    def keep_status(capture: RobotCapture) -> Callable[[Sample], None]:
        def handler(sample: Sample) -> None:
            with contextlib.suppress(MessageError):
                capture.status = read_status(sample)
                if (node := NodeIdentity.read(bytes(sample.payload))) is not None and not node.ending:
                    capture.servers.add(str(node))

        return handler

    for capture in captures:
        k = capture.keys
        capture.began = clock()
        odometry = keep(capture.odometry, partial(capture_odometry, option=codecs[1], hint=k.hint))
        transport.subscribe(k.odometry, odometry, "all")
        clouds = keep(capture.clouds, partial(capture_cloud, option=codecs[0], hint=k.hint))
        transport.subscribe(k.cloud, clouds, "all")
        transport.subscribe(k.status, keep_status(capture), "all")
    wait(seconds)
    over = True
    for capture in captures:
        capture.ended, capture.ended_ns = clock(), time.time_ns()
        capture.alive = bool(transport.tokens(capture.keys.alive))
    return captures


def capture_cloud(
    sample: Sample, arrived: float, option: str | None = None, hint: str | None = None
) -> CapturedMessage:
    """Describe a lidar frame, decoded as in the node."""
    captured, message = _capture("cloud", CLOUD_CODECS, decode_cloud, sample, arrived, option, hint)
    if message is None:
        return captured
    finite = message.points[np.isfinite(message.points).all(axis=1)]
    distances = np.linalg.norm(finite.astype(np.float64), axis=1)  # bytes in another format may have any size
    doubles = captured.codec in ("xyz", "xyzi") and _are_doubles(sample.payload, message.points)
    sweep = None
    if message.times is not None and np.isfinite(message.times).any():
        sweep = float(np.nanmin(message.times)), float(np.nanmax(message.times))
    return replace(
        captured,
        stamp_ns=message.stamp_ns,
        points=len(distances),
        distance=float(np.median(distances)) if len(distances) else float("nan"),
        sweep=sweep,
        doubles=doubles,
        cloud=None if doubles else np.array(finite[:: -(-len(finite) // _MAX_KEPT) or 1], dtype=np.float32),
    )


def capture_odometry(
    sample: Sample, arrived: float, option: str | None = None, hint: str | None = None
) -> CapturedMessage:
    """Describe an odometry sample, decoded as in the node."""
    captured, message = _capture("odometry", ODOMETRY_CODECS, decode_odometry, sample, arrived, option, hint)
    if message is None:
        return captured
    return replace(captured, stamp_ns=message.stamp_ns, T_odom_body=message.T_odom_body)


def _capture(
    channel: MessageKind,
    codecs: Mapping[str, Any],
    decode: Callable[..., Any],
    sample: Sample,
    arrived: float,
    option: str | None,
    hint: str | None,
) -> tuple[CapturedMessage, Any]:
    captured = CapturedMessage(arrived, sample.key, sample.encoding, len(sample.payload))
    try:
        message = decode(sample, option, hint, NodeConfig().max_payload)
    except MessageError as error:
        captured = replace(captured, counter=counter_of(error), reason=str(error))
        if captured.counter == "oversized":
            return captured, None
        return replace(captured, readable_as=_readable_as(codecs, decode, sample)), None
    return replace(captured, codec=codec_for(channel, codecs, sample, option, hint)), message


def _readable_as(codecs: Mapping[str, Any], decode: Callable[..., Any], sample: Sample) -> str:
    """Return a codec that reads plausible values; the strictest formats are tried first, raw rows last."""
    for name in sorted(codecs, key=lambda name: name in ("xyzi", "xyz")):
        try:
            message = decode(sample, name, None)
        except MessageError:
            continue
        if isinstance(message, OdometryMessage):
            return name
        if len(message.points) > 0 and _plausible(message.points):
            return name
    return ""


def _plausible(numbers: npt.NDArray[Any]) -> bool:
    """Whether all numbers can be coordinates, metres.

    As float32, denormal numbers and integers are next to zero; text and protobuf are beyond any lidar's range.
    """
    size = np.abs(numbers)
    return bool((np.isnan(size) | (size == 0) | ((size > 1e-6) & (size < _MAX_COORDINATE))).all())


def _are_doubles(payload: bytes, points: Points) -> bool:
    """Whether float32 rows are really float64: only as float64 can they be coordinates."""
    if len(points) < 2 or len(payload) % 8 or _plausible(points):
        return False
    with np.errstate(invalid="ignore"):
        return _plausible(np.frombuffer(payload, "<f8"))
