"""The node: threads and clocks around the pure sessions, between a transport and two engine lanes.

Who waits for whom: transport threads decode and enqueue; one thread feeds each lane and waits for it; the pose clock
and the status clock wait for nobody.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from coview_stream.fix import State
from coview_stream.search import Verdict
from coview_stream.stream import rmw
from coview_stream.stream import status as statuses
from coview_stream.stream.codecs import encode_pose
from coview_stream.stream.config import NodeConfig
from coview_stream.stream.guard import Guard
from coview_stream.stream.jobs import FrameJob, FrameResult, SearchJob
from coview_stream.stream.keys import RobotKeys
from coview_stream.stream.lane import DiedError, FailedError, Lane, RejectedError
from coview_stream.stream.messages import Encoded, Sample
from coview_stream.stream.session import Session
from coview_stream.stream.transport import Connection, Publisher, Transport
from coview_stream.stream.turns import Turns

log = logging.getLogger("coview_stream.node")

_JSON = "application/json"
_ROS_NODE = "coview_stream"
_LONGEST_PAUSE = 10.0  # seconds before an engine that keeps dying is started again


class Node:
    """Serves several robots on one map.

    Args:
        sessions: one per robot.
        transport: where messages come from and go to; the node closes it.
        track: lane to the engine that takes in frames.
        search: lane to the engine that searches the map.
        config: rates and limits.
        pose_format: codec of the poses; None leaves it to each robot's keys.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        transport: Transport,
        track: Lane,
        search: Lane,
        config: NodeConfig | None = None,
        pose_format: str | None = None,
    ) -> None:
        self.sessions = list(sessions)
        self.transport = transport
        self.config = config or NodeConfig()
        self._pose_format = pose_format
        self._lanes = {"track": track, "search": search}
        self._wake = threading.Condition()
        self._deaths = dict.fromkeys(self._lanes, 0)  # in a row
        self._turns = {name: Turns(len(self.sessions)) for name in self._lanes}
        self._guard = Guard(log)
        self._stopping = threading.Event()
        self._changed = threading.Event()
        self._threads: list[threading.Thread] = []
        self._started = time.monotonic()
        self._identity = uuid.uuid4().hex  # of our ROS node, where there is one
        self._connection = Connection()
        self._reconnects = 0
        self._was_connected = self._ever_connected = False
        self._told: dict[str, State] = {}
        self._rates = {s.keys.robot: statuses.PoseRate() for s in self.sessions}
        self._poses: dict[str, Publisher] = {}
        self._statuses: dict[str, Publisher] = {}

    # ---- life

    def start(self) -> None:
        """Declare everything and start the threads."""
        self.declare()
        for name, work in (
            ("track", partial(self._feed, "track")),
            ("search", partial(self._feed, "search")),
            ("poses", self._run_poses),
            ("status", self._run_statuses),
        ):
            thread = threading.Thread(target=work, name=f"coview-{name}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def declare(self) -> None:
        """Declare publishers, subscriptions, queryables and liveliness tokens."""
        for session in self.sessions:
            keys = session.keys
            self._poses[keys.robot] = self._pose_publisher(keys)
            self._statuses[keys.robot] = self.transport.publisher(keys.status, "data")
            self.transport.subscribe(keys.odometry, partial(self._on_odometry, session), "all")
            self.transport.subscribe(keys.cloud, partial(self._on_cloud, session), "newest")
            self.transport.answer(keys.relocalize, partial(self._relocalize, session))
            self.transport.answer(keys.reset, partial(self._reset, session))
            self.transport.announce(keys.alive)

    def _pose_publisher(self, keys: RobotKeys) -> Publisher:
        publisher = self.transport.publisher(keys.pose, "realtime")
        if not keys.rmw:
            return publisher
        domain = int(keys.pose.split("/")[0])
        entity = len(self._poses) + 1
        token = rmw.publisher_token(keys.pose, self._identity, _ROS_NODE, entity)
        if entity == 1:
            self.transport.announce(rmw.node_token(domain, self._identity, _ROS_NODE))
        self.transport.announce(token)
        return rmw.RmwPublisher(publisher, token, time.time_ns)

    def close(self) -> None:
        """Publish a last status, undeclare, end the engines; idempotent."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        self._changed.set()
        with self._wake:
            self._wake.notify_all()
        for lane in self._lanes.values():
            lane.close()
        for thread in self._threads:
            thread.join(timeout=0.5)
        for session in self.sessions:
            self._tell(session, time.monotonic(), closing=True)
        self.transport.close()

    # ---- what comes in, on the transport's threads

    def _on_cloud(self, session: Session, sample: Sample) -> None:
        session.on_cloud(sample, time.monotonic())
        self._poke()

    def _on_odometry(self, session: Session, sample: Sample) -> None:
        session.on_odometry(sample, time.monotonic())
        self._poke()

    def _poke(self) -> None:
        with self._wake:
            self._wake.notify_all()

    def _relocalize(self, session: Session, parameters: dict[str, str]) -> dict[str, Any]:
        session.begin_anew("asked to search again")
        return self._reply(session)

    def _reset(self, session: Session, parameters: dict[str, str]) -> dict[str, Any]:
        session.reset()
        return self._reply(session)

    def _reply(self, session: Session) -> dict[str, Any]:
        self._changed.set()
        state, reason = session.state()
        return {"ok": True, "robot": session.keys.robot, "state": state.value, "reason": reason}

    # ---- the engine's work, one thread for each lane

    def _feed(self, name: str) -> None:
        while not self._stopping.is_set():
            found = self.next_job(name)
            if found is None:
                with self._wake:
                    self._wake.wait(timeout=0.05)
            else:
                self.work(name, *found)

    def next_job(self, name: str) -> tuple[Session, FrameJob | SearchJob] | None:
        """Return whose turn it is in a lane, and with which job; None if there is nothing to do."""
        if name == "track":
            return self._turns[name].next(self.sessions, Session.take_frame)
        # who has a candidate already needs but a few more searches; all the others have to start from nothing
        return self._turns[name].next(self.sessions, Session.take_search, Session.hopeful)

    def work(self, name: str, session: Session, job: FrameJob | SearchJob) -> None:
        """Do one job; what goes wrong is counted and concerns this robot, unless the engine died."""
        try:
            result = self._lanes[name].run(job)
        except RejectedError as error:
            self._report(session, job, str(error), rejected=True)
        except FailedError as error:
            log.error("%s: the %s engine failed on a frame:\n%s", job.robot, name, error)
            self._report(session, job, str(error), rejected=False)
        except DiedError as error:
            if self._stopping.is_set():
                return
            log.error("%s; starting it again", error)
            if name == "track":
                for each in self.sessions:
                    each.engine_restarted()
            self._report(session, job, str(error), rejected=False)
            self._changed.set()
            self._deaths[name] += 1
            self._stopping.wait(min(0.1 * 2.0 ** self._deaths[name], _LONGEST_PAUSE))
        except Exception as error:  # nobody thought of it, but the other robots' work goes on
            log.exception("%s: unexpected error in the %s lane", job.robot, name)
            self._report(session, job, repr(error), rejected=False)
            self._stopping.wait(0.2)
        else:
            self._deaths[name] = 0
            if isinstance(job, FrameJob) and isinstance(result, FrameResult):
                session.frame_done(job, result, time.monotonic())
            elif isinstance(job, SearchJob) and isinstance(result, Verdict):
                session.search_done(job, result)
            if session.state()[0] is not self._told.get(session.keys.robot):
                self._changed.set()
            if result is not None:
                self._poke()

    def _report(self, session: Session, job: FrameJob | SearchJob, reason: str, rejected: bool) -> None:
        if isinstance(job, FrameJob):
            session.frame_failed(job, reason, rejected)
        else:
            session.search_done(job, None)

    # ---- the clocks

    def _run_poses(self) -> None:
        self._at_rate(self.config.pose_rate, self.publish_poses, self._stopping.wait)

    def publish_poses(self, now: float) -> None:
        """Let time pass in every session and publish the poses that are known."""
        for session in self.sessions:
            self._guard.run(session.keys.robot, partial(self._publish_pose, session, now))

    def _publish_pose(self, session: Session, now: float) -> None:
        session.tick(now)
        robot = session.keys.robot
        pose = session.pose()
        if pose is not None:
            encoded = encode_pose(pose, self._pose_format or session.keys.pose_format)
            bare = session.keys.bare and self._pose_format is None
            self._poses[robot].put(Encoded(encoded.payload) if bare else encoded)
            self._rates[robot].add(now)
        if session.state()[0] is not self._told.get(robot):
            self._changed.set()

    def _at_rate(self, rate: float, act: Callable[[float], None], wait: Callable[[float], bool]) -> None:
        """Call ``act`` at absolute times; after a pause of the machine go on, do not catch up."""
        period = 1.0 / rate
        due = time.monotonic()
        while not self._stopping.is_set():
            now = time.monotonic()
            if now < due:
                wait(due - now)
                continue
            try:
                act(now)
            except Exception:
                log.exception("the pose clock goes on after an unexpected error")
            due += period
            if now - due > period:
                due = now + period

    def _run_statuses(self) -> None:
        period = 1.0 / self.config.status_rate
        due = time.monotonic()
        while not self._stopping.is_set():
            changed = self._changed.wait(timeout=max(0.0, due - time.monotonic()))
            self._changed.clear()
            if self._stopping.is_set():
                return
            now = time.monotonic()
            regular = now >= due
            try:
                self.publish_statuses(now, everyone=regular)
            except Exception:
                log.exception("the status clock goes on after an unexpected error")
            if regular:
                due = max(due + period, now)
            elif changed:
                self._stopping.wait(0.01)  # many changes at once are one status each, not a flood

    def publish_statuses(self, now: float, everyone: bool = True) -> None:
        """Publish the status of every robot, or of those whose state has changed."""
        if everyone:
            self._look_at_connection()
        for session in self.sessions:
            if everyone or session.state()[0] is not self._told.get(session.keys.robot):
                self._tell(session, now)

    def _tell(self, session: Session, now: float, closing: bool = False) -> None:
        robot = session.keys.robot
        rate = self._rates[robot].rate(now)
        document = statuses.status(session, self._connection, self._reconnects, rate, now - self._started)
        state = State(document["state"])
        if closing:
            document["reason"] = "the node is shutting down"
            if state is State.TRACKING:  # nobody tracks it any more
                document["state"] = State.LOST.value
        elif state is not self._told.get(robot):
            log.info("%s: %s (%s)", robot, state.value, document["reason"])
        self._told[robot] = state
        self._statuses[robot].put(Encoded(json.dumps(document).encode(), _JSON))

    def _look_at_connection(self) -> None:
        connection = self.transport.connection()
        anybody = bool(connection.routers or connection.peers)
        if anybody and not self._was_connected and self._ever_connected:
            self._reconnects += 1
            log.info("connected again: routers %s, peers %s", connection.routers, connection.peers)
        elif not anybody and self._was_connected:
            log.warning("nobody is connected any more")
        self._was_connected = anybody
        self._ever_connected |= anybody
        self._connection = connection
