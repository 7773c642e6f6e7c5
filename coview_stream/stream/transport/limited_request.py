"""Requests to the HTTP servers of a node: read up to a limit, so that no sender holds a thread or memory."""

from __future__ import annotations

import io
import socket
import time
from typing import Any

MAX_SECONDS = 2.0
"""Seconds for a whole request, set by hand; servers give their answers as long."""
_MAX_BYTES = 8192  # of a request, set by hand


class LimitedRequest(io.RawIOBase):
    """What a socket sends, up to a number of bytes and seconds together, then its end."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__()
        self._connection = connection
        self._deadline = time.monotonic() + MAX_SECONDS
        self._left = _MAX_BYTES

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read what there is; 0 after the last byte or second that is allowed."""
        seconds = self._deadline - time.monotonic()
        if seconds <= 0 or self._left <= 0:
            return 0
        self._connection.settimeout(seconds)
        try:
            count = self._connection.recv_into(buffer, min(len(buffer), self._left))
        except OSError:
            return 0
        self._left -= count
        return count
