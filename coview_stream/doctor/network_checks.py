"""The network: whether anybody is there, and what the robots send."""

from __future__ import annotations

import contextlib
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from coview_stream.doctor.capture import Heard, Seen, see_cloud, see_odometry
from coview_stream.doctor.channel_checks import cloud_findings, odometry_findings
from coview_stream.doctor.cross_checks import node_finding, together_findings
from coview_stream.doctor.discovery import Offer, look, suggestion
from coview_stream.doctor.finding import Finding
from coview_stream.errors import MessageError
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, prepare
from coview_stream.messages.json_messages import read_status
from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.transport import Connection, Transport

Wait = Callable[[float], object]
Codecs = tuple[str | None, str | None]

_PATIENCE = 2.0  # seconds for a first connection
_CALLERS = 6.0  # the same where others have to find us: a client tries again every 1 to 4 s
_STEP = 0.05
_KNOCK = 1.0  # seconds
_MOST = 20_000  # messages kept of a channel: enough for 30 s of the fastest IMU odometry
_TCP = re.compile(r"(?:tcp|tls|ws)/(\[[^\]]+\]|[^:/]+):(\d+)")


def reach_finding(transport: Transport, connect: Sequence[str], wait: Wait = time.sleep) -> Finding:
    """Whether a router or a peer is connected; ``connect`` are the endpoints to name if not."""
    waited = 0.0
    while not _met(transport) and waited < (_PATIENCE if connect else _CALLERS):
        wait(_STEP)
        waited += _STEP
    if _met(transport):
        return Finding("ok", "network", f"connected: {_counted(transport.connection())}")
    if not connect:
        return Finding(
            "FAIL", "network", "nobody has connected", "start the others, and name this endpoint to them"
        )
    reasons = [(endpoint, knock(endpoint)) for endpoint in connect]
    found = "no session: " + ", ".join(f"{endpoint} {reason}" for endpoint, reason in reasons)
    if any(reason == _OPEN for _, reason in reasons):
        remedy = "another program, or it wants TLS or a password: RUST_LOG=zenoh=warn says more"
    else:
        remedy = "start the router or node there, and let the firewall pass its port"
    return Finding("FAIL", "network", found, remedy)


_OPEN = "is open, but no zenoh session came about"


def knock(endpoint: str) -> str:
    """Say what becomes of a plain TCP connection to an endpoint that zenoh cannot reach."""
    found = _TCP.match(endpoint)
    if found is None:
        return "does not answer"
    try:
        with socket.create_connection((found[1].strip("[]"), int(found[2])), timeout=_KNOCK):
            return _OPEN
    except ConnectionRefusedError:
        return "refuses: nothing listens there"
    except socket.gaierror:
        return "is no host that is known here"
    except TimeoutError:
        return "does not answer: off, or behind a firewall"
    except OSError as error:
        return f"cannot be reached: {error.strerror or error}"


def _met(transport: Transport) -> bool:
    connection = transport.connection()
    return bool(connection.routers or connection.peers)


def _counted(connection: Connection) -> str:
    """Text of how many routers, peers and clients are connected, such as ``1 router, 2 peers``."""
    clients = len(connection.clients)
    counts = {"router": len(connection.routers), "peer": len(connection.peers) - clients, "client": clients}
    return ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items() if n)


def listen(
    transport: Transport,
    keys: Sequence[RobotKeys],
    seconds: float,
    codecs: Codecs = (None, None),
    wait: Wait = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> list[Heard]:
    """Receive what robots send for ``seconds``.

    Args:
        transport: open.
        keys: of each robot.
        seconds: to listen.
        codecs: of all clouds and all odometry, whatever they say; None believes them.
        wait: passes the time.
        clock: local time, seconds.
    """
    prepare(*CLOUD_CODECS, *ODOMETRY_CODECS)
    heard = [Heard(k) for k in keys]
    over = False

    def keep(channel: list[Seen], see: Callable[[Sample, float], Seen]) -> Callable[[Sample], None]:
        def handler(sample: Sample) -> None:
            if not over and len(channel) < _MOST:
                channel.append(see(sample, clock()))

        return handler

    def status_of(one: Heard) -> Callable[[Sample], None]:
        def handler(sample: Sample) -> None:
            with contextlib.suppress(MessageError):
                one.status = read_status(sample)

        return handler

    for one in heard:
        k = one.keys
        one.began = clock()
        odometry = keep(one.odometry, partial(see_odometry, option=codecs[1], hint=k.odometry_hint))
        transport.subscribe(k.odometry, odometry, "all")
        clouds = keep(one.clouds, partial(see_cloud, option=codecs[0], hint=k.cloud_hint))
        transport.subscribe(k.cloud, clouds, "all")
        transport.subscribe(k.status, status_of(one), "all")
    wait(seconds)
    over = True
    for one in heard:
        one.ended = clock()
        one.alive = bool(transport.tokens(one.keys.alive))
    return heard


def robot_findings(heard: Heard, offers: Sequence[Offer], sha256: str | None) -> Iterator[Finding]:
    """Judge all of one robot; ``offers`` are what else is on the network, ``sha256`` the map's if one is known."""
    yield from cloud_findings(heard, suggestion(offers, "cloud"))
    yield from odometry_findings(heard, suggestion(offers, "odometry"))
    yield from together_findings(heard)
    yield node_finding(heard, sha256)


def robots_findings(
    transport: Transport,
    keys: Sequence[RobotKeys],
    seconds: float,
    codecs: Codecs = (None, None),
    sha256: str | None = None,
    wait: Wait = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Finding]:
    """Listen to all robots at once and judge each; without any, or if one is silent, say who else is there."""
    heard = listen(transport, keys, seconds, codecs, wait, clock) if keys else []
    silent = not all(one.clouds and one.odometry for one in heard)
    offers = look(transport, wait=wait) if silent or not keys else []
    for one in heard:
        yield from robot_findings(one, offers, sha256)
    if not keys:
        yield offers_finding(offers)


def offers_finding(offers: Sequence[Offer]) -> Finding:
    """Name what there is, for somebody who has named no robot."""
    texts = [text for channel in ("cloud", "odometry") if (text := suggestion(offers, channel))]
    if texts:
        return Finding("ok", "robots", "; ".join(texts))
    return Finding("warn", "robots", "nothing that looks like clouds or odometry", "name one: --robot NAME")
