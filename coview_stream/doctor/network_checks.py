"""Checks of the network: connections, and what the robots send."""

from __future__ import annotations

import contextlib
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from coview_stream.doctor.capture import CapturedMessage, RobotCapture, capture_cloud, capture_odometry
from coview_stream.doctor.channel_checks import cloud_findings, odometry_findings
from coview_stream.doctor.cross_checks import cross_findings, node_finding
from coview_stream.doctor.discovery import Candidate, discover, suggestion
from coview_stream.doctor.finding import Finding
from coview_stream.errors import MessageError
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, prepare
from coview_stream.messages.json_messages import read_status
from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.transport import Connection, Transport

Wait = Callable[[float], object]
Codecs = tuple[str | None, str | None]

# all set by hand, seconds
_CONNECT_TIMEOUT = 2.0  # for a first connection to the given endpoints
_LISTEN_TIMEOUT = 6.0  # for a first connection from outside: a client tries again every 1 to 4 s
_POLL_PERIOD = 0.05
_TCP_TIMEOUT = 1.0
_MAX_MESSAGES = 20_000  # kept of a channel, set by hand: enough for 30 s of the fastest IMU odometry
_OPEN = "is open, but no zenoh session came about"
_TCP = re.compile(r"(?:tcp|tls|ws)/(\[[^\]]+\]|[^:/]+):(\d+)")


def connection_finding(transport: Transport, connect: Sequence[str], wait: Wait = time.sleep) -> Finding:
    """Judge whether a router or a peer is connected; ``connect`` are the endpoints to name if not."""
    waited = 0.0
    while not _connected(transport) and waited < (_CONNECT_TIMEOUT if connect else _LISTEN_TIMEOUT):
        wait(_POLL_PERIOD)
        waited += _POLL_PERIOD
    if _connected(transport):
        return Finding("ok", "network", f"connected: {_counts(transport.connection())}")
    if not connect:
        return Finding(
            "FAIL", "network", "nothing has connected", "start the others, and name this endpoint to them"
        )
    reasons = [(endpoint, try_tcp(endpoint)) for endpoint in connect]
    found = "no session: " + ", ".join(f"{endpoint} {reason}" for endpoint, reason in reasons)
    if any(reason == _OPEN for _, reason in reasons):
        remedy = "another program, or it wants TLS or a password: RUST_LOG=zenoh=warn says more"
    else:
        remedy = "start the router or node there, and let the firewall pass its port"
    return Finding("FAIL", "network", found, remedy)


def try_tcp(endpoint: str) -> str:
    """Try a plain TCP connection to an endpoint that zenoh cannot reach, and return what came of it, in words."""
    address = _TCP.match(endpoint)
    if address is None:
        return "does not answer"
    try:
        with socket.create_connection((address[1].strip("[]"), int(address[2])), timeout=_TCP_TIMEOUT):
            return _OPEN
    except ConnectionRefusedError:
        return "refuses: nothing listens there"
    except socket.gaierror:
        return "is no host that is known here"
    except TimeoutError:
        return "does not answer: off, or behind a firewall"
    except OSError as error:
        return f"cannot be reached: {error.strerror or error}"


def _connected(transport: Transport) -> bool:
    connection = transport.connection()
    return bool(connection.routers or connection.peers)


def _counts(connection: Connection) -> str:
    """Return how many routers, peers and clients are connected, such as ``1 router, 2 peers``."""
    clients = len(connection.clients)
    counts = {"router": len(connection.routers), "peer": len(connection.peers) - clients, "client": clients}
    return ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items() if n)


def capture_robots(
    transport: Transport,
    keys: Sequence[RobotKeys],
    seconds: float,
    codecs: Codecs = (None, None),
    wait: Wait = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> list[RobotCapture]:
    """Receive what robots send for ``seconds``.

    Args:
        transport: open transport.
        keys: keys of each robot.
        seconds: duration.
        codecs: codec of all clouds and of all odometry, over what they name themselves; None goes by that.
        wait: passes the time.
        clock: local time, seconds.
    """
    prepare(*CLOUD_CODECS, *ODOMETRY_CODECS)
    captures = [RobotCapture(k) for k in keys]
    over = False

    def keep(
        messages: list[CapturedMessage], describe: Callable[[Sample, float], CapturedMessage]
    ) -> Callable[[Sample], None]:
        def handler(sample: Sample) -> None:
            if not over and len(messages) < _MAX_MESSAGES:
                messages.append(describe(sample, clock()))

        return handler

    def keep_status(capture: RobotCapture) -> Callable[[Sample], None]:
        def handler(sample: Sample) -> None:
            with contextlib.suppress(MessageError):
                capture.status = read_status(sample)

        return handler

    for capture in captures:
        k = capture.keys
        capture.began = clock()
        odometry = keep(capture.odometry, partial(capture_odometry, option=codecs[1], hint=k.odometry_hint))
        transport.subscribe(k.odometry, odometry, "all")
        clouds = keep(capture.clouds, partial(capture_cloud, option=codecs[0], hint=k.cloud_hint))
        transport.subscribe(k.cloud, clouds, "all")
        transport.subscribe(k.status, keep_status(capture), "all")
    wait(seconds)
    over = True
    for capture in captures:
        capture.ended = clock()
        capture.alive = bool(transport.tokens(capture.keys.alive))
    return captures


def robot_findings(
    capture: RobotCapture, candidates: Sequence[Candidate], sha256: str | None
) -> Iterator[Finding]:
    """Judge all of one robot; ``candidates`` are what else is on the network, ``sha256`` the map's if one is known."""
    yield from cloud_findings(capture, suggestion(candidates, "cloud"))
    yield from odometry_findings(capture, suggestion(candidates, "odometry"))
    yield from cross_findings(capture)
    yield node_finding(capture, sha256)


def robots_findings(
    transport: Transport,
    keys: Sequence[RobotKeys],
    seconds: float,
    codecs: Codecs = (None, None),
    sha256: str | None = None,
    wait: Wait = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Finding]:
    """Listen to all robots at once and judge each; without any, or if one is silent, look for others."""
    captures = capture_robots(transport, keys, seconds, codecs, wait, clock) if keys else []
    silent = not all(capture.clouds and capture.odometry for capture in captures)
    candidates = discover(transport, wait=wait) if silent or not keys else []
    for capture in captures:
        yield from robot_findings(capture, candidates, sha256)
    if not keys:
        yield candidates_finding(candidates)


def candidates_finding(candidates: Sequence[Candidate]) -> Finding:
    """Name the clouds and odometry there are, for a user who has named no robot."""
    texts = [text for channel in ("cloud", "odometry") if (text := suggestion(candidates, channel))]
    if texts:
        return Finding("ok", "robots", "; ".join(texts))
    return Finding("warn", "robots", "nothing that looks like clouds or odometry", "name one: --robot NAME")
