"""A simulated robot that drives on for ever, in a process of its own, and goes wrong in the manner it is told to."""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from bench.stream.drive import EPOCH_NS, Drive, RobotPlan
from bench.stream.processes import open_session
from coview_stream.clouds import read_tum
from coview_stream.geometry.arrays import Floats
from coview_stream.messages import encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage

CLOUD_PERIOD, ODOMETRY_PERIOD = 0.1, 0.02
REOPEN = "reopen"
"""Tells a robot to open its session anew, as one does that is started again."""

_LATE = 0.5  # seconds after which a message that the network held up is not sent any more


@dataclass(frozen=True)
class Manner:
    """How a robot sends.

    Attributes:
        clouds: whether it sends clouds.
        odometry: whether it sends odometry.
        frozen: whether odometry says that it stands, while it drives.
        stopped: whether the stamps stand.
        unit_ns: nanoseconds of one unit of its stamps; a million if it stamps in milliseconds.
        offset: seconds that its sensor clock is ahead of its start.
        shift: x, y in metres and yaw in radians by which the odometry frame is another than at the start.
        cloud_period: seconds between two clouds.
    """

    clouds: bool = True
    odometry: bool = True
    frozen: bool = False
    stopped: bool = False
    unit_ns: int = 1
    offset: float = 0.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cloud_period: float = CLOUD_PERIOD


def stamp(content: float, manner: Manner) -> int:
    """Return what a robot's clock says at a moment of its drive."""
    return (EPOCH_NS + round((content + manner.offset) * 1e6) * 1000) // manner.unit_ns


def content_of(stamp_ns: int, manners: list[Manner], near: float) -> float:
    """Return the moment of the drive that a stamp means to one of the manners: that which is nearest to ``near``."""

    def moment(manner: Manner) -> float:
        return (stamp_ns * manner.unit_ns - EPOCH_NS) / 1e9 - manner.offset

    return min(map(moment, manners), key=lambda content: abs(content - near))


def shifted(T_odom_body: Floats, shift: tuple[float, float, float]) -> Floats:
    """Return a pose in an odometry frame that is shifted and turned."""
    x, y, yaw = shift
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = x, y
    return np.asarray(T @ T_odom_body)


def drive_on(conn: Connection, endpoint: str, world: Path, name: str) -> None:
    """Send until told to stop; what is received is a :class:`Manner`, :data:`REOPEN`, or None to end."""
    import zenoh

    drive = Drive(world, RobotPlan(name, float("inf")))
    for k in range(2 * len(read_tum(world / "truth.tum")[0])):
        drive.cloud(k * CLOUD_PERIOD)
    manner, since = Manner(), 0.0
    how: dict[str, dict[str, Any]] = {
        "cloud": {"congestion_control": zenoh.CongestionControl.DROP},
        "odom": {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.INTERACTIVE_HIGH},
    }
    session = open_session("client", connect=[endpoint])
    conn.send("ready")
    start = float(conn.recv())
    due = {"odom": 0.0, "cloud": 0.0}
    while True:
        kind = "odom" if due["odom"] <= due["cloud"] else "cloud"
        if conn.poll(max(0.0, start + due[kind] - time.monotonic())):
            told = conn.recv()
            if told is None:
                break
            if told == REOPEN:
                session.close()
                session = open_session("client", connect=[endpoint])
                continue
            manner, since = told, round(time.monotonic() - start, 1)
            due["cloud"] = max(due["cloud"], since)
            continue
        content, late = due[kind], time.monotonic() - start - due[kind]
        period = ODOMETRY_PERIOD if kind == "odom" else manner.cloud_period
        due[kind] = round(content + period * max(1, int(late / period) if late > _LATE else 1), 6)
        if late > _LATE or not (manner.odometry if kind == "odom" else manner.clouds):
            continue
        at = stamp(since if manner.stopped else content, manner)
        if kind == "cloud":
            message = encode_cloud(CloudMessage(at, drive.cloud(content)), "xyz")
        else:
            pose = shifted(drive.T_odom_body(since if manner.frozen else content), manner.shift)
            message = encode_odometry(OdometryMessage(at, pose), "json")
        session.put(
            f"coview/{name}/in/{kind}", message.payload, encoding=message.encoding, attachment=message.attachment,
            **how[kind],
        )  # fmt: skip
    session.close()
    conn.send("ended")
