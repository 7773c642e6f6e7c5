"""The node: threads and clocks around the pure sessions, between a transport and engine lanes.

Who waits for whom: transport threads decode and enqueue; one thread feeds each lane and waits for it; the pose clock
and the status clock wait for nobody.
"""

# FOLDED coview_stream/stream/node/node.py: """What a job came to, told to the session that it was of."""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from coview_stream.config.node import NodeConfig
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.messages import encode_pose
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.node.decoding import last_line
from coview_stream.stream.node.engine_process import DiedError, FailedError, Lane, RejectedError
from coview_stream.stream.node.jobs import (
    FrameJob,
    FrameResult,
    Job,
    OdometryJob,
    OdometryResult,
    Result,
    SearchJob,
)
from coview_stream.stream.node.lidar_session import LidarSession
from coview_stream.stream.node.scheduling import Rate, RoundRobin
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport import rmw
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.transport import Publisher, Transport

log = logging.getLogger("coview_stream.node")

_ROS_NODE = "coview_stream"

_MOST_BEATS = 200.0  # of the pose clock, per second

_LONGEST_PAUSE = 10.0  # seconds before an engine that keeps dying is started again

_AFTER_SURPRISE = 0.2  # seconds of pause after an error that nobody thought of

_GOODBYE = 1.5  # seconds for everything to end; whoever runs us may promise two

_LAST_WORK = 0.3  # of these, for the threads to finish what they are at


