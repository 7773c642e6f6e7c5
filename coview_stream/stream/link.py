"""Who is connected, and what of a change concerns people. Pure: fed with what the transport says."""

from __future__ import annotations

import logging

from coview_stream.stream.transport import Connection

log = logging.getLogger("coview_stream.node")


class Link:
    """Compares whom we are connected to with whom we were.

    Attributes:
        connection: at the last look.
        reconnects: how often a router came back, or another took its place. Peers come and go as they like.
    """

    def __init__(self) -> None:
        self.connection = Connection()
        self.reconnects = 0
        self._missed: set[str] = set()  # routers that were there once and have not been replaced

    def look(self, connection: Connection) -> None:
        """Take in whom we are connected to now, and log what has changed."""
        before, self.connection = self.connection, connection
        self._look_at_routers(set(before.routers), set(connection.routers))
        for zid in sorted(set(connection.peers) - set(before.peers)):
            log.info("peer %s is connected", zid)
        for zid in sorted(set(before.peers) - set(connection.peers)):
            log.info("peer %s is gone", zid)

    def _look_at_routers(self, before: set[str], now: set[str]) -> None:
        gone, come = before - now, now - before
        self._missed |= gone
        if come and self._missed:
            self.reconnects += 1
            for zid in sorted(come):
                how = "again" if zid in self._missed else f"instead of {', '.join(sorted(self._missed))}"
                log.info("connected to router %s %s", zid, how)
            # one that took another's place need not go for the other to be missed no more
            self._missed = self._missed - come if come & self._missed else set()
        elif come:
            log.info("connected to router %s", ", ".join(sorted(come)))
        elif gone:
            log.warning("router %s is gone%s", ", ".join(sorted(gone)), "" if now else ": nobody can hear us")
