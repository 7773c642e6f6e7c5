"""The node: threads and clocks between the sessions of the robots and the engines.

Who waits for whom: the transport's threads decode and queue; one thread feeds each engine and waits for it; the pose
clock and the status clock wait for neither.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence

from coview_stream.config.node import NodeConfig
from coview_stream.stream.node.counters import last_line
from coview_stream.stream.node.engine_process import DiedError, EngineRunner, FailedError, RejectedError
from coview_stream.stream.node.jobs import Job
from coview_stream.stream.node.robot_endpoints import RobotEndpoints
from coview_stream.stream.node.scheduling import Rate, RoundRobin, search_order
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

_MAX_POSE_TICKS = 200.0  # of the pose clock, per second; set by hand, as are those below
_MAX_RESTART_PAUSE = 10.0  # seconds before an engine that keeps dying is started again
_LIFE = 60.0  # seconds that an engine lived after which its death is not one in a row
_STOPPED_INTERVAL = 1.0  # seconds between two looks whether an engine is stopped; the second one ends it
_ERROR_PAUSE = 0.2  # seconds after an unexpected error
_IDLE_WAIT = 0.05  # seconds; an engine without work is woken earlier by a job
_CLOSE_TIMEOUT = 1.5  # seconds for everything to end; ``serve`` promises two
_JOIN_TIMEOUT = 0.3  # of these, for the threads to finish what they are at


class Node:
    """Serves several robots on one map.

    Args:
        sessions: one per robot.
        transport: where messages come from and go to; the node closes it.
        track: runs the jobs of the tracking engine.
        search: runs those of the search engine.
        config: rates and limits.
        pose_format: codec of the poses; None leaves it to each robot's keys.
        odometry: runs the jobs of the odometry engine, for robots that send none; None if there are none.
        background: what else has a thread of its own, by name; each runs until the event that it is given is set.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        transport: Transport,
        track: EngineRunner,
        search: EngineRunner,
        config: NodeConfig | None = None,
        pose_format: str | None = None,
        odometry: EngineRunner | None = None,
        background: Mapping[str, Callable[[threading.Event], None]] | None = None,
    ) -> None:
        self.sessions = list(sessions)
        self.transport = transport
        self.config = config or NodeConfig()
        self._engines = {"track": track, "search": search} | ({"odometry": odometry} if odometry else {})
        self._turns = {name: RoundRobin(len(self.sessions)) for name in self._engines}
        self._deaths = dict.fromkeys(self._engines, 0)  # in a row
        self._died_at = dict.fromkeys(self._engines, float("-inf"))  # local time
        self._wake = {name: threading.Event() for name in self._engines}  # there may be a job
        self._errors = RateLimitedErrors(log)
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._background = dict(background or {})
        self._reporter = Reporter(self.sessions, transport, self._errors)
        self._robots = [
            RobotEndpoints(session, transport, self._reporter, self._wake_engines_for, pose_format)
            for session in self.sessions
        ]
        self._ending: threading.Thread | None = None

    # ---- life

    def start(self) -> None:
        """Declare everything and start the threads."""
        self.declare()
        for engine in self._engines:
            self._start_thread(engine, self._feed, engine)
        self._start_thread("stopped", self._end_stopped_engines)
        self._start_thread("poses", self._run_pose_clock)
        self._start_thread("status", self._reporter.run, self.config.status_rate, self._stopping)
        for name, run in self._background.items():
            self._start_thread(name, run, self._stopping)

    def _start_thread(self, name: str, target: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=target, name=f"coview-{name}", args=args, daemon=True)
        self._threads.append(thread)
        thread.start()

    def declare(self) -> None:
        """Declare publishers, subscriptions, queryables and liveliness tokens of all robots."""
        node_id = uuid.uuid4().hex
        for number, robot in enumerate(self._robots, 1):
            robot.declare(node_id, number)

    def close(self, timeout: float = _CLOSE_TIMEOUT) -> bool:
        """Publish a last status, undeclare, end the engines; later calls only wait.

        Returns:
            Whether all is done; False after ``timeout`` seconds if the network holds up the thread that does it.
        """
        if not self._stopping.is_set():
            self._stopping.set()
            self._reporter.changed.set()
            for wake in self._wake.values():
                wake.set()
            self._ending = threading.Thread(target=self._end, name="coview-end", daemon=True)
            self._ending.start()
        if self._ending is not None:
            self._ending.join(max(0.0, timeout))
        return self._ending is None or not self._ending.is_alive()

    def _end(self) -> None:
        for engine in self._engines.values():
            with self._errors.catch("ending an engine"):
                engine.close()
        last = time.monotonic() + _JOIN_TIMEOUT
        for thread in self._threads:
            thread.join(timeout=max(0.0, last - time.monotonic()))
        self._reporter.publish_last(time.monotonic())
        self.transport.close()

    # ---- the engines, each fed by a thread of its own

    def _wake_engines_for(self, session: Session) -> None:
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

    def watch(self, engine: str) -> None:
        """Look after an engine without a job: one that died is reported and started again before it is needed."""
        try:
            self._engines[engine].watch()
        except DiedError as error:
            self._engine_died(engine, error)

    def _end_stopped_engines(self) -> None:
        while not self._stopping.wait(_STOPPED_INTERVAL):
            for engine in self._engines.values():
                with self._errors.catch("looking after an engine"):
                    engine.end_stopped()

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
            result = self._engines[engine].run(job)
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
            self._reporter.report_change(session)
            self._wake_engines_for(session)  # a frame may have asked for a search

    def _engine_died(
        self, engine: str, error: DiedError, session: Session | None = None, job: Job | None = None
    ) -> None:
        """Report an engine that died, at a job or at none, and let time pass: one that always dies is no hurry."""
        if self._stopping.is_set():
            return
        why = last_line(str(error))
        self._errors.report(f"the {engine} engine is started again", error, kind=why)
        for each in self.sessions:
            each.engine_restarted(engine, why)
        if session is not None and job is not None:
            session.handle_failure(job, str(error))
        self._reporter.changed.set()
        now, before = time.monotonic(), self._died_at[engine]
        self._died_at[engine] = now
        self._deaths[engine] = self._deaths[engine] + 1 if now - before < _LIFE else 1
        self._stopping.wait(min(0.1 * 2.0 ** self._deaths[engine], _MAX_RESTART_PAUSE))

    # ---- the pose clock

    def _run_pose_clock(self) -> None:
        # robots are served one after the other over the period: poses of many at once are more than the queues of
        # zenoh and of a router hold for urgent messages, and those that came last would be dropped
        rate = self.config.pose_rate
        groups = max(1, min(len(self._robots), int(_MAX_POSE_TICKS / rate)))
        clock = Rate(rate * groups, time.monotonic(), slack=0.5 / rate)
        group = 0
        while not self._stopping.wait(clock.remaining(time.monotonic())):
            now = time.monotonic()
            if clock.take_tick(now):
                self.publish_poses(now, self._robots[group::groups])
                group = (group + 1) % groups

    def publish_poses(self, now: float, robots: Sequence[RobotEndpoints] | None = None) -> None:
        """Let time pass in every session, or in some, and publish the poses that are known."""
        for robot in self._robots if robots is None else robots:
            with self._errors.catch(robot.session.keys.robot):
                robot.publish_pose(now)


def _take_job(session: Session, engine: str) -> Job | None:
    if engine == "track":
        return session.take_frame()
    if engine == "search":
        return session.take_search_request()
    return session.take_lidar_frame()
