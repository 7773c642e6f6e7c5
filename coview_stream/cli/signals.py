"""A request to end, made by SIGINT and SIGTERM."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Iterator


class Stop:
    """Request to end, set once from a signal handler or any thread; it wakes the thread that waits.

    No :class:`threading.Event`: setting one in a signal handler can deadlock with a wait of the interrupted thread.
    Writing a byte to a pipe cannot.
    """

    def __init__(self) -> None:
        self.requested = False
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)

    def request(self) -> None:
        """Ask to end; safe in a signal handler."""
        self.requested = True
        with contextlib.suppress(OSError):  # full or closed: it has been asked before
            os.write(self._write, b".")

    def now(self) -> float:
        """Return the steady clock, seconds."""
        return time.monotonic()

    def wait(self, seconds: float) -> bool:
        """Let ``seconds`` pass; True as soon as the end is requested."""
        if not self.requested and seconds > 0:
            select.select([self._read], [], [], seconds)
        return self.requested

    def close(self) -> None:
        """Release the pipe."""
        os.close(self._read)
        os.close(self._write)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Give a :class:`Stop` that SIGINT and SIGTERM request; a second SIGINT interrupts for good.

    Outside the main thread, where Python delivers no signals, it is an ordinary one.
    """
    stop = Stop()

    def handler(number: int, _frame: object) -> None:
        if stop.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        stop.request()

    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, old in before.items():
            signal.signal(number, old)
        stop.close()
