"""Recording of a simulated run as a robot makes one: raw sweeps with a time at every point, and its odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points
from coview_stream.messages import ros2
from coview_stream.messages.types import CloudMessage, Encoded, OdometryMessage
from coview_stream.odometry.buffer import Segment

CLOUDS, ODOMETRY = "/points", "/odom"
"""Topics of the recording."""

_BAG_VERSION = 9  # of rosbag2's metadata, which the ROS of today reads


class Recording:
    """A rosbag2 directory (mcap) that is being written; a context manager."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._writer = Writer(path, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._topics: dict[str, Any] = {}
        self._newest = -1

    def __enter__(self) -> Recording:
        self._writer.open()
        for topic, kind in ((ODOMETRY, ros2.ODOMETRY), (CLOUDS, ros2.CLOUD)):
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=ros2.store())
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def add(self, points: Points, times: Floats, segment: Segment) -> None:
        """Add a sweep that bears the stamp of its segment's end, and the odometry of the segment before it.

        Args:
            points: (N, 3) float32, each in the body frame at its own time, metres.
            times: (N,) seconds after the stamp.
            segment: odometry of the sweep; samples that were written before are left out.
        """
        for stamp, pose in zip(segment.stamps.tolist(), segment.poses, strict=True):
            if stamp > self._newest:
                self._write(ODOMETRY, stamp, ros2.encode_odometry(OdometryMessage(stamp, pose)))
        self._newest = int(segment.stamps[-1])
        self._write(CLOUDS, self._newest, ros2.encode_cloud(CloudMessage(self._newest, points, times)))

    def _write(self, topic: str, stamp: int, message: Encoded) -> None:
        self._writer.write(self._topics[topic], stamp, message.payload)
