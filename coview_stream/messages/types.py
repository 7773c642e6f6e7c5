"""Messages as plain data; :mod:`coview_stream.messages` turns them into bytes and back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import Points, Pose


@dataclass(frozen=True)
class Sample:
    """One message as it came over a transport.

    Attributes:
        key: the key it was published on.
        payload: its bytes.
        encoding: MIME type with its schema (``type;schema``), empty if the sender set none.
        attachment: bytes beside the payload, None if there are none.
        size: bytes of a payload that was too large to be taken in; ``payload`` is empty then. None otherwise.
    """

    key: str
    payload: bytes
    encoding: str = ""
    attachment: bytes | None = None
    size: int | None = None


@dataclass(frozen=True)
class Encoded:
    """A message ready to be published.

    Attributes:
        payload: its bytes.
        encoding: MIME type with its schema, empty for none.
        attachment: bytes beside the payload, None for none.
    """

    payload: bytes
    encoding: str = ""
    attachment: bytes | None = None


@dataclass(frozen=True)
class CloudMessage:
    """One lidar frame.

    Attributes:
        stamp_ns: sensor time, nanoseconds.
        points: (N, 3) float32 body frame (x forward, z up), metres; may hold NaN rows; may be a read-only view.
        times: (N,) float64 seconds after ``stamp_ns`` (before it: negative) at which each point was measured; None if
            the sender gave none.
        rings: (N,) which beam measured each point; None if the sender gave none.
        sequence: the sender's running number; None if it has none.
    """

    stamp_ns: int
    points: Points
    times: Floats | None = None
    rings: npt.NDArray[np.uint16] | None = None
    sequence: int | None = None

    def limited(self, max_points: int) -> CloudMessage:
        """Return the frame with every n-th point only, if it has more than ``max_points``."""
        step = -(-len(self.points) // max_points)
        if step <= 1:
            return self
        times = None if self.times is None else self.times[::step]
        rings = None if self.rings is None else self.rings[::step]
        return replace(self, points=np.ascontiguousarray(self.points[::step]), times=times, rings=rings)


@dataclass(frozen=True)
class OdometryMessage:
    """One odometry sample.

    Attributes:
        stamp_ns: sensor time, nanoseconds.
        T_odom_body: (4, 4) odometry <- body, metres, gravity aligned.
    """

    stamp_ns: int
    T_odom_body: Pose


@dataclass(frozen=True)
class PoseMessage:
    """One published pose.

    Attributes:
        stamp_ns: sensor time that the pose holds at, nanoseconds.
        robot: name.
        state: always ``TRACKING`` from our node; kept for readers.
        T_map_body: (4, 4) float64 map <- body, metres.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), map axes, m2 and rad2.
        confidence: probability, in [0, 1], that the robot is at this place and not at another or none; NaN where a
            format has none.
        map_sha256: hash of the base map that the pose refers to.
        age: seconds of sensor time since the lidar frame that last corrected it.
        frame_id: name of the map frame, for formats that carry one.
        protection: metres and degrees that the error exceeds at most once in a thousand; None where a format has none.
    """

    stamp_ns: int
    robot: str
    state: str
    T_map_body: Pose
    covariance: Floats
    confidence: float
    map_sha256: str
    age: float = 0.0
    frame_id: str = "map"
    protection: ProtectionLevel | None = None
