"""Guard of handlers: logs their errors at a limited rate and keeps threads alive."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from coview_stream.errors import printable


def is_panic(error: BaseException) -> bool:
    """Whether a Rust library panicked: pyo3's PanicException is not an Exception, and cannot be imported."""
    return type(error).__name__ == "PanicException"


_MAX_PLACES = 256  # beyond it the places of the oldest lines are forgotten: strangers may choose keys


@dataclass
class Caught:
    """Error raised in a block of :meth:`RateLimitedErrors.catch`; None without one."""

    error: Exception | None = None


class RateLimitedErrors:
    """Log of handler errors: the first of each kind at once, then at most one line per ``interval``, seconds."""

    def __init__(
        self, logger: logging.Logger, interval: float = 10.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._logger = logger
        self._interval = interval
        self._clock = clock
        self._lock = threading.Lock()
        self._last: dict[str, float] = {}
        self._silent: dict[str, int] = {}

    @contextmanager
    def catch(self, place: str) -> Iterator[Caught]:
        """Log an error raised in the block as one at ``place``, and continue after the block."""
        caught = Caught()
        try:
            yield caught
        except Exception as error:  # of any kind: the thread continues with the next message
            self.report(place, error)
            caught.error = error
        except BaseException as error:
            if not is_panic(error):
                raise
            self.report(place, error)
            caught.error = RuntimeError(str(error))

    def report(self, place: str, error: BaseException, kind: str = "") -> None:
        """Log ``error``, unless a line about ``place`` and ``kind`` was logged within the interval."""
        about = f"{place}: {kind}"
        with self._lock:
            now = self._clock()
            last = self._last.get(about)
            if last is not None and now - last < self._interval:
                self._silent[about] = self._silent.get(about, 0) + 1
                return
            self._last.pop(about, None)
            if len(self._last) >= _MAX_PLACES:
                oldest = next(iter(self._last))
                self._last.pop(oldest)
                self._silent.pop(oldest, None)
            self._last[about] = now
            silent = self._silent.pop(about, 0)
        more = f" ({silent} more since the last line)" if silent else ""
        self._logger.error(
            "%s: %s: %s%s",
            printable(place),
            type(error).__name__,
            printable(error),  # the error itself would keep its frames alive with the record
            more,
            exc_info=self._logger.isEnabledFor(logging.DEBUG),
        )
