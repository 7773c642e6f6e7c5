"""Stands in for the node, so that the measuring client can be tried: speaks the contract, knows the truth.

``python -m bench.stream_stand_in MAP --robot r1 --connect EP`` with COVIEW_BENCH_WORLD naming the world. It reads only
the native formats; a robot whose cloud did not come for five seconds, or whose odometry is old, gets no poses.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import struct
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.stream.client import open_session
from bench.stream.drive import Drive

_SEARCH, _OLDEST, _PERIOD = 3.0, 0.5, 0.1


class Robot:
    """One robot as the stand-in sees it."""

    def __init__(self, session: Any, base: str, name: str, world: Path) -> None:
        import zenoh

        self.name, self.drive, self.counters = name, Drive(world, name), Counter[str]()
        self.stamp = self.frame = 0
        self.first_cloud = self.odometry_at = 0.0
        self.state, self.rng = "SEARCHING", np.random.default_rng(0)
        self.out = session.declare_publisher(
            f"{base}/{name}/out/pose", priority=zenoh.Priority.REAL_TIME, express=True
        )
        self.status = session.declare_publisher(f"{base}/{name}/out/status")
        self.held = [
            session.declare_subscriber(f"{base}/{name}/in/cloud", self.cloud),
            session.declare_subscriber(f"{base}/{name}/in/odom", self.odometry),
            session.liveliness().declare_token(f"{base}/{name}/alive"),
            session.declare_queryable(f"{base}/{name}/rpc/*", self.answer),
        ]

    def answer(self, query: Any) -> None:
        """Agree to everything."""
        query.reply(str(query.key_expr), b'{"ok": true}')

    def cloud(self, sample: Any) -> None:
        """Take a cloud's stamp."""
        self.counters["received"] += 1
        try:
            (stamp,) = struct.unpack("<q", sample.attachment.to_bytes())
        except (AttributeError, struct.error):
            self.counters["malformed"] += 1
            return
        if stamp <= self.frame:
            self.counters["duplicate" if stamp == self.frame else "out_of_order"] += 1
            return
        self.frame = stamp
        self.counters["processed"] += 1
        self.first_cloud = self.first_cloud or time.monotonic()

    def odometry(self, sample: Any) -> None:
        """Take an odometry's stamp."""
        try:
            self.stamp = max(self.stamp, int(json.loads(sample.payload.to_bytes())["stamp_ns"]))
            self.odometry_at = time.monotonic()
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            self.counters["malformed"] += 1

    def tick(self, now: float) -> None:
        """Publish a pose, if it has one, and the state when it changes."""
        posed = self.first_cloud and now - self.first_cloud > _SEARCH and now - self.odometry_at < _OLDEST
        state = "TRACKING" if posed else "LOST" if self.state in ("TRACKING", "LOST") else "SEARCHING"
        if state != self.state:
            self.state = state
            self.tell()
        if posed:
            T = self.drive.truth(self.stamp)
            T[:3, 3] += self.rng.normal(0, 0.02, 3)
            pose = {
                "stamp_ns": self.stamp, "robot": self.name, "state": state, "position": T[:3, 3].tolist(),
                "orientation": Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), "covariance": [0.0] * 36,
                "confidence": 0.9, "map_sha256": "", "age_s": (self.stamp - self.frame) / 1e9,
            }  # fmt: skip
            self.out.put(json.dumps(pose), encoding="application/json")

    def tell(self) -> None:
        """Publish a status."""
        told = {
            "robot": self.name,
            "state": self.state,
            "last_frame_ns": self.frame,
            "counters": self.counters,
        }
        self.status.put(json.dumps(told), encoding="application/json")


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map")
    parser.add_argument("--robot", nargs="+", required=True)
    parser.add_argument("--connect", required=True)
    parser.add_argument("--pose-encoding", default="json")
    args = parser.parse_args(argv)
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with open_session("client", connect=[args.connect]) as session:
        world = Path(os.environ["COVIEW_BENCH_WORLD"])
        robots = [Robot(session, "coview", name, world) for name in args.robot]
        due, told = time.monotonic(), 0.0
        while not stop.wait(max(0.0, due - time.monotonic())):
            for robot in robots:
                robot.tick(due)
                if due - told >= 1.0:
                    robot.tell()
            told = due if due - told >= 1.0 else told
            due += _PERIOD
        for robot in robots:
            robot.tell()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
