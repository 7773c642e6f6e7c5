"""A robot in ROS 2, as foreign to the node under test as a driver is: real rclpy, a context and a thread of its own."""

import random
import threading
import time
from collections import defaultdict

import numpy as np

from coview_stream.messages import ros2
from coview_stream.messages.types import CloudMessage, OdometryMessage

ENVIRONMENT = {"ROS_DOMAIN_ID": str(random.randrange(1, 100)), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""Loopback only, and apart from other tests on this machine."""


class RosRobot:
    """Publishes clouds and odometry of a robot, and keeps the messages of a localizer: poses, diagnostics, the map."""

    def __init__(self, name="r1", node="driver"):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from nav_msgs.msg import Odometry
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from sensor_msgs.msg import PointCloud2

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node(node, context=self.context)
        self.heard = defaultdict(list)
        self.clouds = self.node.create_publisher(PointCloud2, f"/{name}/points", qos_profile_sensor_data)
        self.odometry = self.node.create_publisher(Odometry, f"/{name}/odom", 10)
        self.guesses = self.node.create_publisher(PoseWithCovarianceStamped, "/initialpose", 10)
        self.latched = lambda depth: QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.subscribed = (f"/{name}/pose", "/diagnostics", "/map_points")
        kinds = (PoseWithCovarianceStamped, 10), (DiagnosticArray, 10), (PointCloud2, self.latched(1))
        for topic, (kind, qos) in zip(self.subscribed, kinds, strict=True):
            self.node.create_subscription(kind, topic, self.heard[topic].append, qos)
        self.poses, self.diagnostics = self.heard[f"/{name}/pose"], self.heard["/diagnostics"]
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def until(self, condition, seconds=10.0):
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, self.texts()[-5:]
            time.sleep(0.01)

    def found(self, seconds=40.0):
        """Wait until a localizer hears this robot, and is heard."""
        self.until(lambda: self.clouds.get_subscription_count() and self.odometry.get_subscription_count(), seconds)
        self.until(lambda: all(self.node.count_publishers(topic) for topic in self.subscribed[:2]))

    def send(self, stamp_ns, points, T_odom_body):
        """Publish odometry and a cloud of its stamp, in the bytes of our own encoder."""
        self.move(stamp_ns, T_odom_body)
        self.clouds.publish(ros2.encode_cloud(CloudMessage(stamp_ns, points)).payload)

    def move(self, stamp_ns, T_odom_body):
        self.odometry.publish(ros2.encode_odometry(OdometryMessage(stamp_ns, T_odom_body)).payload)

    def texts(self):
        """Levels and messages of the diagnostics, oldest first."""
        return [(message.status[0].level, message.status[0].message) for message in self.diagnostics]

    def level(self):
        return self.texts()[-1][0] if self.diagnostics else None

    def values(self):
        return {row.key: row.value for message in self.diagnostics[-1:] for row in message.status[0].values}

    def close(self):
        self._executor.shutdown(0.5)
        self._thread.join(5.0)
        self.node.destroy_node()
        self.context.try_shutdown()


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def place_of(message):
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def cloud_message(stamp_ns, points, frame="base_link", names="xyz"):
    """Return rclpy's own PointCloud2, serialized by rclpy."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import PointCloud2, PointField
    from std_msgs.msg import Header

    data = np.ascontiguousarray(points, dtype="<f4")
    step = data.shape[1] * data.itemsize
    fields = [PointField(name=n, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, n in enumerate(names)]
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return serialize_message(
        PointCloud2(
            header=header, height=1, width=len(data), fields=fields, is_bigendian=False,
            point_step=step, row_step=step * len(data), data=data.tobytes(), is_dense=True,
        )
    )  # fmt: skip
