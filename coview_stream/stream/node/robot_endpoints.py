"""Endpoints of one robot on the network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from coview_stream.errors import InputError
from coview_stream.localization.search.place_guess import PlaceGuess
from coview_stream.messages import encode_pose
from coview_stream.messages.types import Encoded, PoseMessage, Sample
from coview_stream.stream.node.election import Elections
from coview_stream.stream.node.fleet import FleetShares
from coview_stream.stream.node.initial_pose import decode_guess, guess_of_fields
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport import rmw
from coview_stream.stream.transport.transport import Publisher, Transport

_ROS_NODE = "coview_stream"


class RobotEndpoints:
    """One robot's subscriptions, queryables, publishers and liveliness tokens, around its session.

    Args:
        session: of the robot.
        transport: where everything is declared.
        reporter: publishes the robot's status.
        wake_engines: called with the session when there may be a job.
        pose_format: codec of the poses; None leaves it to the robot's keys.
        elections: whether this node serves it; None: it does.
    """

    def __init__(
        self,
        session: Session,
        transport: Transport,
        reporter: Reporter,
        wake_engines: Callable[[Session], None],
        pose_format: str | None = None,
        elections: Elections | FleetShares | None = None,
    ) -> None:
        self._elections = elections
        self._sessions: tuple[Session, ...] = (session,)  # that in force, and perhaps one on another map
        self._switching = threading.Lock()  # no pose of the session before is published after the switch
        self._transport = transport
        self._reporter = reporter
        self._wake_engines = wake_engines
        self._pose_format = pose_format or session.keys.pose_format
        self._bare = session.keys.bare and pose_format is None
        self._publisher: Publisher | None = None
        self.beside: list[Callable[[PoseMessage], None]] = []  # called with every pose that goes out
        self.waits = False
        """Whether it listens only from :meth:`listen` on, not once it is declared."""
        self._endings: list[Callable[[], None]] = []  # of subscriptions

    @property
    def session(self) -> Session:
        """The session in force."""
        return self._sessions[0]

    def add_session(self, session: Session) -> None:
        """Hand all messages to another session as well, of another map."""
        self._sessions = (self._sessions[0], session)

    def switch_session(self) -> None:
        """Go over to that session, which goes on from what the one in force has counted and published."""
        with self._switching:
            old, new = self._sessions
            new.continue_from(old)
            self._sessions = (new,)

    def declare(self, node_id: str, number: int) -> None:
        """Declare everything; ``node_id`` is of our ROS node, and ``number`` of this robot there, from 1."""
        keys, transport = self.session.keys, self._transport
        self._publisher = self._pose_publisher(node_id, number)
        self._reporter.declare(self.session)
        if not self.waits:
            self.listen()
        transport.answer(keys.relocalize, self.relocalize)
        transport.answer(keys.reset, self.reset)
        transport.answer(keys.suggest, self.suggest)
        transport.subscribe(keys.initial_pose, self.on_initial_pose, "all")
        transport.announce(keys.alive)

    @property
    def listening(self) -> bool:
        """Whether clouds and odometry are taken in."""
        return bool(self._endings)

    @property
    def active(self) -> bool:
        """Whether this node serves the robot or stands by for it; not where another node of its fleet serves it."""
        return self.listening or not self.waits

    def listen(self) -> None:
        """Take clouds and odometry in from now on."""
        keys, transport = self.session.keys, self._transport
        if self.session.odometry_source == "robot":
            self._endings.append(transport.subscribe(keys.odometry, self.on_odometry, "all"))
        self._endings.append(transport.subscribe(keys.cloud, self.on_cloud, "newest"))

    def stop_listening(self) -> None:
        """Take no clouds and no odometry in: nobody has to send them here."""
        endings, self._endings = self._endings, []
        for end in endings:
            end()

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
        self._note_heard()
        for session in self._sessions:
            session.on_cloud(sample, time.monotonic())
            self._wake_engines(session)

    def on_odometry(self, sample: Sample) -> None:
        """Take in an odometry sample."""
        self._note_heard()
        for session in self._sessions:
            session.on_odometry(sample, time.monotonic())
            self._wake_engines(session)

    def _note_heard(self) -> None:
        if self._elections is not None:
            self._elections.hear_robot(self.session.keys.robot)

    def relocalize(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/relocalize``."""
        for session in self._sessions:
            session.relocalize()
        return self._answer()

    def reset(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/reset``."""
        for session in self._sessions:
            session.reset()
        return self._answer()

    def suggest(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/suggest``; InputError, which is replied, where it names no place."""
        taken = self._guess(guess_of_fields(parameters))
        note = "" if taken else "the place is known, the guess is ignored; ask rpc/relocalize first"
        return self._answer() | {"taken": taken, "note": note}

    def on_initial_pose(self, sample: Sample) -> None:
        """Take in a guess of the place."""
        try:
            self._guess(decode_guess(sample))
        except InputError as error:
            self.session.errors.add_first(f"{sample.key}: initial poses of no use", str(error))

    def _guess(self, guess: PlaceGuess) -> bool:
        taken = [session.guess_place(guess) for session in self._sessions]  # all of them
        return any(taken)

    def _answer(self) -> dict[str, Any]:
        self._reporter.changed.set()
        state, reason = self.session.state()
        return {"ok": True, "robot": self.session.keys.robot, "state": state.reported, "reason": reason}

    def publish_pose(self, now: float) -> None:
        """Let time pass in the session, and publish the pose if it is known."""
        if not self.active:
            return
        with self._switching:
            self._publish_pose(now)
        self._reporter.report_change(self.session)

    def _publish_pose(self, now: float) -> None:
        for session in self._sessions:
            session.tick(now)
        robot = self.session.keys.robot
        serves = self._elections is None or self._elections.claim(robot) is not None
        if serves and self._publisher is not None and (pose := self.session.pose()) is not None:
            encoded = encode_pose(pose, self._pose_format)
            self._publisher.put(Encoded(encoded.payload) if self._bare else encoded)
            for take in self.beside:
                take(pose)
            self._reporter.rates[robot].add(now)
