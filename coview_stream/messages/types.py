"""Messages as plain data; :mod:`coview_stream.messages` encodes and decodes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.config.mount import Mount
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    place_fields,
    pose_fields,
    pose_in_words,
    position_of,
    quaternion_of,
    stddev_of,
    yaw_of,
)


@dataclass(frozen=True)
class Sample:
    """One message as received from a transport."""

    key: str  # key it was published on
    payload: bytes
    encoding: str = ""  # MIME type with its schema (``type;schema``), empty if the sender set none
    attachment: bytes | None = None  # sent with the payload
    size: int | None = None  # bytes of a payload too large to receive; ``payload`` is then empty
    refused: str = ""  # why the transport withheld the payload, for people; ``payload`` is then empty
    mount: Mount | None = None  # of the lidar, if the transport knows it


@dataclass(frozen=True)
class Encoded:
    """A message ready to publish; its fields are those of :class:`Sample`."""

    payload: bytes
    encoding: str = ""
    attachment: bytes | None = None


@dataclass(frozen=True, eq=False)
class CloudMessage:
    """One lidar frame.

    Attributes:
        stamp_ns: sensor time, nanoseconds.
        points: (N, 3) float32 body frame (x forward, z up), metres; may have NaN rows; may be a read-only view.
        times: (N,) float64 measurement time of each point, seconds after ``stamp_ns`` (negative: before); None if not
            sent.
        rings: (N,) beam of each point; None if not sent.
        sequence: the sender's sequence number; None without one.
    """

    stamp_ns: int
    points: Points
    times: Floats | None = None
    rings: npt.NDArray[np.uint16] | None = None
    sequence: int | None = None

    def limited(self, max_points: int) -> CloudMessage:
        """Return the frame thinned to every n-th point if it has more than ``max_points``."""
        step = -(-len(self.points) // max_points)
        if step <= 1:
            return self
        times = None if self.times is None else self.times[::step]
        rings = None if self.rings is None else self.rings[::step]
        return replace(self, points=np.ascontiguousarray(self.points[::step]), times=times, rings=rings)


@dataclass(frozen=True, eq=False)
class OdometryMessage:
    """One odometry sample."""

    stamp_ns: int  # sensor time, nanoseconds
    T_odom_body: Pose  # (4, 4) odometry <- body, metres, gravity aligned


@dataclass(frozen=True, eq=False)
class PoseMessage:
    """One published pose, as yielded by :meth:`RobotClient.poses`. Equality is identity.

    Attributes:
        stamp_ns: sensor time of the pose, nanoseconds.
        robot: name.
        state: always ``TRACKING`` from our node.
        T_map_body: (4, 4) float64 map <- body, metres.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), map axes, m2 and rad2.
        confidence: probability, in [0, 1], that the robot is at this place and not elsewhere; NaN if the format has
            none.
        map_sha256: hash of the base map that the pose refers to.
        age: seconds of sensor time since the last lidar frame that corrected the pose.
        frame_id: name of the map frame, for formats that carry one.
        protection: metres and degrees that the error exceeds at most once in a thousand; None if the format has none.
        T_map_odom: (4, 4) map <- odometry, for users of transforms; None if the format has none.
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
    T_map_odom: Pose | None = None

    @property
    def stamp(self) -> float:
        """Sensor time of the pose, seconds, to a microsecond; :attr:`stamp_ns` is exact."""
        return int(self.stamp_ns) / 1_000_000_000  # a quotient of two integers is correctly rounded

    @property
    def position(self) -> Floats:
        """(3,) x, y, z of the body in the map's frame, metres."""
        return position_of(self.T_map_body)

    @property
    def yaw(self) -> float:
        """Heading of the body's x axis, radians in (-pi, pi], counter-clockwise from the map's x."""
        return yaw_of(self.T_map_body)

    @property
    def quaternion(self) -> Floats:
        """(4,) x, y, z, w of the rotation map <- body."""
        return quaternion_of(self.T_map_body)

    @property
    def stddev(self) -> Floats:
        """(6,) one sigma of x, y, z, roll, pitch, yaw, metres and radians; NaN if the format has no covariance."""
        return stddev_of(self.covariance)

    def to_json(self) -> dict[str, Any]:
        """Fields of the native JSON message as plain data, null where the pose's format lacks one."""
        return {
            "stamp_ns": int(self.stamp_ns),
            "robot": self.robot,
            "state": self.state,
            **pose_fields(self.T_map_body, self.covariance),
            "confidence": None if math.isnan(self.confidence) else self.confidence,
            "map_sha256": self.map_sha256 or None,
            "age_s": None if math.isnan(self.age) else self.age,
            "frame_id": self.frame_id,
            "protection_level": None if self.protection is None else self.protection.to_json(),
            "T_map_odom": None if self.T_map_odom is None else place_fields(self.T_map_odom),
        }

    def __repr__(self) -> str:
        """Return robot, stamp, state and pose in one line."""
        pose = pose_in_words(self.T_map_body, self.covariance)
        return f"PoseMessage({self.robot!r}, {self.stamp:.3f} s, {self.state}: {pose})"


@dataclass(frozen=True, eq=False)
class HypothesesMessage:
    """Places that a search for one robot considers; none is certain.

    ``places`` are (K, 6), most probable first: x, y, z (metres) and yaw (radians) of the body in the map frame,
    posterior probability, log-likelihood ratio against chance.
    """

    stamp_ns: int  # sensor time of the keyframe, nanoseconds
    robot: str
    places: Floats
    none: float  # probability that the robot is nowhere on the map
    map_sha256: str
    maps: tuple[str, ...] = ()  # the map of each place, in whose frame it is; empty for a single map


@dataclass(frozen=True, eq=False)
class LocationMessage:
    """A robot's location on Earth (WGS 84)."""

    stamp_ns: int  # sensor time, nanoseconds
    robot: str
    latitude: float  # degrees, north positive
    longitude: float  # degrees, east positive
    height: float  # metres; see :class:`coview_stream.clouds.reference_system.GeoReference`
    heading: float  # radians, clockwise from true north
    covariance: Floats  # (3, 3) east, north, up, m2
    confidence: float  # of the pose; NaN if unknown
