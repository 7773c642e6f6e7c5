"""Messages as a stranger would write them: from the documented contract only, with none of the product's codecs.

And random bytes and almost valid messages, for every input key of a robot.
"""

from __future__ import annotations

import functools
import json
import random
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.stream.scores import Posed
from coview_stream.geometry.arrays import Floats, Floats32

Points = Floats32
Message = tuple[bytes, str, bytes | None]  # payload, encoding, attachment

CDR_CLOUD, CDR_ODOMETRY = ("application/cdr;sensor_msgs/msg/PointCloud2", "application/cdr;nav_msgs/msg/Odometry")
FOXGLOVE_CLOUD = "application/protobuf;foxglove.PointCloud"
ENCODINGS = (
    "application/octet-stream;layout=xyz", "application/octet-stream;layout=xyzi", CDR_CLOUD, FOXGLOVE_CLOUD,
    "application/json", CDR_ODOMETRY,
)  # fmt: skip
_CDR_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


@functools.lru_cache(maxsize=1)
def typestore() -> Any:
    """ROS 2 message types."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _header(stamp_ns: int, frame: str) -> Any:
    types = typestore().types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return types["std_msgs/msg/Header"](time, frame)


def raw_cloud(points: Points, stamp_ns: int) -> Message:
    """Little-endian float32 rows; the stamp beside them."""
    return points.astype("<f4").tobytes(), ENCODINGS[0], struct.pack("<q", stamp_ns)


def raw_cloud_with_intensity(points: Points, stamp_ns: int) -> Message:
    """Lay a fourth column beside the coordinates."""
    rows = np.column_stack([points, np.zeros(len(points), np.float32)]).astype("<f4")
    return rows.tobytes(), ENCODINGS[1], struct.pack("<q", stamp_ns)


def cdr_cloud(points: Points, stamp_ns: int) -> Message:
    """Write a PointCloud2 as drivers send it: x, y, z, intensity."""
    types = typestore().types
    field = types["sensor_msgs/msg/PointField"]
    rows = np.column_stack([points, np.zeros(len(points), np.float32)]).astype("<f4")
    fields = [field(name, 4 * k, 7, 1) for k, name in enumerate(("x", "y", "z", "intensity"))]
    message = types["sensor_msgs/msg/PointCloud2"](
        _header(stamp_ns, "lidar"), 1, len(rows), fields, False, 16, 16 * len(rows),
        rows.view(np.uint8).reshape(-1), True,
    )  # fmt: skip
    return bytes(typestore().serialize_cdr(message, message.__msgtype__)), CDR_CLOUD, None


def foxglove_cloud(points: Points, stamp_ns: int) -> Message:
    """Write a foxglove.PointCloud in the sensor's own frame."""
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    message = PointCloud(frame_id="lidar", point_stride=12, data=points.astype("<f4").tobytes())
    message.timestamp.FromNanoseconds(stamp_ns)
    message.pose.orientation.w = 1.0
    for k, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
    return message.SerializeToString(), FOXGLOVE_CLOUD, None


def json_odometry(T_odom_body: Floats, stamp_ns: int) -> Message:
    """Write the native odometry."""
    quaternion = Rotation.from_matrix(T_odom_body[:3, :3]).as_quat().tolist()
    fields = {"stamp_ns": stamp_ns, "position": T_odom_body[:3, 3].tolist(), "orientation": quaternion}
    return json.dumps(fields).encode(), "application/json", None


def cdr_odometry(T_odom_body: Floats, stamp_ns: int) -> Message:
    """Write a nav_msgs/msg/Odometry."""
    types = typestore().types
    vector, none = types["geometry_msgs/msg/Vector3"], np.zeros(36)
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*T_odom_body[:3, 3].tolist()),
        types["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(T_odom_body[:3, :3]).as_quat().tolist()),
    )
    twist = types["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    message = types["nav_msgs/msg/Odometry"](
        _header(stamp_ns, "odom"), "base_link",
        types["geometry_msgs/msg/PoseWithCovariance"](pose, none),
        types["geometry_msgs/msg/TwistWithCovariance"](twist, none),
    )  # fmt: skip
    return bytes(typestore().serialize_cdr(message, message.__msgtype__)), CDR_ODOMETRY, None


