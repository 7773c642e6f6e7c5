"""Why nothing is known yet, or not any more, in clauses for people."""

from __future__ import annotations

from coview_stream.stream.counters import Counters
from coview_stream.stream.keys import RobotKeys
from coview_stream.stream.odometry import Intake

COUNTED_AS = {
    Intake.GAP: "odometry_gaps",
    Intake.OUTAGE: "odometry_gaps",
    Intake.JUMP: "odometry_jumps",
    Intake.RESTART: "clock_restarts",
    Intake.DUPLICATE: "odometry_duplicate",
    Intake.OUT_OF_ORDER: "odometry_out_of_order",
}
"""Counter of an odometry sample that does not just continue."""

WHY_ANEW = {
    # frames from before and after a pause must not be searched for as one place
    Intake.GAP: "odometry paused",
    Intake.OUTAGE: "odometry was away for too long",
    Intake.JUMP: "odometry jumped",
    Intake.RESTART: "the sender's clock started anew",
}
"""Why the search begins anew with such a sample; after a gap only where no place is known that could be verified."""


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
    if counted.engine_errors:
        return f"frames at which the engine failed: {counted.engine_errors}; see errors"
    if counted.rejected:
        return f"{counted.rejected} frames were of no use; see errors"
    if counted.late or counted.no_odometry:
        return "odometry and clouds have no common stamps: are both of one clock?"
    return "no frame has been processed yet"
