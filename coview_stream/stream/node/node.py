"""The node: threads and clocks between the robots' sessions and the engines, and changes of its map.

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
from coview_stream.errors import CoViewError, printable
from coview_stream.localization.state import State
from coview_stream.stream.node.counters import Rate
from coview_stream.stream.node.engine_feed import EngineFeed
from coview_stream.stream.node.engine_process import CancelledError, DiedError, EngineProcess
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
_MAX_HANDOVER = 60.0  # seconds that a robot keeps the old map until the new one has verified its place
_AGAIN = 0.5  # seconds from a service's exception to its restart
_MAX_FAULT = 200  # characters
_STEP = 0.02  # seconds between checks of a map change
_RELOADS_APART = 1.0  # seconds between the starts of two map changes, however often requested
_LINES_APART = 60.0  # seconds between equal log lines about changes

Service = Callable[[threading.Event], None]
"""Work on its own thread until the event is set."""


class OpenedMap(NamedTuple):
    """A map with engines that are ready for jobs."""

    sha256: str  # of the map
    # by name: ``track``, ``search`` and ``odometry``, which serves robots that send none
    engines: Mapping[str, EngineProcess]
    sessions: Sequence[Session]  # one per robot, in the node's order, new
    file: Path | None = None  # file it was opened from; None where it is not needed


OpenMap = Callable[[str, Callable[[], bool]], OpenedMap | None]
"""Opens the map file again; None if its hash is still the given one. The function is polled: True gives up."""


class Node:
    """Serves several robots on one map.

    Args:
        transport: source and destination of messages; the node closes it.
        pose_format: codec of the poses; None: each robot's keys decide.
        geo: also publishes poses as places on Earth; None: does not.
        shared: a fleet decides which robots this node serves; else it serves all.
        open_map: opens the map again, for a reload; None: the map cannot change.
        on_reload: called with True when a change of the map begins, with False when it is over.
        map_files: map file by hash; the node adds those of later maps.
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
        self.faults: dict[str, str] = {}  # newest exception of each service that was restarted after one
        self._ending: threading.Thread | None = None
        self.reporter = Reporter(self.sessions, transport, self._errors, self.identity)
        # for the map, and for one that will replace it
        self.feeds: tuple[EngineFeed[Session], ...] = (self._make_feed(opened),)
        self.endpoints = {
            session.keys.robot: RobotEndpoints(session, transport, self.reporter, self._wake, pose_format, geo)
            for session in self.sessions
        }
        self._robots = list(self.endpoints.values())
        self.reloader = None if open_map is None else MapReloader(self, open_map, on_reload)
        self.started = self.beat = time.monotonic()  # local times of the start and of the pose clock's newest tick

    def start(self, services: Mapping[str, Service] | None = None) -> None:
        """Declare everything and start the threads, including those of ``services``, by name."""
        self.declare()
        for feed in self.feeds:
            feed.start()
        status = partial(self.reporter.run, self.config.status_rate)
        running: dict[str, Service] = {"poses": self._run_pose_clock, "status": status, **(services or {})}
        if self.reloader is not None:
            running["reload"] = self.reloader.run
        for name, run in running.items():
            thread = threading.Thread(target=self._keep_running, name=f"coview-{name}", args=(name, run), daemon=True)
            thread.start()
            self._threads.append(thread)  # after its start: until then it would count as ended

    def _keep_running(self, name: str, run: Service) -> None:
        """Run a service, and restart it after any exception: it is logged and shown in :attr:`faults`."""
        while not self._stopping.is_set():
            with self._errors.catch(name) as caught:
                run(self._stopping)
            if caught.error is None:
                return
            self.faults[name] = printable(repr(caught.error))[:_MAX_FAULT]
            self._stopping.wait(_AGAIN)

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
        """Publish a last status, undeclare, end the engines; later calls only wait. False if not done in time."""
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
        """Names of the threads that have ended while the node has not."""
        threads = [*self._threads, *(thread for feed in self.feeds for thread in feed.threads)]
        return [t.name for t in threads if not (t.is_alive() or self._stopping.is_set())]

    def _make_feed(self, opened: OpenedMap) -> EngineFeed[Session]:
        def note_change(session: Session | None) -> None:
            if session is None:
                self.reporter.changed.set()
            elif session in self.sessions:  # else it is on a map not yet in force
                self.reporter.report_change(session)

        return EngineFeed(opened.sessions, opened.engines, self._errors, note_change)

    def _wake(self, session: Session) -> None:
        for feed in self.feeds:
            feed.wake_for(session)

    def _run_pose_clock(self, stopping: threading.Event) -> None:
        # robots take turns over the period: the poses of many at once exceed the queues of zenoh and routers for urgent
        # messages, and the last of them would be dropped
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
        """Advance time in every session, or in some, and publish the poses that are known."""
        for robot in self._robots if robots is None else robots:
            with self._errors.catch(robot.session.keys.robot):
                robot.publish_pose(now)

    # ---- another map

    @property
    def map_sha256(self) -> str:
        """Hash of the served map; during a change of the map, of the old one."""
        return self.feeds[0].robots[0].map_sha256

    def reload(self) -> dict[str, Any]:
        """Request a reload of the map file; ``ok`` is False if this node cannot."""
        if self.reloader is None:
            return {"ok": False, "error": "this node was not made with a way to open a map"}
        return self.reloader.request()

    def add_map(self, opened: OpenedMap) -> None:
        """Hand the robots' messages also to the sessions and engines of another map, which publish nothing."""
        for feed in self.feeds[1:]:  # left by a change that failed half-way
            feed.close(_JOIN_TIMEOUT)
        added = self._make_feed(opened)
        self.feeds = (self.feeds[0], added)
        for robot, session in zip(self._robots, opened.sessions, strict=True):
            robot.add_session(session)
        added.start()

    def switch_robot(self, number: int) -> None:
        """From now on publish the ``number``-th robot's poses on the other map."""
        robot = self._robots[number]
        robot.switch_session()
        self.sessions[number] = robot.session
        self.reporter.changed.set()

    def drop_map(self) -> None:
        """End the engines of the first map, once all robots are on the other."""
        old, self.feeds = self.feeds[0], self.feeds[1:]
        old.close(_JOIN_TIMEOUT)


