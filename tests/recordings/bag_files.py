"""Small recordings, written by rosbags' own writers."""

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

STORE = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
LIVOX = "livox_ros_driver2/msg/CustomMsg"
_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
_CUSTOM = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)
for store in (STORE, ROS1):
    store.register(get_types_from_msg(_POINT, LIVOX.replace("Msg", "Point")) | get_types_from_msg(_CUSTOM, LIVOX))
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
KINDS = {"f4": 7, "u4": 6, "f8": 8}
LATE = 777_000_000_000  # ns: the recorder's clock is another one


def message(name, /, **values):
    return STORE.types[name](**values)


def header(stamp_ns, frame):
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def cloud(stamp_ns, points, times=None, order="<", frame="body"):
    columns = [(name, "f4", points[:, k]) for k, name in enumerate("xyz")]
    if times is not None:
        columns.append(("time", "f4", times))
    rows = np.empty(len(points), [(name, order + kind) for name, kind, _ in columns])
    for name, _, values in columns:
        rows[name] = values
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=KINDS[kind], count=1)
        for k, (name, kind, _) in enumerate(columns)
    ]
    step, data = rows.dtype.itemsize, np.frombuffer(rows.tobytes(), np.uint8)
    return message(
        CLOUD,
        header=header(stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=order == ">",
        point_step=step,
        row_step=step * len(rows),
        data=data,
        is_dense=True,
    )


def geometry(name, /, **values):
    return message(f"geometry_msgs/msg/{name}", **values)


def quaternion(T):
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return geometry("Quaternion", x=x, y=y, z=z, w=w)


def odometry(stamp_ns, T, child="body"):
    x, y, z = T[:3, 3]
    pose = geometry("Pose", position=geometry("Point", x=x, y=y, z=z), orientation=quaternion(T))
    zero, unknown = geometry("Vector3", x=0.0, y=0.0, z=0.0), np.zeros(36)
    twist = geometry("TwistWithCovariance", twist=geometry("Twist", linear=zero, angular=zero), covariance=unknown)
    placed = geometry("PoseWithCovariance", pose=pose, covariance=unknown)
    return message(ODOMETRY, header=header(stamp_ns, "odom"), child_frame_id=child, pose=placed, twist=twist)


def transforms(stamp_ns, *edges):
    """TFMessage of (parent, child, T_parent_child)."""
    messages = []
    for parent, child, T in edges:
        x, y, z = T[:3, 3]
        moved = geometry("Transform", translation=geometry("Vector3", x=x, y=y, z=z), rotation=quaternion(T))
        head = header(stamp_ns, parent)
        messages.append(geometry("TransformStamped", header=head, child_frame_id=child, transform=moved))
    return message(TRANSFORMS, transforms=messages)


def livox(stamp_ns, points, times, frame="livox_frame"):
    rows = [
        message(LIVOX.replace("Msg", "Point"), offset_time=int(t), x=x, y=y, z=z, reflectivity=9, tag=0, line=k % 4)
        for k, ((x, y, z), t) in enumerate(zip(points, times, strict=True))
    ]
    head = {"header": header(stamp_ns, frame), "timebase": stamp_ns, "point_num": len(rows), "lidar_id": 1}
    return message(LIVOX, **head, rsvd=np.zeros(3, np.uint8), points=rows)


def write_bag(path, topics, storage="mcap", compression=""):
    """Write messages, or raw CDR bytes (as clouds), by topic; all topics arrive side by side."""
    if path.suffix == ".bag":
        return _write_ros1(path, topics, compression)
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, _type(m), typestore=STORE) for topic, m in topics.items()}
        for arrived, topic, kind, item in _in_turn(topics):
            data = item if isinstance(item, bytes) else STORE.serialize_cdr(item, kind)
            writer.write(connections[topic], arrived, data)
    return path


def _write_ros1(path, topics, compression=""):
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    with writer:
        connections = {topic: writer.add_connection(topic, _type(m), typestore=ROS1) for topic, m in topics.items()}
        for arrived, topic, kind, item in _in_turn(topics):
            raw = STORE.cdr_to_ros1(bytes(STORE.serialize_cdr(item, kind)), kind)
            writer.write(connections[topic], arrived, raw)
    return path


def _type(messages):
    return getattr(messages[0], "__msgtype__", CLOUD) if messages else CLOUD


def _in_turn(topics):
    longest = max(map(len, topics.values()), default=0)
    for topic, messages in topics.items():
        for k, item in enumerate(messages):
            arrived = LATE + round(k * longest / len(messages)) * 1000
            yield arrived, topic, _type(messages), item
