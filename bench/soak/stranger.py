"""A stranger on the network that has every verb of zenoh and no manners, in a process of its own."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from bench.stream.drive import EPOCH_NS
from bench.stream.processes import open_session, rubbish
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage

SIGNED = b"stranger"
"""Attachment of what it puts on the robots' outputs: without access rules nothing else tells it from a node's."""

ASKED = ("**", "coview/**", "coview/*/rpc/*", "*/*/rpc/reset", "coview/*/out/*")
_OUTPUTS = ("out/pose", "out/status", "rpc/reset", "rpc/relocalize", "alive")
_RATE = 150.0  # messages of rubbish a second


def ask(session: Any, robots: Sequence[str], _: float) -> int:
    """Query with wildcards."""
    del robots
    return sum(len(list(session.get(asked, timeout=2.0))) for asked in ASKED)


def spoof(session: Any, robots: Sequence[str], seconds: float) -> int:
    """Put poses and other things on keys that the node answers on or publishes."""
    far = np.eye(4)
    far[:3, 3] = 1e5
    pose = encode_pose(PoseMessage(EPOCH_NS, robots[0], "TRACKING", far, np.eye(6), 1.0, "0" * 64), "json")
    end, count = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        for robot in robots:
            for output in _OUTPUTS:
                session.put(f"coview/{robot}/{output}", pose.payload, encoding=pose.encoding, attachment=SIGNED)
                count += 1
        time.sleep(0.1)
    return count


def delete(session: Any, robots: Sequence[str], seconds: float) -> int:
    """Delete keys of inputs, outputs and everything."""
    end, count = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        for key in (
            "**",
            "coview/**",
            *(f"coview/{robot}/in/{what}" for robot in robots for what in ("odom", "cloud")),
        ):
            session.delete(key, attachment=SIGNED)
            count += 1
        time.sleep(0.1)
    return count


def flood(session: Any, robots: Sequence[str], seconds: float) -> int:
    """Pour rubbish on the inputs."""
    source, end, count = rubbish(int(time.monotonic())), time.monotonic() + seconds, 0
    while time.monotonic() < end:
        message, key = next(source), f"coview/{robots[count // 2 % len(robots)]}/in/{('cloud', 'odom')[count % 2]}"
        session.put(key, message.payload, encoding=message.encoding or None, attachment=message.attachment)
        count += 1
        time.sleep(1.0 / _RATE)
    return count


def claim(session: Any, robots: Sequence[str], seconds: float) -> int:
    """Hold the robots' tokens, subscribe to everything, and answer every query with rubbish."""
    held = [session.liveliness().declare_token(f"coview/{robot}/alive") for robot in robots]
    held.append(session.declare_subscriber("**", lambda _: None))
    held += [
        session.declare_queryable(f"coview/{robot}/rpc/*", lambda query: query.reply(query.key_expr, b"\xff"))
        for robot in robots
    ]
    time.sleep(seconds)
    for each in held:
        each.undeclare()
    return len(held)


_DEEDS = {"ask": ask, "spoof": spoof, "delete": delete, "flood": flood, "claim": claim}


def roam(conn: Connection, endpoint: str, robots: Sequence[str]) -> None:
    """Do the deeds that it is told, ``(name, seconds)``, until None; sends back how many messages or answers."""
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        while (told := conn.recv()) is not None:
            name, seconds = told
            count = 0
            with contextlib.suppress(Exception):  # whatever the network does to it
                count = _DEEDS[name](session, robots, seconds)
            conn.send(count)
    conn.send(json.dumps("ended"))
