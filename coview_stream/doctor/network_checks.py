"""Checks of the network: connections, and what the robots send."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Collection, Iterator, Sequence

from coview_stream.doctor.capture import Codecs, RobotCapture, Wait, capture_robots
from coview_stream.doctor.channel_checks import cloud_findings, odometry_findings
from coview_stream.doctor.cross_checks import captured_frames, cross_findings, node_finding
from coview_stream.doctor.discovery import Candidate, candidates_text, discover, served_robots
from coview_stream.doctor.finding import Finding
from coview_stream.doctor.frame_checks import frame_findings
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.transport import Connection, Transport

# all set by hand, seconds
_CONNECT_TIMEOUT = 2.0  # for a first connection to the given endpoints
_LISTEN_TIMEOUT = 6.0  # for a first connection from outside: a client tries again every 1 to 4 s
_POLL_PERIOD = 0.05
_TCP_TIMEOUT = 1.0
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
        return Finding("FAIL", "network", "nothing has connected", "start the others, and name this endpoint to them")
    reasons = [(endpoint, try_tcp(endpoint)) for endpoint in connect]
    found = "no session: " + ", ".join(f"{endpoint} {reason}" for endpoint, reason in reasons)
    if any(reason == _OPEN for _, reason in reasons):
        remedy = "another program, or it wants TLS or a password: RUST_LOG=zenoh=warn says more"
    else:
        remedy = (
            "start the router or node there ('coview-stream serve SITE.coview --robot NAME'), let the firewall pass "
            "its port, and give this the same --connect as the others"
        )
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


def robot_findings(
    capture: RobotCapture, candidates: Sequence[Candidate], sha256: str | None, served: Collection[str] = ()
) -> Iterator[Finding]:
    """Judge all of one robot.

    Args:
        capture: what it sent.
        candidates: what else is on the network.
        sha256: the map's, if one is known.
        served: robots that have a node.
    """
    others = set(served) - {capture.keys.robot}
    yield from cloud_findings(capture, candidates_text(candidates, "cloud", capture.keys.cloud, others))
    yield from odometry_findings(capture, candidates_text(candidates, "odometry", capture.keys.odometry, others))
    yield from cross_findings(capture)
    yield from frame_findings(captured_frames(capture), capture.keys.robot)
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
    served = served_robots(transport) if candidates else set()
    for capture in captures:
        yield from robot_findings(capture, candidates, sha256, served)
    if not keys:
        yield candidates_finding(candidates)


def candidates_finding(candidates: Sequence[Candidate]) -> Finding:
    """Name the clouds and odometry there are, for a user who has named no robot."""
    texts = [text for channel in ("cloud", "odometry") if (text := candidates_text(candidates, channel))]
    if texts:
        return Finding("ok", "robots", "; ".join(texts))
    return Finding("warn", "robots", "nothing that looks like clouds or odometry", "name one: --robot NAME")
