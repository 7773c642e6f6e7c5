"""Frames of a recording, from ``/tf_static`` and ``/tf``: the lidar's mount, and odometry's frames."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.transforms import Pose, inverse
from coview_stream.messages import ros2
from coview_stream.messages.validation import checked_pose, stamp_join

TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_BODIES = ("base_link", "base_footprint", "base_frame", "body")
"""Usual names of the body; the first that a tree has counts."""
_WORLDS = ("map", "world", "earth", "utm", "global")
"""Frames above odometry's frame."""
_SAME = 1e-6  # greatest difference between elements of transforms that count as equal
_MAX_FRAMES = 1000  # a hostile recording could name millions


def read_transforms(payload: bytes) -> Iterator[tuple[int, str, str, Pose]]:
    """Yield stamp (ns), parent, child and T_parent_child (4, 4) from a TFMessage in CDR; MessageError if damaged."""
    for row in ros2.read(payload, TYPES[0]).transforms:
        t, q, stamp = row.transform.translation, row.transform.rotation, row.header.stamp
        try:
            T = checked_pose((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
        except MessageError:  # a rotation of zeros, for example; the other transforms are valid
            continue
        yield stamp_join(stamp.sec, stamp.nanosec), row.header.frame_id.lstrip("/"), row.child_frame_id.lstrip("/"), T


class FrameTree:
    """Tree of a recording's frames. ``lidar`` is the clouds' frame; samples are kept of frames that may be above it."""

    def __init__(self) -> None:
        self.lidar = ""
        self._parents: dict[str, tuple[str, Pose]] = {}  # by child
        self._moved: set[str] = set()  # ROS 1 repeats constant transforms on /tf
        self._samples: dict[str, list[tuple[int, Pose]]] = {}  # by child; not for static transforms

    def add(self, payload: bytes, static: bool) -> None:
        """Add the transforms in a CDR TFMessage; a static one replaces its predecessor; MessageError if damaged."""
        for stamp_ns, parent, child, T in read_transforms(payload):
            if static if child in self._parents else len(self._parents) < _MAX_FRAMES:
                self._parents[child] = parent, T
            before = self._parents.get(child)
            if static or before is None or before[0] != parent:
                continue
            if np.abs(T - before[1]).max() > _SAME:
                self._moved.add(child)
            above = self.above(self.lidar)
            if child in above or self.above(child)[-1] != above[-1]:  # a static transform may join the two trees later
                self._samples.setdefault(child, []).append((stamp_ns, T))

    def body(self) -> str:
        """Return the robot's frame by its usual names; empty if none is above the lidar."""
        above = self.above(self.lidar)
        return next((name for name in _BODIES if name in above), "")

    def mount(self, body: str) -> Pose | None:
        """Return T_body_lidar (4, 4); None if the frames are not connected, or move relative to each other."""
        of_body, of_lidar = self.above(body), self.above(self.lidar)
        common = next((name for name in of_lidar if name in of_body), None)
        if common is None:
            return None
        T_common = []
        for names in (of_body, of_lidar):
            T = np.eye(4)
            for child in names[: names.index(common)]:
                if child in self._moved:
                    return None
                T = self._parents[child][1] @ T
            T_common.append(T)
        return np.asarray(inverse(T_common[0]) @ T_common[1])

    def odometry(self) -> tuple[str, str, list[tuple[int, Pose]]] | None:
        """Return odometry's frame, the body's, and stamps (ns) with T_odom_body (4, 4); None without odometry.

        It is the highest transform above the lidar that moves, or whose parent's name has ``odom``, and whose parent is
        no map or world; without such a one, the lowest that starts at a map or world.
        """
        moving = [
            child for child in self.above(self.lidar)[:-1]
            if child in self._samples and (child in self._moved or "odom" in self._parents[child][0])
        ]  # fmt: skip
        moving = [child for child in moving if self._parents[child][0] not in _WORLDS] or moving[:1]
        return (self._parents[moving[-1]][0], moving[-1], self._samples[moving[-1]]) if moving else None

    def above(self, name: str) -> list[str]:
        """Return a frame and the frames above it, upward."""
        names = [name]
        while names[-1] in self._parents and self._parents[names[-1]][0] not in names:
            names.append(self._parents[names[-1]][0])
        return names
