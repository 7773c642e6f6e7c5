"""Notices to systemd over ``NOTIFY_SOCKET``, where the service manager has set one; elsewhere nothing happens.

As ``sd_notify(3)`` describes them: ``READY=1`` once poses can be given, ``WATCHDOG=1`` as long as the node is live,
``RELOADING=1`` and again ``READY=1`` around a change of the map, ``STOPPING=1`` at the end.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping


class Notifier:
    """Sends notices; never waits, and never fails.

    Args:
        environment: of the process.

    Attributes:
        watchdog_period: seconds between two signs of life, half of the limit that systemd sets; None if it wants none.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_period = self._period(environment) if address else None
        self._ends = False

    @staticmethod
    def _period(environment: Mapping[str, str]) -> float | None:
        microseconds, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        if not microseconds.isdecimal() or int(microseconds) == 0 or (pid and pid != str(os.getpid())):
            return None
        return 0.5e-6 * int(microseconds)

    def send(self, *lines: str) -> None:
        """Send one notice of several lines."""
        if not self._address or not hasattr(socket, "AF_UNIX"):
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.setblocking(False)
            notify.sendto("\n".join(lines).encode(), self._address)

    def ready(self, status: str) -> None:
        """Tell that the service is up, with one line for ``systemctl status``; not any more once it ends."""
        if not self._ends:
            self.send("READY=1", f"STATUS={status}")

    def reloading(self, busy: bool, status: str) -> None:
        """Tell that a change of the map begins, or that it is over."""
        if not busy:
            self.ready(status)
        elif not self._ends:
            self.send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}", f"STATUS={status}")

    def stopping(self) -> None:
        """Tell that the service ends."""
        self._ends = True
        self.send("STOPPING=1")

    def run(self, stopping: threading.Event, live: Callable[[], bool]) -> None:
        """Give signs of life, as long as there is life, until ``stopping`` is set."""
        while self.watchdog_period is not None and not stopping.wait(self.watchdog_period):
            if live():
                self.send("WATCHDOG=1")
