"""Process of a long-running command: its log, and the signals that ask it to end."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

from coview_stream.errors import printable

_ASKED = b"."
_ENDING = frozenset((signal.SIGINT, signal.SIGTERM, ord(_ASKED)))  # bytes in the pipe: a signal's number, or ours


class Stop:
    """Request to end, set once by a signal handler or any thread; it wakes the waiting thread.

    Not a :class:`threading.Event`, which can deadlock if a signal handler sets it while its thread waits for it.
    Writing a byte to a pipe cannot.
    """

    def __init__(self) -> None:
        self.requested = False
        self._read, self._write = os.pipe()
        os.set_blocking(self._read, False)
        os.set_blocking(self._write, False)

    def request(self) -> None:
        """Ask to end; safe in a signal handler."""
        with contextlib.suppress(OSError):  # full or closed: already asked
            os.write(self._write, _ASKED)
        # last: a reader may then close the pipe, and its descriptors may come to name another file
        self.requested = True

    def now(self) -> float:
        """Return the monotonic clock, seconds."""
        return time.monotonic()

    def wait(self, seconds: float) -> bool:
        """Wait for ``seconds``; True once the end is requested, False once another signal has come."""
        if not self.requested and seconds > 0 and select.select([self._read], [], [], seconds)[0]:
            with contextlib.suppress(OSError):  # another thread has read it
                if _ENDING.intersection(os.read(self._read, 4096)):
                    self.request()  # keeps a byte in the pipe for all waiters
        return self.requested

    @contextlib.contextmanager
    def woken_by_signals(self) -> Iterator[None]:
        """Make every signal wake the waits, whichever thread the kernel delivers it to; on the main thread only.

        A Python handler runs on the main thread, which may sleep in a system call while another thread takes the
        signal; the interpreter writes the signal's number to the pipe at once, on any thread.
        """
        before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)

    def close(self) -> None:
        """Release the pipe."""
        os.close(self._read)
        os.close(self._write)


@contextlib.contextmanager
def stop_on_signals(on_hangup: Callable[[], None] | None = None) -> Iterator[Stop]:
    """Yield a :class:`Stop` that SIGINT and SIGTERM request; a second SIGINT interrupts at once.

    Outside the main thread, where Python delivers no signals, only callers can request it. SIGHUP calls ``on_hangup``
    on the main thread; None leaves that signal alone.
    """
    stop = Stop()
    interrupted = False

    def handler(number: int, _frame: object) -> None:
        nonlocal interrupted
        if interrupted and number == signal.SIGINT:
            raise KeyboardInterrupt
        interrupted = True
        stop.request()

    with contextlib.ExitStack() as stack:
        stack.callback(stop.close)
        if threading.current_thread() is threading.main_thread():
            stack.enter_context(stop.woken_by_signals())
            for number in (signal.SIGINT, signal.SIGTERM):
                stack.callback(signal.signal, number, signal.signal(number, handler))
            if on_hangup is not None and hasattr(signal, "SIGHUP"):
                hangup = signal.signal(signal.SIGHUP, lambda _number, _frame: on_hangup())
                stack.callback(signal.signal, signal.SIGHUP, hangup)
        yield stop


class JsonFormatter(logging.Formatter):
    """One JSON object per record: ``time`` (ISO 8601, UTC), ``level``, ``logger``, ``message``, any ``exception``."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as one line."""
        document = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return json.dumps(document)


class LineFormatter(logging.Formatter):
    """One printable line per record, and the lines of its exception; its names may come from anyone."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # logging's name
        """Return the line."""
        return printable(super().formatMessage(record))


def start_logging(level: int, as_json: bool) -> None:
    """Log to stderr from ``level`` upward."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter() if as_json else LineFormatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])