CLOUDS: dict[str, Callable[[Points, int], Message]] = {
    "xyz": raw_cloud, "xyzi": raw_cloud_with_intensity, "cdr": cdr_cloud, "foxglove": foxglove_cloud,
}  # fmt: skip
ODOMETRY: dict[str, Callable[[Floats, int], Message]] = {"json": json_odometry, "cdr": cdr_odometry}


def read_pose(payload: bytes, encoding: str, arrival: float) -> Posed:
    """Read a pose in any of the formats that the node can be told to publish.

    Raises:
        ValueError, KeyError: it is none of them.
    """
    if encoding.startswith("application/json"):
        told = json.loads(payload)
        age = next((float(told[name]) for name in ("age_s", "age") if name in told), None)
        return Posed(arrival, int(told["stamp_ns"]), _matrix(told["position"], told["orientation"]), age)
    if encoding.startswith("application/cdr"):
        message = typestore().deserialize_cdr(payload, _CDR_POSE)
        stamp, pose = message.header.stamp, message.pose.pose
        return Posed(arrival, stamp.sec * 10**9 + stamp.nanosec, _of_fields(pose.position, pose.orientation))
    if encoding.startswith("application/protobuf"):
        from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

        told = PoseInFrame.FromString(payload)
        pose = told.pose
        return Posed(arrival, told.timestamp.ToNanoseconds(), _of_fields(pose.position, pose.orientation))
    raise ValueError(f"a pose of encoding {encoding!r}")


def _of_fields(position: Any, orientation: Any) -> Floats:
    p, q = position, orientation
    return _matrix([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


def _matrix(position: list[float], orientation: list[float]) -> Floats:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(orientation).as_matrix(), position
    return T


EPOCH_NS = 1_700_000_000 * 10**9
"""Where the robots' sensor clocks begin: no clock of the machine, as a robot's is none of the node's."""

_LARGE = 1 << 20
_RUBBISH = (
    b"", b"{}", b"null", b"[" * 5000, b'{"stamp_ns": 1e400}', b"\xff\xfe",
    b'{"stamp_ns": 1, "position": [0, 0], "orientation": [0, 0, 0, 1]}',
    b'{"stamp_ns": 1, "position": [NaN, 0, 0], "orientation": [0, 0, 0, 1]}',
    b'{"stamp_ns": 1, "position": [0, 0, 0], "orientation": [0, 0, 0, 0]}',
    b'{"stamp_ns": "x", "position": "y", "orientation": null}',
    b'{"stamp_ns": ' + b"9" * 5000 + b', "position": [0,0,0], "orientation": [0,0,0,1]}',
    b"\0\1\0\0" + b"\xff" * 400, b"\0\0\0\0" + b"\0" * 60,
)  # fmt: skip
_STRANGE = ("", "text/plain", "application/x-unheard-of", "application/cdr;some_msgs/msg/Other", "a;b;c;d", "image/png")


def rubbish(seed: int) -> Iterator[Message]:
    """Endless: random bytes, fixed nasties, and valid messages with flipped bytes or a missing end."""
    rng = random.Random(seed)
    points = np.zeros((300, 3), np.float32)
    valid = [make(points, EPOCH_NS) for make in CLOUDS.values()]
    valid += [make(np.eye(4), EPOCH_NS) for make in ODOMETRY.values()]
    while True:
        draw = rng.random()
        encoding = rng.choice((*ENCODINGS, *_STRANGE, f"x{rng.randrange(10**6)}/y"))
        attachment = rng.choice((None, b"", rng.randbytes(8), rng.randbytes(33), struct.pack("<q", EPOCH_NS)))
        if draw < 0.5:
            yield rng.randbytes(rng.randrange(5001)), encoding, attachment
        elif draw < 0.52:
            yield rng.randbytes(_LARGE), encoding, attachment
        elif draw < 0.65:
            yield rng.choice(_RUBBISH), encoding, attachment
        else:
            payload, true, beside = rng.choice(valid)
            broken = bytearray(payload[: rng.randrange(len(payload))] if rng.random() < 0.5 else payload)
            for _ in range(rng.randrange(1, 9)):
                if broken:
                    broken[rng.randrange(len(broken))] = rng.randrange(256)
            yield bytes(broken), true, rng.choice((beside, beside, None, rng.randbytes(8)))