class Node:
    """Serves several robots on one map.

    Args:
        sessions: one per robot.
        transport: where messages come from and go to; the node closes it.
        track: lane to the engine that takes in frames.
        search: lane to the engine that searches the map.
        odometry: lane to the engine that makes odometry, for robots that send none; None if there are none.
        config: rates and limits.
        pose_format: codec of the poses; None leaves it to each robot's keys.
        aside: what else has a thread of its own, by name; each runs until the event that it is given is set.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        transport: Transport,
        track: Lane,
        search: Lane,
        config: NodeConfig | None = None,
        pose_format: str | None = None,
        odometry: Lane | None = None,
        aside: Mapping[str, Callable[[threading.Event], None]] | None = None,
    ) -> None:
        self.sessions = list(sessions)
        self.transport = transport
        self.config = config or NodeConfig()
        self._pose_format = pose_format
        self._lanes = {"track": track, "search": search} | ({"odometry": odometry} if odometry else {})
        self._wake = threading.Condition()
        self._deaths = dict.fromkeys(self._lanes, 0)  # in a row
        self._turns = {name: RoundRobin(len(self.sessions)) for name in self._lanes}
        self._guard = RateLimitedErrors(log)
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._aside = dict(aside or {})
        self._identity = uuid.uuid4().hex  # of our ROS node, where there is one
        self._reporter = Reporter(self.sessions, transport, self._guard)
        self._poses: dict[str, Publisher] = {}
        self._ending: threading.Thread | None = None

    # ---- life

    def start(self) -> None:
        """Declare everything and start the threads."""
        self.declare()
        work: dict[str, Callable[[], None]] = {name: partial(self._feed, name) for name in self._lanes}
        work["poses"] = self._run_poses
        work["status"] = partial(self._reporter.run, self.config.status_rate, self._stopping)
        work |= {name: partial(run, self._stopping) for name, run in self._aside.items()}
        for name, target in work.items():
            thread = threading.Thread(target=target, name=f"coview-{name}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def declare(self) -> None:
        """Declare publishers, subscriptions, queryables and liveliness tokens."""
        for session in self.sessions:
            keys = session.keys
            self._poses[keys.robot] = self._pose_publisher(keys)
            self._reporter.declare(session)
            if session.odometry_source == "robot":
                self.transport.subscribe(keys.odometry, partial(self._receive, session.on_odometry), "all")
            self.transport.subscribe(keys.cloud, partial(self._receive, session.on_cloud), "newest")
            self.transport.answer(keys.relocalize, partial(self._ask, session, session.relocalize))
            self.transport.answer(keys.reset, partial(self._ask, session, session.reset))
            self.transport.announce(keys.alive)

    def _pose_publisher(self, keys: RobotKeys) -> Publisher:
        publisher = self.transport.publisher(keys.pose, "realtime")
        if not keys.rmw:
            return publisher
        entity = len(self._poses) + 1
        token = rmw.publisher_token(keys.pose, self._identity, _ROS_NODE, entity)
        if entity == 1:
            self.transport.announce(rmw.node_token(int(keys.pose.split("/")[0]), self._identity, _ROS_NODE))
        self.transport.announce(token)
        return rmw.RmwPublisher(publisher, token, time.time_ns)

    def close(self, patience: float = _GOODBYE) -> bool:
        """Publish a last status, undeclare, end the engines; later calls only wait.

        Returns:
            Whether all is done; False after ``patience`` seconds if the network holds up the thread that does it.
        """
        if not self._stopping.is_set():
            self._stopping.set()
            self._reporter.changed.set()
            self._poke()
            self._ending = threading.Thread(target=self._end, name="coview-end", daemon=True)
            self._ending.start()
        if self._ending is not None:
            self._ending.join(max(0.0, patience))
        return self._ending is None or not self._ending.is_alive()

    def _end(self) -> None:
        for lane in self._lanes.values():
            self._guard.run("ending an engine", lane.close)
        last = time.monotonic() + _LAST_WORK
        for thread in self._threads:
            thread.join(timeout=max(0.0, last - time.monotonic()))
        self._reporter.say_goodbye(time.monotonic())
        self.transport.close()

    # ---- what comes in, on the transport's threads

    def _receive(self, take: Callable[[Sample, float], None], sample: Sample) -> None:
        take(sample, time.monotonic())
        self._poke()

    def _poke(self) -> None:
        with self._wake:
            self._wake.notify_all()

    def _ask(self, session: Session, act: Callable[[], None], parameters: dict[str, str]) -> dict[str, Any]:
        act()
        self._reporter.changed.set()
        state, reason = session.state()
        return {"ok": True, "robot": session.keys.robot, "state": state.value, "reason": reason}

    # ---- the engine's work

    def _feed(self, name: str) -> None:
        while not self._stopping.is_set():
            if self._guard.run(f"the {name} lane", partial(self._feed_one, name)):
                self._stopping.wait(_AFTER_SURPRISE)

    def _feed_one(self, name: str) -> None:
        found = self.next_job(name)
        if found is not None:
            self.work(name, *found)
            return
        with self._wake:
            self._wake.wait(timeout=0.05)

    def next_job(self, name: str) -> tuple[Session, Job] | None:
        """Return whose turn it is in a lane, and with which job; None if there is nothing to do."""
        if name == "track":
            return self._turns[name].next(self.sessions, Session.take_frame)
        if name == "odometry":
            return self._turns[name].next(self.sessions, take_sweep)
        # who has a candidate already needs but a few more searches; all the others have to start from nothing
        return self._turns[name].next(self.sessions, Session.take_search, Session.hopeful)

    def work(self, name: str, session: Session, job: Job) -> None:
        """Do one job; what goes wrong is counted and concerns this robot, unless the engine died."""
        try:
            result = self._lanes[name].run(job)
        except RejectedError as error:
            tell_failed(session, job, error)
        except FailedError as error:
            self._guard.report(f"{job.robot}: the {name} engine", error)
            tell_failed(session, job, error)
        except DiedError as error:
            if not self._stopping.is_set():
                self._died(name, error)
                tell_failed(session, job, error)
                self._deaths[name] += 1
                self._stopping.wait(min(0.1 * 2.0 ** self._deaths[name], _LONGEST_PAUSE))
        except Exception as error:  # nobody thought of it, but the other robots' work goes on
            self._guard.report(f"{job.robot}: unexpected, in the {name} lane", error)
            tell_failed(session, job, error)
            self._stopping.wait(_AFTER_SURPRISE)
        else:
            self._deaths[name] = 0
            self._done(session, job, result)

    def _done(self, session: Session, job: Job, result: Result) -> None:
        tell_done(session, job, result, time.monotonic())
        if self._reporter.has_news(session):
            self._reporter.changed.set()
        self._poke()  # a frame may have asked for a search

    def _died(self, name: str, error: DiedError) -> None:
        why = last_line(str(error))
        self._guard.report(f"the {name} engine is started again", error, kind=why)
        for each in self.sessions:
            each.engine_restarted(name, why)
        self._reporter.changed.set()

    # ---- the pose clock

    def _run_poses(self) -> None:
        # robots are served one after the other over the period: poses of many at once are more than the queues of
        # zenoh and of a router hold for urgent messages, and those that came last would be dropped
        rate = self.config.pose_rate
        groups = max(1, min(len(self.sessions), int(_MOST_BEATS / rate)))
        clock = Rate(rate * groups, time.monotonic(), slack=0.5 / rate)
        group = 0
        while not self._stopping.wait(clock.remaining(time.monotonic())):
            now = time.monotonic()
            if clock.beat(now):
                self._guard.run(
                    "the pose clock", partial(self.publish_poses, now, self.sessions[group::groups])
                )
                group = (group + 1) % groups

    def publish_poses(self, now: float, sessions: Sequence[Session] | None = None) -> None:
        """Let time pass in every session, or in some, and publish the poses that are known."""
        for session in self.sessions if sessions is None else sessions:
            self._guard.run(session.keys.robot, partial(self._publish_pose, session, now))

    def _publish_pose(self, session: Session, now: float) -> None:
        session.tick(now)
        robot, pose = session.keys.robot, session.pose()
        if pose is not None:
            encoded = encode_pose(pose, self._pose_format or session.keys.pose_format)
            bare = session.keys.bare and self._pose_format is None
            self._poses[robot].put(Encoded(encoded.payload) if bare else encoded)
            self._reporter.rates[robot].add(now)
        if self._reporter.has_news(session):
            self._reporter.changed.set()


def take_sweep(session: Session) -> OdometryJob | None:
    """Hand out a frame to make odometry of, for a robot that sends none."""
    return session.take_sweep() if isinstance(session, LidarSession) else None


def tell_done(session: Session, job: Job, result: Result, now: float) -> None:
    """Hand a result over at local time ``now``."""
    if isinstance(job, FrameJob) and isinstance(result, FrameResult):
        session.frame_done(job, result, now)
    elif isinstance(job, SearchJob) and isinstance(result, SearchResult):
        session.search_done(job, result)
    elif (
        isinstance(job, OdometryJob)
        and isinstance(result, OdometryResult)
        and isinstance(session, LidarSession)
    ):
        session.sweep_done(job, result, now)


def tell_failed(session: Session, job: Job, error: Exception) -> None:
    """Say that there is no result, and whether the engine is as good as before (RejectedError)."""
    reason = str(error) if isinstance(error, (RejectedError, FailedError, DiedError)) else repr(error)
    rejected = isinstance(error, RejectedError)
    if isinstance(job, FrameJob):
        session.frame_failed(job, reason, rejected)
    elif isinstance(job, SearchJob):
        session.search_failed(job, reason)
    elif isinstance(session, LidarSession):
        session.sweep_failed(job, reason, rejected)
