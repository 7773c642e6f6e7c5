"""Connection of a client: the endpoint that it connects to by default."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from coview_stream.stream.transport.transport import Transport

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Default endpoint of a client: zenoh's usual port, on this machine only."""


def open_client(
    endpoint: str | Sequence[str] | None = None,
    listen: str | Sequence[str] | None = None,
    config: str | Path | None = None,
    check_silence: bool = False,
) -> Transport:
    """Open a zenoh session for a client: to :data:`DEFAULT_ENDPOINT` unless something else is given.

    ``check_silence`` is as for :func:`coview_stream.stream.transport.zenoh_transport.open_transport`.

    Raises:
        TransportError: as :func:`coview_stream.stream.transport.zenoh_transport.open_transport`.
    """
    from coview_stream.stream.transport.zenoh_transport import open_transport

    connect = _listed(endpoint)
    if not connect and not _listed(listen) and config is None:
        connect = [DEFAULT_ENDPOINT]
    return open_transport(
        connect, _listed(listen), None if config is None else Path(config), check_silence=check_silence
    )


def _listed(endpoints: str | Sequence[str] | None) -> list[str]:
    return [endpoints] if isinstance(endpoints, str) else list(endpoints or ())
