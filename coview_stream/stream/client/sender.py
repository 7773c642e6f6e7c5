"""Publisher of one robot's clouds and odometry, in the encodings and on the keys of a preset."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from coview_stream.errors import CloudError, ConfigError, InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, is_pose, why_no_pose
from coview_stream.geometry.validation import cloud_rows, to_array
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, Encoded, OdometryMessage
from coview_stream.stream.transport.keys import RobotKeys, check_expression
from coview_stream.stream.transport.rmw import RmwPublisher, publisher_token, type_hash
from coview_stream.stream.transport.transport import Publisher, Transport, Urgency

_TIMED = {"xyz": "foxglove", "xyzi": "foxglove"}  # raw rows cannot hold times
_SETTLE = 0.3  # seconds; see Sender.settle
_MAX_STAMP = 2**63 / 1e9  # seconds; int64 nanoseconds end there


class Sender:
    """Encoder and publishers of one robot's clouds and odometry; encoding and publishing may use different threads.

    The caller closes ``transport``. Encodings are names of codecs; None: the preset's, else ``xyz`` and ``json``.

    Raises:
        ConfigError: an encoding is unknown, or a key cannot be published to.
    """

    def __init__(
        self,
        transport: Transport,
        keys: RobotKeys,
        cloud_encoding: str | None = None,
        odometry_encoding: str | None = None,
    ) -> None:
        self._chosen = cloud_encoding is not None
        self.cloud_encoding = cloud_encoding or keys.hint or "xyz"
        self.odometry_encoding = odometry_encoding or keys.hint or "json"
        for name, known, option in (
            (self.cloud_encoding, tuple(CLOUD_CODECS), "cloud encoding"),
            (self.odometry_encoding, tuple(ODOMETRY_CODECS), "odometry encoding"),
        ):
            if name not in known:
                raise ConfigError(f"{option} {name!r} is unknown: choose one of {', '.join(known)}")
        self.cloud_key = _publishing_key(keys.cloud, keys.rmw, "sensor_msgs/msg/PointCloud2", "--cloud-key")
        self.odometry_key = _publishing_key(keys.odometry, keys.rmw, "nav_msgs/msg/Odometry", "--odometry-key")
        self._bare = keys.hint is not None
        self._last_cloud = -math.inf
        self._cloud = _publisher(transport, self.cloud_key, "bulk", keys.rmw)
        self._odometry = _publisher(transport, self.odometry_key, "data", keys.rmw)

    def cloud(self, points: npt.ArrayLike, stamp_ns: int, times: Floats | None = None) -> Encoded:
        """Encode (N, 3) body-frame points, metres; a fourth column is ignored. ``times`` as in CloudMessage.

        Raises:
            CloudError: the array has another shape or is not numeric, or no point is finite.
            InputError: ``times`` is not numeric or has another length.
        """
        rows = cloud_rows(points)
        if times is not None and np.shape(times) != (len(rows),):
            raise InputError(f"times of shape {np.shape(times)} do not fit {len(rows)} points")
        encoding = self.cloud_encoding
        if times is not None and not self._chosen:
            encoding = _TIMED.get(encoding, encoding)
        xyz = np.ascontiguousarray(rows)
        if not np.isfinite(xyz[:, 0] + xyz[:, 1] + xyz[:, 2]).any():  # many times faster than all(axis=1)
            raise CloudError(f"a cloud of {len(xyz)} points, none of them finite: leave such frames out")
        seconds = None if times is None else to_array(times, np.float64, "times", InputError)
        return self._with_convention(encode_cloud(CloudMessage(stamp_ns, xyz, seconds), encoding))

    def odometry(self, T_odom_body: Pose, stamp_ns: int) -> Encoded:
        """Encode a (4, 4) pose, odometry <- body, metres; InputError if it is not a rigid transform."""
        T = to_array(T_odom_body, np.float64, "T_odom_body", InputError)
        if not is_pose(T):
            raise InputError(f"T_odom_body (odometry <- body) {why_no_pose(T)}")
        return self._with_convention(encode_odometry(OdometryMessage(stamp_ns, T), self.odometry_encoding))

    def put_cloud(self, message: Encoded) -> None:
        """Publish a cloud; it is dropped if the link is congested."""
        self._cloud.put(message)
        self._last_cloud = time.monotonic()

    def put_odometry(self, message: Encoded) -> None:
        """Publish an odometry sample. Never waits: up to 1024 queue for the link, then the oldest is dropped."""
        self._odometry.put(message)

    def settle(self) -> None:
        """Wait for the last frame to leave: zenoh sends large ones in the background and drops them when it closes.

        In a measurement no 1 MB frame put just before the session closed arrived, and zenoh has no call to flush.
        """
        time.sleep(max(0.0, self._last_cloud + _SETTLE - time.monotonic()))

    def close(self) -> None:
        """Undeclare both publishers."""
        self._cloud.close()
        self._odometry.close()

    def _with_convention(self, message: Encoded) -> Encoded:
        # a convention without Encoding is followed byte for byte: readers tested against this sender must work with it
        return replace(message, encoding="") if self._bare else message


def nanoseconds(stamp: float) -> int:
    """Convert seconds to nanoseconds; InputError if not a number or beyond int64 (usually nanoseconds already)."""
    try:
        plausible = bool(abs(stamp) < _MAX_STAMP)  # False for NaN
    except (TypeError, ValueError):  # not a number
        plausible = False
    if not plausible:
        raise InputError(f"stamp {stamp!r}: give seconds of sensor time, not nanoseconds")
    whole = math.floor(stamp)  # separately: a product of today's seconds and 1e9 is off by 128 ns
    return whole * 1_000_000_000 + round((float(stamp) - whole) * 1e9)


def _publishing_key(expression: str, rmw: bool, type_name: str, option: str) -> str:
    """Turn a key expression for subscribing into a key to publish to: a final wildcard gets a name."""
    head, _, last = expression.rpartition("/")
    if head and last in ("*", "**"):
        expression = f"{head}/{type_hash(type_name) if rmw else 'robot'}"
    return check_expression(expression, option, wildcards=False)


def _publisher(transport: Transport, key: str, urgency: Urgency, rmw: bool) -> Publisher:
    inner = transport.publisher(key, urgency)
    if not rmw:
        return inner
    # readers do not look up our clouds by token, but they all require the attachment, whose identity derives from one
    return RmwPublisher(inner, publisher_token(key, "0", "coview_robot", 0), time.time_ns)
