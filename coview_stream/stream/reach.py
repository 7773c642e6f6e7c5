"""What a robot or a person wants of a network beyond publish and subscribe: reach it, ask, know who listens."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from coview_stream.errors import TransportError
from coview_stream.stream.transport import Transport

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where a client looks when nothing is said: zenoh's usual port, on this machine only."""

_POLL = 0.02  # seconds; a look at the matching status costs microseconds


def open_client(
    endpoint: str | Sequence[str] | None = None,
    listen: str | Sequence[str] | None = None,
    config: str | Path | None = None,
) -> Transport:
    """Open a zenoh session for a client: to ``tcp/127.0.0.1:7447`` if nothing is said.

    Raises:
        TransportError: as :func:`coview_stream.stream.zenoh_transport.open_transport`.
    """
    from coview_stream.stream.zenoh_transport import open_transport

    connect = _listed(endpoint)
    if not connect and not _listed(listen) and config is None:
        connect = [DEFAULT_ENDPOINT]
    return open_transport(connect, _listed(listen), None if config is None else Path(config))


def _listed(endpoints: str | Sequence[str] | None) -> list[str]:
    return [endpoints] if isinstance(endpoints, str) else list(endpoints or ())


def ask(
    transport: Transport, key: str, parameters: dict[str, str] | None = None, timeout: float = 5.0
) -> dict[str, Any]:
    """Query ``key`` and return the first JSON reply.

    Args:
        transport: zenoh's, or the fake one.
        key: of the queryable.
        parameters: of the query.
        timeout: seconds.

    Raises:
        TransportError: nobody answered, the answer was an error, or it is no JSON object.
    """
    parameters = parameters or {}
    if hasattr(transport, "query"):  # the fake network
        answer: dict[str, Any] = transport.query(key, parameters)
        if set(answer) == {"error"}:
            raise TransportError(f"{key}: the node refused: {answer['error']}")
        return answer
    import zenoh

    deadline = time.monotonic() + timeout
    while (session := session_of(transport)) is None and time.monotonic() < deadline:
        time.sleep(_POLL)
    if session is not None:
        left = max(_POLL, deadline - time.monotonic())
        for reply in session.get(zenoh.Selector(key, parameters), timeout=left):
            if reply.ok is None:
                raise TransportError(f"{key}: the node refused: {_error_of(reply.err.payload.to_bytes())}")
            return _json_object(key, reply.ok.payload.to_bytes())
    raise TransportError(f"{key}: nobody answered within {timeout:g} s; is the node running and connected?")


def await_subscriber(
    transport: Transport, key: str, seconds: float, wait: Callable[[float], object] = time.sleep
) -> bool:
    """Wait up to ``seconds`` until somebody subscribes to ``key``; False if nobody did.

    ``wait(seconds)`` passes the time between two looks; what it returns as true ends the waiting early. A transport
    that cannot tell (the fake one) counts as listened to.
    """
    if hasattr(transport, "query"):
        return True
    probe: Any = None
    deadline = time.monotonic() + seconds
    try:
        while True:
            session = session_of(transport)
            if probe is None and session is not None:
                probe = session.declare_publisher(key)
            if probe is not None and probe.matching_status.matching:
                return True
            if time.monotonic() >= deadline or wait(_POLL):
                return False
    finally:
        if probe is not None:
            probe.undeclare()


def session_of(transport: Transport) -> Any:
    """Return the zenoh session of a transport; None while it waits for its first router."""
    return getattr(transport, "session", None)


def _json_object(key: str, payload: bytes) -> dict[str, Any]:
    try:
        answer = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise TransportError(
            f"{key}: the answer is no JSON ({error}); is this a coview_stream node?"
        ) from error
    if not isinstance(answer, dict):
        raise TransportError(f"{key}: the answer is no JSON object; is this a coview_stream node?")
    return answer


def _error_of(payload: bytes) -> str:
    """Text of an error reply: the ``error`` of its JSON, or the bytes as text."""
    try:
        return str(json.loads(payload)["error"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return payload[:200].decode("utf-8", "replace")
