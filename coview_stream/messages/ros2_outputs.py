"""A localizer's ROS 2 messages besides its poses, in CDR: transform, diagnostics, map points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from coview_stream.errors import MessageError
from coview_stream.geometry.transforms import Points, Pose, pose_to_tum
from coview_stream.messages.ros2 import encode_cloud, header, new, write
from coview_stream.messages.types import CloudMessage

TRANSFORMS = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

_LEVELS = {"TRACKING": 0, "SEARCHING": 1, "AMBIGUOUS": 1, "LOST": 2}  # OK, WARN, ERROR
_WARN, _STALE = 1, 3


def encode_transform(T_parent_child: Pose, stamp_ns: int, parent: str, child: str) -> bytes:
    """Write one transform (4, 4) as a TFMessage; MessageError if the stamp is beyond a header's range."""
    x, y, z, *q = pose_to_tum(T_parent_child).tolist()
    transform = new(
        "geometry_msgs/msg/Transform",
        translation=new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q, strict=True))),
    )
    head = header(stamp_ns, parent)
    stamped = new("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=transform)
    return write(new(TRANSFORMS, transforms=[stamped]), TRANSFORMS).payload


def encode_map(points: Points, stamp_ns: int) -> bytes:
    """Write map points (N, 3) as a PointCloud2 in frame ``map``."""
    return encode_cloud(CloudMessage(stamp_ns, points), "map").payload


def encode_diagnostics(status: Mapping[str, Any], stamp_ns: int, transform: str, clock: str) -> bytes:
    """Write a robot's status, as in ``out/status``, as a DiagnosticArray; MessageError if it is not a status.

    For people, ``transform`` describes map -> odom, and ``clock`` how message stamps contradict this node's clock,
    empty if they agree.
    """
    try:
        pose, node = status["pose"], status.get("node", {})
        level = _STALE if node.get("ending") else max(_LEVELS[status["state"]], _WARN if clock else 0)
        text = f"{status['state']}: {status['reason']}" + (f"; {clock}" if clock else "")
        protection = pose["protection_level"] or {}
        values = {
            "state": status["state"],
            "reason": status["reason"],
            "map -> odom": transform,
            "clock": clock,
            "pose_rate_hz": pose["rate_hz"],
            "pose_age_s": pose["age_s"],
            "confidence": pose["confidence"],
            **{f"protection_{name}": protection.get(name) for name in ("m", "horizontal_m", "vertical_m")},
            "map_sha256": status["map_sha256"],
            "errors": "; ".join(status.get("errors", ())),
            **{name: count for name, count in status.get("counters", {}).items() if count},
        }
        robot = str(status["robot"])
    except (KeyError, TypeError, AttributeError) as error:
        raise MessageError(f"no status of a robot: {error!r}") from error
    rows = [
        new("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in values.items()
        if value not in (None, "")
    ]
    name = f"coview_stream: {robot}"
    row = new(
        "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=text, hardware_id=robot, values=rows
    )
    return write(new(DIAGNOSTICS, header=header(stamp_ns, ""), status=[row]), DIAGNOSTICS).payload