class MapReloader:
    """Changes the map of a running node on request, one change at a time, on its own thread.

    Each robot keeps the old map and its poses until the new map has verified its place: meanwhile its sessions on both
    get all messages, and the place on the old map is a hypothesis on the new one. A robot without a place changes at
    once. A robot that is not found on the new map within a minute changes without a place, and is searched for.

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
        self._said: dict[int, tuple[str, float]] = {}  # by level: the newest line and its local time
        self.max_handover = _MAX_HANDOVER
        self.last: dict[str, Any] = {"result": "none", "map_sha256": node.map_sha256, "error": None}

    @property
    def outcome(self) -> str:
        """Result of the newest requested change, as in :attr:`last`; ``loading`` until it is over."""
        return "loading" if self._busy or self._asked.is_set() else str(self.last["result"])

    def request(self) -> dict[str, Any]:
        """Request a change; return the newest outcome. A request during a change makes another one follow."""
        self._asked.set()
        return {"ok": True, "busy": self._busy, "last": dict(self.last)}

    def run(self, stopping: threading.Event) -> None:
        """Change the map on each request, until ``stopping`` is set."""
        while not stopping.is_set():
            if not self._asked.wait(0.1):
                continue
            self._busy = True
            self._asked.clear()
            next_at = time.monotonic() + _RELOADS_APART
            self._on_change(True)
            try:
                self._change(stopping)
            except Exception as error:  # later requests must still be answered
                self._note("failed", repr(error))
                log.exception("the change of the map failed")
            finally:
                self._busy = False
                self._on_change(False)
            stopping.wait(max(0.0, next_at - time.monotonic()))

    def _say(self, level: int, text: str, traceback: bool = False) -> None:
        before, at = self._said.get(level, ("", 0.0))
        now = time.monotonic()
        if text != before or now - at >= _LINES_APART:
            self._said[level] = text, now
            log.log(level, "%s", text, exc_info=traceback)

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"result": result, "map_sha256": self._node.map_sha256, "error": error}

    def _change(self, stopping: threading.Event) -> None:
        self._note("loading")
        log.debug("loading the map again")
        try:
            opened = self._open_map(self._node.map_sha256, stopping.is_set)
        except CancelledError:
            return
        except Exception as error:
            foreseen = isinstance(error, (CoViewError, DiedError, OSError, MemoryError))
            why = (foreseen and " ".join(str(error).split())) or repr(error)
            self._note("refused", why)
            self._say(logging.ERROR, f"the new map is refused, going on with the one before: {why}", not foreseen)
            return
        if opened is None:
            self._note("unchanged")
            self._say(logging.INFO, "the map was asked to be loaded again, and has not changed")
            return
        log.info("changing to map %s", opened.sha256[:16])
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
            return  # the node ends, with all engines
        self._node.drop_map()
        self._note("changed")
        log.info("map %s is in force after %.1f s", opened.sha256[:16], time.monotonic() - begin)
