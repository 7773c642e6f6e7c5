"""The node: threads and clocks between the sessions of the robots and the engines, and the change of its map.

The transport's threads decode and queue; one thread feeds each engine and waits for it; the pose clock and the status
clock wait for neither.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from coview_stream.config.node import NodeConfig
from coview_stream.errors import CoViewError
from coview_stream.localization.state import State
from coview_stream.stream.node.counters import Rate, last_line
from coview_stream.stream.node.engine_process import CancelledError, DiedError, EngineRunner, FailedError, RejectedError
from coview_stream.stream.node.engine_queue import Job, RoundRobin, search_order
from coview_stream.stream.node.robot_endpoints import GeoOutput, MapViewAnswer, RobotEndpoints
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import NodeIdentity
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

_MAX_POSE_TICKS = 200.0  # of the pose clock, per second
_CLOSE_TIMEOUT = 1.5  # seconds for everything to end; ``serve`` promises two
_JOIN_TIMEOUT = 0.3  # of these, for the threads to finish their work
_MAX_HANDOVER = 60.0  # seconds that a robot keeps the old map while the new one has not verified its place
_STEP = 0.02  # seconds between two looks at a change of the map
# of the engines, seconds
_MAX_RESTART_PAUSE = 10.0  # before an engine that keeps dying is started again
_LIFE = 60.0  # of an engine, after which its death is not one in a row
_STOPPED_INTERVAL = 1.0  # between two checks for a stopped engine; the second one kills it
_ERROR_PAUSE = 0.2  # after an unexpected error
_IDLE_WAIT = 0.05  # of an engine without work; a job wakes it earlier

Service = Callable[[threading.Event], None]
"""Work on a thread of its own, until the event is set."""


class OpenedMap(NamedTuple):
    """A map with engines that are ready for jobs."""

    sha256: str  # of the map
    # by name: ``track``, ``search`` and, for robots that send no odometry, ``odometry``
    engines: Mapping[str, EngineRunner]
    sessions: Sequence[Session]  # one per robot, in the node's order, without any message
    file: Path | None = None  # that it was opened from; None where nobody reads it


OpenMap = Callable[[str, Callable[[], bool]], OpenedMap | None]
"""Opens the map's file again, unless its hash is the one given; the function returns True to give up."""


