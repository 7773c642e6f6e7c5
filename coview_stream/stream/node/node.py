"""The node: endpoints of the robots on the network, and threads and clocks between their sessions and the engines.

Who waits for whom: the transport's threads decode and queue; one thread feeds each engine and waits for it; the pose
clock and the status clock wait for neither.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from coview_stream.config.node import NodeConfig
from coview_stream.messages import encode_pose
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.node.counters import last_line
from coview_stream.stream.node.engine_process import DiedError, EngineRunner, FailedError, RejectedError
from coview_stream.stream.node.jobs import Job
from coview_stream.stream.node.scheduling import Rate, RoundRobin, search_order
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport import rmw
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Publisher, Transport

log = logging.getLogger("coview_stream.node")

_ROS_NODE = "coview_stream"
_MAX_POSE_TICKS = 200.0  # of the pose clock, per second; set by hand, as are those below
_MAX_RESTART_PAUSE = 10.0  # seconds before an engine that keeps dying is started again
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
        else:
            self._wake[engine].wait(timeout=_IDLE_WAIT)

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
            if not self._stopping.is_set():
                self._engine_died(engine, error)
                session.handle_failure(job, str(error))
                self._deaths[engine] += 1
                self._stopping.wait(min(0.1 * 2.0 ** self._deaths[engine], _MAX_RESTART_PAUSE))
        except Exception as error:  # not foreseen, but the other robots' work goes on
            self._errors.report(f"{job.robot}: unexpected, at the {engine} engine", error)
            session.handle_failure(job, repr(error))
            self._stopping.wait(_ERROR_PAUSE)
        else:
            self._deaths[engine] = 0
            session.handle_result(job, result, time.monotonic())
            self._reporter.report_change(session)
            self._wake_engines_for(session)  # a frame may have asked for a search

    def _engine_died(self, engine: str, error: DiedError) -> None:
        why = last_line(str(error))
        self._errors.report(f"the {engine} engine is started again", error, kind=why)
        for session in self.sessions:
            session.engine_restarted(engine, why)
        self._reporter.changed.set()

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


class RobotEndpoints:
    """One robot's subscriptions, queryables, publishers and liveliness tokens, around its session.

    Args:
        session: of the robot.
        transport: where everything is declared.
        reporter: publishes the robot's status.
        wake_engines: called with the session when there may be a job.
        pose_format: codec of the poses; None leaves it to the robot's keys.
    """

    def __init__(
        self,
        session: Session,
        transport: Transport,
        reporter: Reporter,
        wake_engines: Callable[[Session], None],
        pose_format: str | None = None,
    ) -> None:
        self.session = session
        self._transport = transport
        self._reporter = reporter
        self._wake_engines = wake_engines
        self._pose_format = pose_format or session.keys.pose_format
        self._bare = session.keys.bare and pose_format is None
        self._publisher: Publisher | None = None

    def declare(self, node_id: str, number: int) -> None:
        """Declare everything; ``node_id`` is of our ROS node, and ``number`` of this robot there, from 1."""
        keys, transport = self.session.keys, self._transport
        self._publisher = self._pose_publisher(node_id, number)
        self._reporter.declare(self.session)
        if self.session.odometry_source == "robot":
            transport.subscribe(keys.odometry, self.on_odometry, "all")
        transport.subscribe(keys.cloud, self.on_cloud, "newest")
        transport.answer(keys.relocalize, self.relocalize)
        transport.answer(keys.reset, self.reset)
        transport.announce(keys.alive)

    def _pose_publisher(self, node_id: str, number: int) -> Publisher:
        keys = self.session.keys
        publisher = self._transport.publisher(keys.pose, "realtime")
        if not keys.rmw:
            return publisher
        token = rmw.publisher_token(keys.pose, node_id, _ROS_NODE, number)
        if number == 1:
            self._transport.announce(rmw.node_token(int(keys.pose.split("/")[0]), node_id, _ROS_NODE))
        self._transport.announce(token)
        return rmw.RmwPublisher(publisher, token, time.time_ns)

    def on_cloud(self, sample: Sample) -> None:
        """Take in a cloud."""
        self.session.on_cloud(sample, time.monotonic())
        self._wake_engines(self.session)

    def on_odometry(self, sample: Sample) -> None:
        """Take in an odometry sample."""
        self.session.on_odometry(sample, time.monotonic())
        self._wake_engines(self.session)

    def relocalize(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/relocalize``."""
        self.session.relocalize()
        return self._answer()

    def reset(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/reset``."""
        self.session.reset()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        self._reporter.changed.set()
        state, reason = self.session.state()
        return {"ok": True, "robot": self.session.keys.robot, "state": state.reported, "reason": reason}

    def publish_pose(self, now: float) -> None:
        """Let time pass in the session, and publish the pose if it is known."""
        self.session.tick(now)
        pose = self.session.pose()
        if pose is not None and self._publisher is not None:
            encoded = encode_pose(pose, self._pose_format)
            self._publisher.put(Encoded(encoded.payload) if self._bare else encoded)
            self._reporter.rates[self.session.keys.robot].add(now)
        self._reporter.report_change(self.session)
