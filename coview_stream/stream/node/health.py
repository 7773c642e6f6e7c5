"""Health of a node for its operators: a document over zenoh and HTTP, Prometheus metrics, systemd notices."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from coview_stream.config.node import METRICS_ADDRESS
from coview_stream.localization.state import State
from coview_stream.messages.types import Encoded
from coview_stream.stream.maps.map_follower import MapFollower
from coview_stream.stream.node.fleet import Fleet
from coview_stream.stream.node.node import Node
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.http_server import HttpServer, Reply
from coview_stream.stream.transport.keys import NodeKeys
from coview_stream.version import __version__

log = logging.getLogger(__name__)

_MAX_BEAT = 2.0  # seconds without a tick of the pose clock, plus two of its periods
_INTERVAL = 1.0  # seconds between two documents


class NodeHealth:
    """Health of a node.

    It is *live* while its pose clock ticks and no thread has ended; otherwise it must be restarted. It is *ready*
    when a robot's messages would be used now: its engines have opened the map, it is connected if it
    ``needs_connection``, and every robot of its ``fleet``, if any, has a node. ``follower`` follows the map's remote
    sources, if any.
    """

    def __init__(
        self, node: Node, needs_connection: bool = False, follower: MapFollower | None = None,
        fleet: Fleet | None = None,
    ) -> None:  # fmt: skip
        self._node = node
        self._fleet = fleet
        self._needs_connection = needs_connection
        self._follower = follower
        self._errors = RateLimitedErrors(log)

    def live_reasons(self) -> list[str]:
        """Return why the node is not live; empty if it is."""
        node = self._node
        silent = time.monotonic() - node.beat
        reasons = [f"thread {name} has ended" for name in node.ended_threads]
        if silent > _MAX_BEAT + 2.0 / node.config.pose_rate:
            reasons.append(f"the pose clock has stood still for {silent:.1f} s")
        return reasons

    def ready_reasons(self) -> list[str]:
        """Return why the node is not ready; empty if it is."""
        engines = self._node.feeds[0].engines.items()
        reasons = [f"the {name} engine is starting" for name, engine in engines if not engine.ready]
        if self._needs_connection:
            connection = self._node.transport.connection()
            if not (connection.routers or connection.peers):
                reasons.append("not connected to any router or peer")
        if self._fleet is not None and (unserved := self._fleet.unserved):
            reasons.append(f"no node of the fleet serves {', '.join(unserved[:5])}{', ...' * (len(unserved) > 5)}")
        return reasons

    def document(self) -> dict[str, Any]:
        """Return everything as plain data; only robots that this node serves."""
        node = self._node
        live, ready = self.live_reasons(), self.ready_reasons()
        feed = node.feeds[0]
        now = time.monotonic()
        return {
            "stamp_ns": time.time_ns(),
            "version": __version__,
            "uptime_s": round(now - node.started, 1),
            "live": {"ok": not live, "reasons": live},
            "ready": {"ok": not (live or ready), "reasons": live + ready},
            "faults": dict(node.faults),
            "map": {"sha256": node.map_sha256, "reload": dict(node.reloader.last) if node.reloader else None}
            | ({"source": dict(self._follower.last)} if self._follower else {}),
            "memory_bytes": _memory(os.getpid()),
            "engines": {
                name: {
                    "pid": (pid := engine.pid),
                    "ready": engine.ready,
                    "restarts": feed.restarts[name],
                    "memory_bytes": None if pid is None else _memory(pid),
                }
                for name, engine in feed.engines.items()
            },
            "robots": {
                session.keys.robot: {
                    "state": session.state()[0].reported,
                    "reason": session.state()[1],
                    "pose_rate_hz": node.reporter.rates[session.keys.robot].rate(now),
                    "latency_ms": session.queue.latency.to_json(),
                    "counters": session.counters.to_json(),
                }
                for session in list(node.sessions)
                if node.endpoints[session.keys.robot].serving
            },
        }

    def answer(self, keys: NodeKeys) -> None:
        """Answer queries for the document and for a change of the map."""
        self._node.transport.answer(keys.ask_health, lambda parameters: self.document())
        self._node.transport.answer(keys.reload, lambda parameters: self._node.reload())

    def run(self, stopping: threading.Event, keys: NodeKeys) -> None:
        """Publish the document once a second until ``stopping`` is set."""
        publisher = self._node.transport.publisher(keys.health, "report")
        while not stopping.wait(_INTERVAL):
            with self._errors.catch("health"):  # one failed document must not end the others
                publisher.put(Encoded(json.dumps(self.document()).encode(), "application/json"))


def metrics_server(address: str, document: Callable[[], dict[str, Any]]) -> HttpServer:
    """Return a server of ``/metrics`` and ``/health`` (JSON; 200 if ready, else 503); ConfigError for a bad address."""

    def metrics(_: str) -> Reply:
        return Reply(prometheus_text(document()).encode(), "text/plain; version=0.0.4; charset=utf-8")

    def health(_: str) -> Reply:
        plain = document()
        return Reply(f"{json.dumps(plain)}\n".encode(), "application/json", 200 if plain["ready"]["ok"] else 503)

    routes = {"/metrics": metrics, "/health": health}
    server = HttpServer(address, routes, ("--metrics", METRICS_ADDRESS))
    log.info("metrics at %smetrics", server.url)
    return server


def prometheus_text(document: Mapping[str, Any]) -> str:
    """Return a document of :class:`NodeHealth` in the Prometheus text format, version 0.0.4."""
    lines: list[str] = []

    def add(name: str, kind: str, text: str, samples: Iterable[tuple[Mapping[str, str], float | None]]) -> None:
        lines.extend((f"# HELP coview_{name} {text}.", f"# TYPE coview_{name} {kind}"))
        for labels, value in samples:
            escaped = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})
            inner = ",".join(f'{key}="{label.translate(escaped)}"' for key, label in labels.items())
            if value is not None:
                lines.append(f"coview_{name}{{{inner}}} {value}" if inner else f"coview_{name} {value}")

    engines = [({"engine": name}, engine) for name, engine in document["engines"].items()]
    robots = [({"robot": name}, robot) for name, robot in document["robots"].items()]
    memory = [({"process": "node"}, document["memory_bytes"])]
    memory += [({"process": labels["engine"]}, engine["memory_bytes"]) for labels, engine in engines]
    info = {"version": document["version"], "map_sha256": document["map"]["sha256"]}
    add("info", "gauge", "Version and map", [(info, 1)])
    add("live", "gauge", "Whether the node works", [({}, int(document["live"]["ok"]))])
    add("ready", "gauge", "Whether the node can serve now", [({}, int(document["ready"]["ok"]))])
    add("uptime_seconds", "gauge", "Since the node started", [({}, document["uptime_s"])])
    add("memory_bytes", "gauge", "Resident memory", memory)
    ready = [(labels, int(engine["ready"])) for labels, engine in engines]
    add("engine_ready", "gauge", "Whether an engine can do a job now", ready)
    restarts = [(labels, engine["restarts"]) for labels, engine in engines]
    add("engine_restarts_total", "counter", "Starts of an engine after the first", restarts)
    names = sorted({state.reported for state in State})
    states = [(labels | {"state": name}, int(robot["state"] == name)) for labels, robot in robots for name in names]
    add("robot_state", "gauge", "1 for the state that a robot is in", states)
    add("pose_rate_hertz", "gauge", "Poses per second", [(labels, robot["pose_rate_hz"]) for labels, robot in robots])
    latencies = [
        (labels | {"quantile": f"0.{name[1:]}"}, None if value is None else value / 1e3)
        for labels, robot in robots
        for name, value in robot["latency_ms"].items()
    ]
    add("latency_seconds", "gauge", "From a cloud's arrival to its fix, newest frames", latencies)
    counted = [
        (labels | {"event": name}, value) for labels, robot in robots for name, value in robot["counters"].items()
    ]
    add("events_total", "counter", "What became of messages, and what else happened", counted)
    return "".join(f"{line}\n" for line in lines)


def _memory(pid: int) -> int | None:
    """Return the resident memory of a process, bytes; None without ``/proc``."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None


