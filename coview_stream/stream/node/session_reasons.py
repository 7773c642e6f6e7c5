"""Counters and reasons of what a session sees: odometry that does not continue, and what a robot is waiting for."""

from __future__ import annotations

from coview_stream.odometry.buffer import SampleKind
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.transport.keys import RobotKeys

COUNTED_AS = {
    SampleKind.GAP: "odometry_gaps",
    SampleKind.OUTAGE: "odometry_gaps",
    SampleKind.JUMP: "odometry_jumps",
    SampleKind.RESTART: "clock_restarts",
    SampleKind.DUPLICATE: "odometry_duplicate",
    SampleKind.OUT_OF_ORDER: "odometry_out_of_order",
}
"""Counter of an odometry sample that does not continue those before it."""

RESTART_REASONS = {
    # frames from before and after a pause must not be searched for as one place
    SampleKind.GAP: "odometry paused",
    SampleKind.OUTAGE: "odometry was away for too long",
    SampleKind.JUMP: "odometry jumped",
    SampleKind.RESTART: "the sender's clock started anew",
}
"""Why the search restarts at such a sample; after a gap only where no place is known that could be verified."""


def status_text(keys: RobotKeys, counters: Counters, has_odometry: bool) -> str:
    """Return what a robot of which no frame has been processed is waiting for."""
    unread = counters.malformed + counters.oversized + counters.unknown_encoding
    if not counters.received:
        return f"waiting for clouds on {keys.cloud}"
    if counters.received == unread:
        return "not one cloud could be read; see errors"
    if not has_odometry and counters.odometry_received:
        return "not one odometry sample could be read; see errors"
    if not has_odometry:
        return f"waiting for odometry on {keys.odometry}"
    if counters.engine_errors:
        return f"frames at which the engine failed: {counters.engine_errors}; see errors"
    if counters.rejected:
        return f"{counters.rejected} frames were of no use; see errors"
    if counters.late or counters.no_odometry:
        return "odometry and clouds have no common stamps: are both of one clock?"
    return "no frame has been processed yet"
