"""What a zenoh session knows of others beyond samples: liveliness tokens, and how many are connected."""

from __future__ import annotations

from typing import Any

from coview_stream.stream.keyexpr import matches
from coview_stream.stream.reach import session_of
from coview_stream.stream.transport import Transport
from coview_stream.stream.zenoh_config import zenoh_errors

_PATIENCE = 1.0  # seconds; the answer usually takes milliseconds


def tokens(transport: Transport, expression: str, timeout: float = _PATIENCE) -> list[str]:
    """Keys of the tokens that match ``expression`` right now, sorted; none while there is no session."""
    if hasattr(transport, "query"):  # the fake network
        held: tuple[str, ...] = getattr(transport, "tokens", ())
        return sorted({token for token in held if matches(expression, token)})
    session: Any = session_of(transport)
    if session is None:
        return []
    with zenoh_errors(f"tokens {expression!r}"):
        replies = [reply.ok for reply in session.liveliness().get(expression, timeout=timeout)]
    return sorted({str(sample.key_expr) for sample in replies if sample is not None})


def connected(transport: Transport) -> dict[str, int]:
    """How many ``router``, ``peer`` and ``client`` sessions are connected."""
    session: Any = session_of(transport)
    if session is None:
        connection = transport.connection()
        return {"router": len(connection.routers), "peer": len(connection.peers), "client": 0}
    found = {"router": 0, "peer": 0, "client": 0}
    with zenoh_errors("connected sessions"):
        for other in session.info.transports():
            found[str(other.whatami)] = found.get(str(other.whatami), 0) + 1
    return found