class EngineFeed:
    """Feeds the engines of one map, each by a thread of its own, and recovers from an engine's failure.

    ``on_change`` is called with a session whose state may have changed, with None for any.
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
        self.restarts = dict.fromkeys(self.engines, 0)  # of each engine
        self.threads: list[threading.Thread] = []
        self._errors = errors
        self._on_change = on_change
        self._turns = {name: RoundRobin(len(self.sessions)) for name in self.engines}
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


class Node:
    """Serves several robots on one map.

    Args:
        opened: the map.
        transport: where messages come from and go to; the node closes it.
        config: rates and limits.
        pose_format: codec of the poses; None leaves it to each robot's keys.
        geo: publishes poses as places on Earth as well; None: does not.
        shared: a fleet says which robots this node serves; else it serves them all.
        open_map: opens the map again, at a reload; None if there is no way to.
        on_reload: called with True when a change of the map begins, with False when it is over.
        map_files: file of the map by its hash; the node adds those of later maps.
    """

    def __init__(
        self,
        opened: OpenedMap,
        transport: Transport,
        config: NodeConfig | None = None,
        *,
        pose_format: str | None = None,
        geo: GeoOutput | None = None,
        shared: bool = False,
        open_map: OpenMap | None = None,
        on_reload: Callable[[bool], None] = lambda busy: None,
        map_files: dict[str, Path] | None = None,
    ) -> None:
        self.sessions = list(opened.sessions)  # those in force
        self.transport = transport
        self.config = config or NodeConfig()
        self.identity = NodeIdentity(period=round(1.0 / self.config.status_rate, 3))
        self.map_files: dict[str, Path] = {} if map_files is None else map_files
        self._shared = shared
        self._errors = RateLimitedErrors(log)
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._ending: threading.Thread | None = None
        self.reporter = Reporter(self.sessions, transport, self._errors, self.identity)
        self.feeds: tuple[EngineFeed, ...] = (self._make_feed(opened),)  # of the map, and of one that is to follow it
        self.endpoints = {
            session.keys.robot: RobotEndpoints(session, transport, self.reporter, self._wake, pose_format, geo)
            for session in self.sessions
        }
        self._robots = list(self.endpoints.values())
        self.reloader = None if open_map is None else MapReloader(self, open_map, on_reload)
        self.started = self.beat = time.monotonic()  # local time of the start, and of the pose clock's newest tick

    def start(self, services: Mapping[str, Service] | None = None) -> None:
        """Declare everything and start the threads, those of ``services`` by name as well."""
        self.declare()
        for feed in self.feeds:
            feed.start()
        status = partial(self.reporter.run, self.config.status_rate)
        running: dict[str, Service] = {"poses": self._run_pose_clock, "status": status, **(services or {})}
        if self.reloader is not None:
            running["reload"] = self.reloader.run
        for name, run in running.items():
            thread = threading.Thread(target=run, name=f"coview-{name}", args=(self._stopping,), daemon=True)
            thread.start()
            self._threads.append(thread)  # now, for one that has not started counts as one that has ended

    def declare(self) -> None:
        """Declare publishers, subscriptions, queryables and liveliness tokens of all robots."""
        node_id = uuid.uuid4().hex
        map_view = MapViewAnswer(self.map_files, lambda: self.map_sha256) if self.map_files else None
        for number, robot in enumerate(self._robots, 1):
            robot.declare(node_id, number)
            if map_view is not None:
                self.transport.answer(robot.session.keys.map_view, map_view)
            if not self._shared:
                robot.begin_serving()
            self.transport.announce(robot.session.keys.alive)

    def close(self, timeout: float = _CLOSE_TIMEOUT) -> bool:
        """Publish a last status, undeclare, end the engines; later calls only wait.

        Returns:
            Whether all is done; False after ``timeout`` seconds if the network holds up the thread that does it.
        """
        if not self._stopping.is_set():
            self._stopping.set()
            self.reporter.changed.set()
            for feed in self.feeds:
                feed.stop()
            self._ending = threading.Thread(target=self._end, name="coview-end", daemon=True)
            self._ending.start()
        if self._ending is not None:
            self._ending.join(max(0.0, timeout))
        return self._ending is None or not self._ending.is_alive()

    def _end(self) -> None:
        for feed in self.feeds:
            feed.close(0.5 * _JOIN_TIMEOUT)
        last = time.monotonic() + _JOIN_TIMEOUT
        for thread in self._threads:
            thread.join(timeout=max(0.0, last - time.monotonic()))
        self.reporter.publish_last(time.monotonic())
        self.transport.close()

    @property
    def ended_threads(self) -> list[str]:
        """Names of its threads that have ended, though it has not."""
        threads = [*self._threads, *(thread for feed in self.feeds for thread in feed.threads)]
        return [t.name for t in threads if not (t.is_alive() or self._stopping.is_set())]

    def _make_feed(self, opened: OpenedMap) -> EngineFeed:
        def note_change(session: Session | None) -> None:
            if session is None:
                self.reporter.changed.set()
            elif session in self.sessions:  # else it is of a map that is not in force yet
                self.reporter.report_change(session)

        return EngineFeed(opened.sessions, opened.engines, self._errors, note_change)

    def _wake(self, session: Session) -> None:
        for feed in self.feeds:
            feed.wake_for(session)

    def _run_pose_clock(self, stopping: threading.Event) -> None:
        # robots are served one after the other over the period: poses of many at once are more than the queues of
        # zenoh and of a router hold for urgent messages, and those that came last would be dropped
        rate = self.config.pose_rate
        groups = max(1, min(len(self._robots), int(_MAX_POSE_TICKS / rate)))
        clock = Rate(rate * groups, time.monotonic(), slack=0.5 / rate)
        group = 0
        while not stopping.wait(clock.remaining(time.monotonic())):
            self.beat = now = time.monotonic()
            if clock.take_tick(now):
                self.publish_poses(now, self._robots[group::groups])
                group = (group + 1) % groups

    def publish_poses(self, now: float, robots: Sequence[RobotEndpoints] | None = None) -> None:
        """Let time pass in every session, or in some, and publish the poses that are known."""
        for robot in self._robots if robots is None else robots:
            with self._errors.catch(robot.session.keys.robot):
                robot.publish_pose(now)

    # ---- another map

    @property
    def map_sha256(self) -> str:
        """Hash of the map that is served; during a change of the map, of the one before."""
        return self.feeds[0].sessions[0].map_sha256

    def reload(self) -> dict[str, Any]:
        """Ask for the map's file to be opened again; ``ok`` is False where this node cannot."""
        if self.reloader is None:
            return {"ok": False, "error": "this node was not made with a way to open a map"}
        return self.reloader.request()

    def add_map(self, opened: OpenedMap) -> None:
        """Hand the robots' messages to the sessions and engines of another map as well, which publish nothing."""
        for feed in self.feeds[1:]:  # of a change that failed half way
            feed.close(_JOIN_TIMEOUT)
        added = self._make_feed(opened)
        self.feeds = (self.feeds[0], added)
        for robot, session in zip(self._robots, opened.sessions, strict=True):
            robot.add_session(session)
        added.start()

    def switch_robot(self, number: int) -> None:
        """Publish from now on the poses of the ``number``-th robot on the other map."""
        robot = self._robots[number]
        robot.switch_session()
        self.sessions[number] = robot.session
        self.reporter.changed.set()

    def drop_map(self) -> None:
        """End the engines of the first map, when all robots are on the other one."""
        old, self.feeds = self.feeds[0], self.feeds[1:]
        old.close(_JOIN_TIMEOUT)


