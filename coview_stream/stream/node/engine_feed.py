"""Feed of the engines of one map: whose job is next, and what happens when an engine fails."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence

from coview_stream.stream.node.counters import last_line
from coview_stream.stream.node.engine_process import DiedError, EngineRunner, FailedError, RejectedError
from coview_stream.stream.node.jobs import Job
from coview_stream.stream.node.scheduling import RoundRobin, search_order
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.error_guard import RateLimitedErrors

log = logging.getLogger("coview_stream.node")

# all set by hand, seconds
_MAX_RESTART_PAUSE = 10.0  # before an engine that keeps dying is started again
_LIFE = 60.0  # that an engine lived after which its death is not one in a row
_STOPPED_INTERVAL = 1.0  # between two looks whether an engine is stopped; the second one ends it
_ERROR_PAUSE = 0.2  # after an unexpected error
_IDLE_WAIT = 0.05  # an engine without work is woken earlier by a job


class EngineFeed:
    """Feeds each engine by a thread of its own, which waits for it.

    Args:
        sessions: one per robot, all on the engines' map.
        engines: by name: ``track``, ``search`` and perhaps ``odometry``.
        errors: logs what goes wrong.
        on_change: called with a session whose state may have changed; with None for any.

    Attributes:
        restarts: how often each engine has been started again.
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
        self._errors = errors
        self._on_change = on_change
        self._turns = {name: RoundRobin(len(self.sessions)) for name in self.engines}
        self._deaths = dict.fromkeys(self.engines, 0)  # in a row
        self._died_at = dict.fromkeys(self.engines, float("-inf"))  # local time
        self._wake = {name: threading.Event() for name in self.engines}  # there may be a job
        self._stopping = threading.Event()
        self.threads: list[threading.Thread] = []

    # ---- life

    def start(self) -> None:
        """Start the threads."""
        targets: dict[str, tuple[Callable[..., None], tuple[str, ...]]]
        targets = {engine: (self._feed, (engine,)) for engine in self.engines}
        targets["stopped"] = (self._end_stopped_engines, ())
        for name, (target, args) in targets.items():
            thread = threading.Thread(target=target, name=f"coview-{name}", args=args, daemon=True)
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
                self._feed_one(engine)
            if caught.error is not None:
                self._stopping.wait(_ERROR_PAUSE)

    def _feed_one(self, engine: str) -> None:
        self._wake[engine].clear()  # before looking: what comes from now on sets it again
        found = self.next_job(engine)
        if found is not None:
            self.work(engine, *found)
        elif not self._wake[engine].wait(timeout=_IDLE_WAIT):
            self.watch(engine)

    def next_job(self, engine: str) -> tuple[Session, Job] | None:
        """Return whose turn it is at an engine, and the job; None if there is nothing to do."""
        turns = self._turns[engine]
        order = turns.order()
        if engine == "search":
            order = search_order([session.search_demand for session in self.sessions], time.monotonic())
        for k in order:
            session = self.sessions[k]
            if session.has_job(engine) and (job := _take_job(session, engine)) is not None:
                turns.serve(k)
                return session, job
        return None

    def work(self, engine: str, session: Session, job: Job) -> None:
        """Do one job; what goes wrong is counted and concerns this robot, unless the engine died."""
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
        """Look after an engine without a job: one that died is reported and started again before it is needed."""
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
        """Report an engine that died, at a job or at none, and let time pass: one that always dies is no hurry."""
        if self._stopping.is_set():
            return
        why = last_line(str(error))
        self._errors.report(f"the {engine} engine is started again", error, kind=why)
        self.restarts[engine] += 1
        for each in self.sessions:
            each.engine_restarted(engine, why)
        if session is not None and job is not None:
            session.handle_failure(job, str(error))
        self._on_change(None)
        now, before = time.monotonic(), self._died_at[engine]
        self._died_at[engine] = now
        self._deaths[engine] = self._deaths[engine] + 1 if now - before < _LIFE else 1
        self._stopping.wait(min(0.1 * 2.0 ** min(self._deaths[engine], 10), _MAX_RESTART_PAUSE))


def _take_job(session: Session, engine: str) -> Job | None:
    if engine == "track":
        return session.take_frame()
    if engine == "search":
        return session.take_search_request()
    return session.take_lidar_frame()
