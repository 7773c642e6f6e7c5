"""Daemon thread that runs queued calls one after the other, for callers on any thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

R = TypeVar("R")


class StoppedError(Exception):
    """The thread takes no more calls."""


class _Job:
    """A call in the queue."""

    __slots__ = ("call", "done", "error", "result")

    def __init__(self, call: Callable[[], Any]) -> None:
        self.call = call
        self.done = threading.Lock()  # a bare lock wakes the caller faster than an Event
        self.done.acquire()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.result = self.call()
        except BaseException as error:
            self.error = error  # raised again on the caller's thread
        self.done.release()


class OwnerThread:
    """Thread that runs every call; its own calls run at once. Handing over a call costs 20 us."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._stopped = False
        self._busy = threading.Lock()  # held while a call runs
        self._gate = threading.Lock()  # no job may follow the job that ends the thread
        self._thread = threading.Thread(target=self._loop, name=name, daemon=True)
        self._thread.start()

    def _loop(self) -> None:
        while (job := self._jobs.get()) is not None:
            with self._busy:
                job.run()
            del job  # else its arguments live until the next one

    def call(self, fn: Callable[[], R]) -> R:
        """Run ``fn()`` on the thread, and return its result or raise its error; StoppedError after :meth:`stop`."""
        if threading.current_thread() is self._thread:
            return fn()
        job = _Job(fn)
        with self._gate:
            if self._stopped:
                raise StoppedError
            self._jobs.put(job)
        job.done.acquire()
        if job.error is not None:
            raise job.error
        result: R = job.result
        return result

    def here(self, fn: Callable[[], R]) -> R:
        """Run ``fn()`` on the caller's thread while no other call runs.

        Others wait for ``fn``, which must not use :meth:`call` or :meth:`here`. A signal handler of the caller must not
        use them either, as it would wait for the call that it interrupts.
        """
        if threading.current_thread() is self._thread:
            return fn()
        with self._busy:
            return fn()

    def stop(self) -> None:
        """Finish the queued calls and end the thread; from the thread itself, end it after the current call."""
        with self._gate:
            if not self._stopped:
                self._stopped = True
                self._jobs.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)