class MapReloader:
    """Changes the map of a running node when asked to, one change at a time, on a thread of its own.

    Each robot keeps the old map, and its poses, until the new one has verified its place: both get all messages
    meanwhile, and the place on the old map is a hypothesis on the new one. A robot without a place changes at once, one
    that is not found on the new map after a minute changes without a place, and is searched for.

    Attributes:
        last: outcome of the newest change: ``result`` (``none``, ``loading``, ``handing over``, ``changed``,
            ``unchanged``, ``refused`` or ``failed``), ``map_sha256`` and ``error``.
    """

    def __init__(self, node: Node, open_map: OpenMap, on_change: Callable[[bool], None] = lambda busy: None) -> None:
        self._node = node
        self._open_map = open_map
        self._on_change = on_change
        self._asked = threading.Event()
        self._busy = False
        self.max_handover = _MAX_HANDOVER
        self.last: dict[str, Any] = {"result": "none", "map_sha256": node.map_sha256, "error": None}

    @property
    def outcome(self) -> str:
        """Result of the newest change that was asked for: as of :attr:`last`, ``loading`` until it is over."""
        return "loading" if self._busy or self._asked.is_set() else str(self.last["result"])

    def request(self) -> dict[str, Any]:
        """Ask for a change; return the newest outcome. Asked for during a change, another one follows."""
        self._asked.set()
        return {"ok": True, "busy": self._busy, "last": dict(self.last)}

    def run(self, stopping: threading.Event) -> None:
        """Change the map whenever that is asked for, until ``stopping`` is set."""
        while not stopping.is_set():
            if not self._asked.wait(0.1):
                continue
            self._busy = True
            self._asked.clear()
            self._on_change(True)
            try:
                self._change(stopping)
            except Exception as error:  # the next one is to be answered all the same
                self._note("failed", repr(error))
                log.exception("the change of the map failed")
            finally:
                self._busy = False
                self._on_change(False)

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"result": result, "map_sha256": self._node.map_sha256, "error": error}

    def _change(self, stopping: threading.Event) -> None:
        self._note("loading")
        log.info("loading the map again")
        try:
            opened = self._open_map(self._node.map_sha256, stopping.is_set)
        except CancelledError:
            return
        except Exception as error:
            foreseen = isinstance(error, (CoViewError, DiedError, OSError, MemoryError))
            why = (foreseen and " ".join(str(error).split())) or repr(error)
            self._note("refused", why)
            log.error("the new map is refused, going on with the one before: %s", why, exc_info=not foreseen)
            return
        if opened is None:
            self._note("unchanged")
            log.info("the map has not changed")
            return
        self._note("handing over")
        begin = time.monotonic()
        try:
            files = self._node.map_files
            for sha256 in files.keys() - {self._node.map_sha256}:
                files.pop(sha256)
            if opened.file is not None:
                files[opened.sha256] = opened.file
            for old, new in zip(self._node.sessions, opened.sessions, strict=True):
                new.begin_beside(old)
            self._node.add_map(opened)
        except BaseException:
            for engine in opened.engines.values():
                engine.close()
            raise
        waiting = dict(enumerate(opened.sessions))
        while waiting and not stopping.wait(_STEP):
            for number, new in list(waiting.items()):
                verified = new.state()[0] is State.TRACKING
                has_place = self._node.sessions[number].state()[0].has_place
                if verified or not has_place or time.monotonic() - begin > self.max_handover:
                    self._node.switch_robot(number)
                    del waiting[number]
        if waiting:
            return  # the node ends, and all engines with it
        self._node.drop_map()
        self._note("changed")
        log.info("map %s is in force after %.1f s", opened.sha256[:16], time.monotonic() - begin)
