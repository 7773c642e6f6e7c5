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
from pathlib import Path
from typing import Any, Protocol

from coview_stream.config.node import NodeConfig
from coview_stream.stream.maps.map_follower import MapFollower
from coview_stream.stream.node.counters import PoseRate
from coview_stream.stream.node.election import Elections
from coview_stream.stream.node.engine_feed import EngineFeed
from coview_stream.stream.node.engine_process import EngineRunner
from coview_stream.stream.node.fleet import FleetShares
from coview_stream.stream.node.jobs import Job
from coview_stream.stream.node.robot_endpoints import RobotEndpoints
from coview_stream.stream.node.scheduling import Rate
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

_MAX_POSE_TICKS = 200.0  # of the pose clock, per second; set by hand, as are those below
_CLOSE_TIMEOUT = 1.5  # seconds for everything to end; ``serve`` promises two
_JOIN_TIMEOUT = 0.3  # of these, for the threads to finish what they are at


class Reloader(Protocol):
    """Changes the map of a running node: :class:`~coview_stream.stream.node.reload.MapReloader`."""

    @property
    def last(self) -> dict[str, Any]:
        """What became of the newest change."""
        ...

    def request(self) -> dict[str, Any]:
        """Ask for a change; return at once."""
        ...


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
        elections: whether this node or another one serves a robot; None: this one serves them all.

    Attributes:
        sessions: one per robot, those in force; the list given, whose items another map replaces.
        started: local time at which it was made.
        elections: as given.
        beat: local time at which the pose clock has ticked last.
        reloader: changes the map; None if there is no way to open one.
        map_follower: has it changed when its source elsewhere changes; None of a map that is here.
        map_files: what the map was opened from, by its hash; also of one that is to take its place.
        feeds: of the engines of the map that is served, and of another that is to take its place.
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
        elections: Elections | FleetShares | None = None,
    ) -> None:
        self.sessions = sessions if isinstance(sessions, list) else list(sessions)  # in place: others look at it
        self.transport = transport
        self.config = config or NodeConfig()
        self._errors = RateLimitedErrors(log)
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._background = dict(background or {})
        self.elections = elections
        self._reporter = Reporter(self.sessions, transport, self._errors, elections)
        engines = {"track": track, "search": search} | ({"odometry": odometry} if odometry else {})
        self.feeds: tuple[EngineFeed, ...] = (self.make_feed(self.sessions, engines),)
        self._robots = [
            RobotEndpoints(session, transport, self._reporter, self._wake_engines_for, pose_format, elections)
            for session in self.sessions
        ]
        self.endpoints = {robot.session.keys.robot: robot for robot in self._robots}
        self._ending: threading.Thread | None = None
        self.started = self.beat = time.monotonic()
        self.reloader: Reloader | None = None
        self.map_follower: MapFollower | None = None
        self.map_files: Mapping[str, Path] = {}

    # ---- life

    def start(self) -> None:
        """Declare everything and start the threads."""
        self.declare()
        for feed in self.feeds:
            feed.start()
        self._start_thread("poses", self._run_pose_clock)
        self._start_thread("status", self._reporter.run, self.config.status_rate, self._stopping)
        for name, run in self._background.items():
            self._start_thread(name, run, self._stopping)

    def _start_thread(self, name: str, target: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=target, name=f"coview-{name}", args=args, daemon=True)
        thread.start()
        self._threads.append(thread)  # now, for one that has not started counts as one that has ended

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
        self._reporter.publish_last(time.monotonic())
        self.transport.close()

    # ---- the engines

    def _wake_engines_for(self, session: Session) -> None:
        for feed in self.feeds:
            feed.wake_for(session)

    def next_job(self, engine: str) -> tuple[Session, Job] | None:
        """Return whose turn it is at an engine, and the job; None if there is nothing to do."""
        return self.feeds[0].next_job(engine)

    def work(self, engine: str, session: Session, job: Job) -> None:
        """Do one job; see :meth:`EngineFeed.work`."""
        self.feeds[0].work(engine, session, job)

    def watch(self, engine: str) -> None:
        """Look after an engine without a job; see :meth:`EngineFeed.watch`."""
        self.feeds[0].watch(engine)

    @property
    def map_sha256(self) -> str:
        """Hash of the map that is served; during a change of the map, of the one before."""
        return self.feeds[0].sessions[0].map_sha256

    @property
    def ended_threads(self) -> list[str]:
        """Names of its threads that have ended, though it has not."""
        threads = [*self._threads, *(thread for feed in self.feeds for thread in feed.threads)]
        return [t.name for t in threads if not (t.is_alive() or self._stopping.is_set())]

    @property
    def pose_rates(self) -> dict[str, PoseRate]:
        """Rates at which the poses of each robot go out."""
        return self._reporter.rates

    def run_beside(self, name: str, run: Callable[[threading.Event], None]) -> None:
        """Add something that has a thread of its own, to be started with the others."""
        self._background[name] = run

    def make_feed(self, sessions: Sequence[Session], engines: Mapping[str, EngineRunner]) -> EngineFeed:
        """Return a feed of engines whose robots are this node's."""
        return EngineFeed(sessions, engines, self._errors, self._note_change)

    def _note_change(self, session: Session | None) -> None:
        if session is None:
            self._reporter.changed.set()
        elif session in self.sessions:  # else it is of a map that is not in force yet
            self._reporter.report_change(session)

    def reload(self) -> dict[str, Any]:
        """Ask for the map's file to be opened again; ``ok`` is False where this node cannot."""
        if self.reloader is None:
            return {"ok": False, "error": "this node was not made with a way to open a map"}
        return self.reloader.request()

    # ---- another map, beside the one that is served

    def add_map(self, feed: EngineFeed) -> None:
        """Have the robots' messages go to the sessions and engines of another map as well, which publish nothing."""
        for left in self.feeds[1:]:  # of a change that failed half way
            left.close(_JOIN_TIMEOUT)
        self.feeds = (self.feeds[0], feed)
        for robot, session in zip(self._robots, feed.sessions, strict=True):
            robot.add_session(session)
        feed.start()

    def switch_robot(self, number: int) -> None:
        """Publish from now on what the other map's session says of a robot, the ``number``-th."""
        robot = self._robots[number]
        robot.switch_session()
        self.sessions[number] = robot.session
        self._reporter.changed.set()

    def drop_map(self) -> None:
        """End the engines of the first map, when all robots are on the other one."""
        old, self.feeds = self.feeds[0], self.feeds[1:]
        old.close(_JOIN_TIMEOUT)

    # ---- the pose clock

    def _run_pose_clock(self) -> None:
        # robots are served one after the other over the period: poses of many at once are more than the queues of
        # zenoh and of a router hold for urgent messages, and those that came last would be dropped
        rate = self.config.pose_rate
        groups = max(1, min(len(self._robots), int(_MAX_POSE_TICKS / rate)))
        clock = Rate(rate * groups, time.monotonic(), slack=0.5 / rate)
        group = 0
        while not self._stopping.wait(clock.remaining(time.monotonic())):
            self.beat = now = time.monotonic()
            if clock.take_tick(now):
                self.publish_poses(now, self._robots[group::groups])
                group = (group + 1) % groups

    def publish_poses(self, now: float, robots: Sequence[RobotEndpoints] | None = None) -> None:
        """Let time pass in every session, or in some, and publish the poses that are known."""
        for robot in self._robots if robots is None else robots:
            with self._errors.catch(robot.session.keys.robot):
                robot.publish_pose(now)
