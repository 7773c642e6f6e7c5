"""The feed of the engines: one thread per engine hands it the robots' jobs and restarts it when it dies."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Generic, Protocol, TypeVar

from coview_stream.stream.node.counters import last_line
from coview_stream.stream.node.engine_process import DiedError, EngineProcess, FailedError, RejectedError
from coview_stream.stream.node.engine_queue import EngineQueue, Job, Result, RoundRobin, search_order
from coview_stream.stream.transport.error_guard import RateLimitedErrors

# seconds
_MAX_RESTART_PAUSE = 10.0  # before an engine that keeps dying is restarted
_LIFE = 60.0  # an engine that dies after a longer life counts as dead for the first time, not once more in a row
_STOPPED_INTERVAL = 1.0  # between checks for a stopped engine; the second check kills it
_ERROR_PAUSE = 0.2  # after an unexpected error
_IDLE_WAIT = 0.05  # for an engine without work; a job wakes it earlier


class Robot(Protocol):
    """A robot with jobs for the engines. It gets the result or failure of each job before the next job of its kind."""

    queue: EngineQueue

    def has_job(self, engine: str) -> bool:
        """Whether there is a job for an engine; read without a lock, so it may be gone."""
        ...

    def take_job(self, engine: str) -> Job | None:
        """Hand out a job, if there is one."""
        ...

    def handle_result(self, job: Job, result: Result, now: float) -> None:
        """Apply the result of a job at local time ``now``."""
        ...

    def note_doubt(self, job: Job) -> None:
        """Withhold poses until the result of a job comes: its frame contradicts the place."""
        ...

    def handle_failure(self, job: Job, reason: str, rejected: bool = False) -> None:
        """Note a job without a result; unless it was ``rejected``, its engine has forgotten the robot."""
        ...

    def engine_restarted(self, engine: str = "track", why: str = "it died") -> None:
        """Note that an engine has forgotten everything."""
        ...


R = TypeVar("R", bound=Robot)


class EngineFeed(Generic[R]):
    """Feeds the engines of one map, each on its own thread, and recovers from engine failures.

    ``on_change`` is called with a robot whose state may have changed; None: any robot.
    """

    def __init__(
        self,
        robots: Sequence[R],
        engines: Mapping[str, EngineProcess],
        errors: RateLimitedErrors,
        on_change: Callable[[R | None], None],
    ) -> None:
        self.robots = list(robots)
        self.engines = dict(engines)
        self.restarts = dict.fromkeys(self.engines, 0)  # per engine
        self.threads: list[threading.Thread] = []
        self._errors = errors
        self._on_change = on_change
        self._turns = {name: RoundRobin(len(self.robots)) for name in self.engines}
        self._deaths = dict.fromkeys(self.engines, 0)  # in a row
        self._died_at = dict.fromkeys(self.engines, float("-inf"))  # local time
        self._wake = {name: threading.Event() for name in self.engines}  # there may be a job
        self._stopping = threading.Event()

    def start(self) -> None:
        """Start the threads."""
        targets = {engine: partial(self._feed, engine) for engine in self.engines}
        for name, target in (targets | {"stopped": self._end_stopped_engines}).items():
            thread = threading.Thread(target=target, name=f"coview-{name}", daemon=True)
            thread.start()
            self.threads.append(thread)  # after its start: until then it would count as ended

    def stop(self) -> None:
        """Tell the threads to end, without waiting."""
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

    def wake_for(self, robot: R) -> None:
        """Wake the engines that have a job for a robot: not all, as there may be thousands of messages."""
        for engine, wake in self._wake.items():
            if robot.has_job(engine):
                wake.set()

    def _feed(self, engine: str) -> None:
        while not self._stopping.is_set():
            with self._errors.catch(f"feeding the {engine} engine") as caught:
                self._wake[engine].clear()  # before checking: a job that comes later sets it again
                if (turn := self.next_job(engine)) is not None:
                    self.work(engine, *turn)
                elif not self._wake[engine].wait(timeout=_IDLE_WAIT):
                    self.watch(engine)
            if caught.error is not None:
                self._stopping.wait(_ERROR_PAUSE)

    def next_job(self, engine: str) -> tuple[R, Job] | None:
        """Return the robot whose turn it is at an engine, and its job; None if there is nothing to do."""
        turns = self._turns[engine]
        order = turns.order()
        if engine == "search":
            order = search_order([robot.queue.search_demand for robot in self.robots], time.monotonic())
        for k in order:
            robot = self.robots[k]
            if robot.has_job(engine) and (job := robot.take_job(engine)) is not None:
                turns.serve(k)
                return robot, job
        return None

    def work(self, engine: str, robot: R, job: Job) -> None:
        """Do one job; an error is counted and affects this robot only, unless the engine died."""
        runner = self.engines[engine]
        runner.on_doubt = partial(robot.note_doubt, job)
        try:
            result = runner.run(job)
        except RejectedError as error:
            robot.handle_failure(job, str(error), rejected=True)
        except FailedError as error:
            self._errors.report(f"{job.robot}: the {engine} engine", error)
            robot.handle_failure(job, str(error))
        except DiedError as error:
            self._engine_died(engine, error, robot, job)
        except Exception as error:  # unforeseen, but the other robots' work goes on
            self._errors.report(f"{job.robot}: unexpected, at the {engine} engine", error)
            robot.handle_failure(job, repr(error))
            self._stopping.wait(_ERROR_PAUSE)
        else:
            self._deaths[engine] = 0
            robot.handle_result(job, result, time.monotonic())
            self._on_change(robot)
            self.wake_for(robot)  # a frame may have requested a search
        finally:
            runner.on_doubt = lambda: None  # otherwise it keeps the job's cloud alive

    def watch(self, engine: str) -> None:
        """Check an idle engine: a dead one is reported, and restarted before it is needed."""
        try:
            self.engines[engine].watch()
        except DiedError as error:
            self._engine_died(engine, error)

    def _end_stopped_engines(self) -> None:
        while not self._stopping.wait(_STOPPED_INTERVAL):
            for engine in self.engines.values():
                with self._errors.catch("looking after an engine"):
                    engine.end_stopped()

    def _engine_died(self, engine: str, error: DiedError, robot: R | None = None, job: Job | None = None) -> None:
        """Report a dead engine, and wait before its restart."""
        if self._stopping.is_set():
            return
        why = last_line(str(error))
        self._errors.report(f"the {engine} engine is started again", error, kind=why)
        self.restarts[engine] += 1
        for affected in self.robots:
            affected.engine_restarted(engine, why)
        if robot is not None and job is not None:
            robot.handle_failure(job, str(error))
        self._on_change(None)
        now, before = time.monotonic(), self._died_at[engine]
        self._died_at[engine] = now
        self._deaths[engine] = self._deaths[engine] + 1 if now - before < _LIFE else 1
        self._stopping.wait(min(0.1 * 2.0 ** min(self._deaths[engine], 10), _MAX_RESTART_PAUSE))
