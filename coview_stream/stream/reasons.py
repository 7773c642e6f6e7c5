"""Why nothing is known yet, in a clause for people."""

from __future__ import annotations

from coview_stream.stream.counters import Counters
from coview_stream.stream.keys import RobotKeys


def why_nothing(keys: RobotKeys, counted: Counters, has_odometry: bool) -> str:
    """Say what a robot that has not had one frame processed is waiting for."""
    unread = counted.malformed + counted.oversized + counted.unknown_encoding
    if not counted.received:
        return f"waiting for clouds on {keys.cloud}"
    if counted.received == unread:
        return "not one cloud could be read; see errors"
    if not has_odometry and counted.odometry_received:
        return "not one odometry sample could be read; see errors"
    if not has_odometry:
        return f"waiting for odometry on {keys.odometry}"
    if counted.rejected:
        return f"{counted.rejected} frames were of no use; see errors"
    if counted.late or counted.no_odometry:
        return "odometry and clouds have no common stamps: are both of one clock?"
    return "no frame has been processed yet"