class Notifier:
    """Sends notices to systemd; never waits or fails. ``watchdog_period``: half of systemd's limit, s, or None."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._ends = False
        microseconds, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        fed = address and microseconds.isdecimal() and int(microseconds) and (not pid or pid == str(os.getpid()))
        self.watchdog_period = 0.5e-6 * int(microseconds) if fed else None

    def send(self, *lines: str) -> None:
        """Send one notice of several lines."""
        if not self._address or not hasattr(socket, "AF_UNIX"):
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.setblocking(False)
            notify.sendto("\n".join(lines).encode(), self._address)

    def ready(self, status: str) -> None:
        """Report that the service is up, with one line for ``systemctl status``; ignored once the service ends."""
        if not self._ends:
            self.send("READY=1", f"STATUS={status}")

    def reloading(self, busy: bool, status: str) -> None:
        """Report that a change of the map begins or is over."""
        if not busy:
            self.ready(status)
        elif not self._ends:
            self.send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}", f"STATUS={status}")

    def stopping(self) -> None:
        """Report that the service ends."""
        self._ends = True
        self.send("STOPPING=1")

    def run(self, stopping: threading.Event, live: Callable[[], bool]) -> None:
        """Send signs of life while the service is live, until ``stopping`` is set."""
        while self.watchdog_period is not None and not stopping.wait(self.watchdog_period):
            if live():
                self.send("WATCHDOG=1")
