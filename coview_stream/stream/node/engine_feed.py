"""Feed of the engines of one map: whose job is next, and recovery from an engine's failure."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from coview_stream.stream.node.counters import last_line
from coview_stream.stream.node.engine_process import DiedError, EngineRunner, FailedError, RejectedError
from coview_stream.stream.node.engine_queue import Job, RoundRobin, search_order
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.error_guard import RateLimitedErrors

log = logging.getLogger("coview_stream.node")

# seconds
_MAX_RESTART_PAUSE = 10.0  # before an engine that keeps dying is started again
_LIFE = 60.0  # of an engine, after which its death is not one in a row
_STOPPED_INTERVAL = 1.0  # between two checks for a stopped engine; the second one kills it
_ERROR_PAUSE = 0.2  # after an unexpected error
_IDLE_WAIT = 0.05  # of an engine without work; a job wakes it earlier


class EngineFeed:
    """Feeds each engine by a thread of its own, which waits for it.

    Args:
        sessions: one per robot, all on the engines' map.
        engines: by name: ``track``, ``search`` and perhaps ``odometry``.
        errors: logs errors.
        on_change: called with a session whose state may have changed; with None for any.

    Attributes:
        restarts: number of restarts of each engine.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        engines: Mapping[str, EngineRunner],
        errors: RateLimitedErrors,
        on_change: Callable[[Session | None], None],
    ) -> None:
        self.sessions = list(sessions)
        self.engines = dict(engines)
        self.restarts = dict.fromkeys(self.engines, 0)
        self.threads: list[threading.Thread] = []
        self._errors = errors
        self._on_change = on_change
        self._turns = {name: RoundRobin(len(self.sessions)) for name in self.engines}
        self._deaths = dict.fromkeys(self.engines, 0)  # in a row
        self._died_at = dict.fromkeys(self.engines, float("-inf"))  # local time
        self._wake = {name: threading.Event() for name in self.engines}  # there may be a job
        self._stopping = threading.Event()

    # ---- life

    def start(self) -> None:
        """Start the threads."""
        for engine in self.engines:
            self._start_thread(engine, partial(self._feed, engine))
        self._start_thread("stopped", self._end_stopped_engines)

    def _start_thread(self, name: str, target: Callable[[], None]) -> None:
        thread = threading.Thread(target=target, name=f"coview-{name}", daemon=True)
        thread.start()
        self.threads.append(thread)  # now, for one that has not started counts as one that has ended

    def stop(self) -> None:
        """Have the threads end; without waiting."""
        self._stopping.set()
        for wake in self._wake.values():
            wake.set()

    def close(self, timeout: float) -> None:
        """End the engines, and the threads within ``timeout`` seconds."""
        self.stop()
        for engine in self.engines.values():
            with self._errors.catch("ending an engine"):
                engine.close()
        last = time.monotonic() + timeout
        for thread in self.threads:
            thread.join(timeout=max(0.0, last - time.monotonic()))

    # ---- jobs

    def wake_for(self, session: Session) -> None:
        """Wake the engines that have a job of a robot: not all at every message, of which there may be thousands."""
        for engine, wake in self._wake.items():
            if session.has_job(engine):
                wake.set()

    def _feed(self, engine: str) -> None:
        while not self._stopping.is_set():
            with self._errors.catch(f"feeding the {engine} engine") as caught:
                self._wake[engine].clear()  # before looking: a job that comes from now on sets it again
                if (turn := self.next_job(engine)) is not None:
                    self.work(engine, *turn)
                elif not self._wake[engine].wait(timeout=_IDLE_WAIT):
                    self.watch(engine)
            if caught.error is not None:
                self._stopping.wait(_ERROR_PAUSE)

    def next_job(self, engine: str) -> tuple[Session, Job] | None:
        """Return whose turn it is at an engine, and the job; None if there is nothing to do."""
        turns = self._turns[engine]
        order = turns.order()
        if engine == "search":
            order = search_order([session.queue.search_demand for session in self.sessions], time.monotonic())
        for k in order:
            session = self.sessions[k]
            if session.has_job(engine) and (job := session.take_job(engine)) is not None:
                turns.serve(k)
                return session, job
        return None

    def work(self, engine: str, session: Session, job: Job) -> None:
        """Do one job; an error is counted and concerns this robot, unless the engine died."""
        try:
            result = self.engines[engine].run(job)
        except RejectedError as error:
            session.handle_failure(job, str(error), rejected=True)
        except FailedError as error:
            self._errors.report(f"{job.robot}: the {engine} engine", error)
            session.handle_failure(job, str(error))
        except DiedError as error:
            self._engine_died(engine, error, session, job)
        except Exception as error:  # not foreseen, but the other robots' work goes on
            self._errors.report(f"{job.robot}: unexpected, at the {engine} engine", error)
            session.handle_failure(job, repr(error))
            self._stopping.wait(_ERROR_PAUSE)
        else:
            self._deaths[engine] = 0
            session.handle_result(job, result, time.monotonic())
            self._on_change(session)
            self.wake_for(session)  # a frame may have asked for a search

    # ---- engines that fail

    def watch(self, engine: str) -> None:
        """Check an engine without a job: a dead one is reported, and started again before it is needed."""
        try:
            self.engines[engine].watch()
        except DiedError as error:
            self._engine_died(engine, error)

    def _end_stopped_engines(self) -> None:
        while not self._stopping.wait(_STOPPED_INTERVAL):
            for engine in self.engines.values():
                with self._errors.catch("looking after an engine"):
                    engine.end_stopped()

    def _engine_died(
        self, engine: str, error: DiedError, session: Session | None = None, job: Job | None = None
    ) -> None:
        """Report a dead engine and back off before restarting it."""
        if self._stopping.is_set():
            return
        why = last_line(str(error))
        self._errors.report(f"the {engine} engine is started again", error, kind=why)
        self.restarts[engine] += 1
        for robot in self.sessions:
            robot.engine_restarted(engine, why)
        if session is not None and job is not None:
            session.handle_failure(job, str(error))
        self._on_change(None)
        now, before = time.monotonic(), self._died_at[engine]
        self._died_at[engine] = now
        self._deaths[engine] = self._deaths[engine] + 1 if now - before < _LIFE else 1
        self._stopping.wait(min(0.1 * 2.0 ** min(self._deaths[engine], 10), _MAX_RESTART_PAUSE))
