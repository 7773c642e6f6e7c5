"""One robot's session: its messages on their way to the engines, and its state by the engines' results.

Pure logic: no thread, no network, no clock. Times called ``now`` are local and monotonic, in seconds; stamps are the
robot's. Every method may be called from any thread.
"""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np

from coview_stream.basemap.map_parts import MapParts
from coview_stream.config.node import NodeConfig
from coview_stream.errors import MessageError
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.place_guess import PlaceGuess
from coview_stream.localization.state import State
from coview_stream.messages import decode_cloud, decode_odometry
from coview_stream.messages.types import CloudMessage, HypothesesMessage, OdometryMessage, PoseMessage, Sample
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters, ErrorLog, MissingFrames, counter_of
from coview_stream.stream.node.engine_queue import EngineQueue
from coview_stream.stream.node.frame_sync import FrameSync
from coview_stream.stream.node.handover import Handover
from coview_stream.stream.node.jobs import FrameJob, FrameResult, Job, OdometryJob, Result, SearchJob
from coview_stream.stream.node.last_pose import LastKnownPose, PoseHint
from coview_stream.stream.node.robot_state import RobotState, StateHistory
from coview_stream.stream.node.scheduling import SearchDemand
from coview_stream.stream.node.session_reasons import COUNTED_AS, RESTART_REASONS, status_text
from coview_stream.stream.transport.keys import RobotKeys

_EVER = 1e9  # seconds: what never came is not missing since then
_SEARCHING = (State.SEARCHING, State.AMBIGUOUS)  # the reason of a loss says itself what has stayed away


class Session:
    """A robot's odometry, its queue to the engines and its state, behind one lock.

    Attributes:
        keys: of its messages.
        counters: of its messages.
        errors: of its input, for people.
        history: of its state.
        odometry: the newest of it.
        queue: frames and search requests for the engines, and how long they took.
        robot_state: its state and the correction of its odometry.
        odometry_source: who makes the odometry: ``robot``, or what does so here.
    """

    odometry_source = "robot"

    def __init__(
        self,
        keys: RobotKeys,
        map_sha256: str,
        config: NodeConfig | None = None,
        codecs: tuple[str | None, str | None] = (None, None),
        parts: MapParts | None = None,
    ) -> None:
        """Begin without any message.

        Args:
            keys: of the robot's messages.
            map_sha256: of the map.
            config: rates and limits.
            codecs: of clouds and odometry, against what they say themselves.
            parts: the maps of which the map is joined; None of one map.
        """
        self.keys = keys
        self.map_sha256 = self.site_sha256 = map_sha256
        self.parts = parts
        self.config = config or NodeConfig()
        self.codecs = codecs
        self._lock = threading.RLock()
        self._epoch = 0  # number of the odometry frame, counted through all resets
        self._hint = PoseHint()
        self._guess: PlaceGuess | None = None  # that no frame has taken to the engine yet
        self._said: PlaceGuess | None = None  # the newest one, until the place is known
        self._clear()

    def _clear(self) -> None:
        """Forget everything but the hint."""
        self._epoch += 1
        self.counters = Counters()
        self.errors = ErrorLog()
        self.history = StateHistory()
        self.odometry = OdometryBuffer(self.config)
        self.queue = EngineQueue(self.keys.robot, self._epoch, self.counters, self.errors)
        self.robot_state = RobotState(self.keys.robot, self.map_sha256, self.counters, self._hint)
        self._frame_sync = FrameSync(self.config, self.odometry, self.counters)
        self._missing = MissingFrames()
        self._disconnected_at = float("-inf")  # local time
        self._cloud_at = float("-inf")  # local time of the newest readable cloud
        self._now = float("-inf")  # local time of the newest tick

    # ---- messages

    def on_cloud(self, sample: Sample, now: float) -> None:
        """Take in a cloud: decode, check, pair with odometry, queue. Never raises for what the sample holds."""
        try:
            message = decode_cloud(sample, self.codecs[0], self.keys.cloud_hint, self.config.max_payload)
        except MessageError as error:
            self._count_undecodable(error, sample.key)
            return
        message = message.limited(self.config.max_points)
        message = replace(message, points=self.config.mount.to_body(message.points))
        with self._lock:
            self._cloud_at = now
            self.counters.received += 1
            self.counters.missing += self._missing.add(message.stamp_ns, message.sequence)
            self._add_cloud(message, now)

    def _add_cloud(self, message: CloudMessage, now: float) -> None:
        """Pair a cloud with the odometry that there is, or let it wait."""
        self._frame_sync.add(message, now)
        self._queue_paired(now)

    def on_odometry(self, sample: Sample, now: float) -> None:
        """Take in an odometry sample. Never raises for what the sample holds."""
        try:
            message = decode_odometry(sample, self.codecs[1], self.keys.odometry_hint, self.config.max_payload)
        except MessageError as error:
            self._count_undecodable(error, sample.key, "odometry_")
            return
        with self._lock:
            self.counters.odometry_received += 1
            unreachable = self._disconnected_at > self.odometry.arrived
            self._add_odometry(message, now, unreachable)

    def _add_odometry(self, message: OdometryMessage, now: float, unreachable: bool = False) -> None:
        """Continue the odometry, or verify the place or search again where it does not continue."""
        kind = self.odometry.add(message, now, unreachable)
        if kind in COUNTED_AS:
            self.counters.count(COUNTED_AS[kind])
        if kind is SampleKind.GAP and self.robot_state.engine_has_place:
            self.robot_state.require_verification(message.stamp_ns)
        elif kind in RESTART_REASONS:
            self.restart_search(RESTART_REASONS[kind])
        self._queue_paired(now)
        self._record_state()

    def _count_undecodable(self, error: MessageError, key: str, prefix: str = "") -> None:
        """Count a message that could not be decoded; name it, unless every such message would have its own reason."""
        name = counter_of(error)
        with self._lock:
            self.counters.count(f"{prefix}received")
            self.counters.count(prefix + name)
            if name == "unknown_encoding":
                self.errors.add(str(error))
            else:
                self.errors.add_first(f"{key}: {name} messages", str(error).removeprefix(f"{key}: "))

    def _queue_paired(self, now: float) -> None:
        """Queue the frames whose odometry is there; the newest one stays."""
        for frame in self._frame_sync.take_paired(now):
            driven, turned = self.odometry.driven_since(frame.message.stamp_ns)  # which may be a while ago
            travelled = self.odometry.travelled - driven
            self.queue.put_frame(frame, now, travelled, self.odometry.turned - turned)

    # ---- time, questions and what else happens

    def tick(self, now: float) -> None:
        """Let time pass: frames and odometry that stay away lose the place."""
        with self._lock:
            self._now = now
            self._queue_paired(now)
            if not self.robot_state.state.has_place:
                return
            silent = now - self.odometry.arrived
            unprocessed = now - (now if self.queue.processed_at is None else self.queue.processed_at)
            newest_ns = self.odometry.newest.stamp_ns if self.odometry.newest else 0
            max_unprocessed = self.config.dead_reckoning_timeout
            if silent > self.config.odometry_timeout:
                self.robot_state.on_silence(self._silence_reason(now), newest_ns)
            elif unprocessed > max_unprocessed:
                self.robot_state.on_silence(f"no usable frame for {max_unprocessed:g} s", newest_ns)
            self._record_state()

    def _silence_reason(self, now: float) -> str:
        """Return why there is no odometry."""
        return f"no odometry for {self.config.odometry_timeout:g} s"

    def on_disconnected(self, now: float) -> None:
        """Note that nothing is connected to the node: a pause of odometry says nothing about the robot then."""
        with self._lock:
            self._disconnected_at = now

    def restart_search(self, reason: str) -> None:
        """Search from nothing in a new epoch: what came before no longer fits. Odometry that has come stays.

        So does what somebody has guessed: the engine, which forgets it, is told again. A circle does not, for it is not
        known how far the robot has come.
        """
        with self._lock:
            self._epoch += 1
            self._guess = self._said = _without_circle(self._said)
            self.robot_state.restart_search(reason)
            self.counters.dropped += len(self._frame_sync)
            self._frame_sync = FrameSync(self.config, self.odometry, self.counters)
            self.queue.begin_epoch(self._epoch)
            self._record_state()

    def relocalize(self) -> None:
        """Search from nothing because a client asks: without the last known pose."""
        with self._lock:
            self._hint.forget()
            self._said = None
            self.restart_search("asked to search again")

    def reset(self) -> None:
        """Forget everything, counters, odometry and the last known pose too."""
        with self._lock:
            self._hint.forget()
            self._guess = self._said = None
            self._clear()

    def hint_pose(self, T_map_body: Pose, calibration: Calibration | None = None) -> None:
        """Hand the engine (4, 4) where the robot may be, as a hypothesis; ignored once the place is known.

        ``calibration``, what was known of its sensor and odometry, goes with it.
        """
        with self._lock:
            if self.robot_state.correction is None and not self._hint.forgotten:
                self._hint.offer(T_map_body, calibration)

    def give_up(self) -> None:
        """Forget everything, for another node goes on with the robot."""
        with self._lock:
            self._hint = PoseHint()
            self._guess = self._said = None
            self._clear()

    def handover(self) -> Handover | None:
        """Return where the robot is, for another node that goes on with it; None while that is not known."""
        with self._lock:
            correction = self.robot_state.correction
            if correction is None or not self.robot_state.state.has_place:
                return None
            return Handover(self.site_sha256, correction.T_map_odom, self.robot_state.calibration)

    def take_over(self, known: Handover) -> bool:
        """Go on with a robot that another node has followed: its place becomes a hypothesis with the next frame.

        Returns False, and does nothing, while no odometry has come.
        """
        with self._lock:
            newest = self.odometry.newest
            if newest is None:
                return False
            self.hint_pose(known.T_map_odom @ newest.T_odom_body, known.calibration)
            return True

    def guess_place(self, guess: PlaceGuess) -> bool:
        """Have the search try a place that somebody names; return False, and do nothing, while a place is known.

        Raises:
            InputError: one of several maps has to be named, and none of that name is there.
        """
        if self.parts is not None:
            part = self.parts.named(guess.map)
            x, y = guess.x + part.shift[0], guess.y + part.shift[1]
            guess = replace(guess, x=x, y=y, map=None, begin=part.begin, end=part.end)
        with self._lock:
            if self.robot_state.correction is not None:
                return False
            self._guess = self._said = guess
            return True

    def begin_beside(self, old: Session) -> None:
        """Begin with the place that the robot's session on another map knows: a hypothesis, to be verified on this one.

        What is corrected of its sensor and odometry comes along, but for the ground, which is the survey's.
        """
        with old._lock:
            known, before = old.robot_state.last_known_pose(old.odometry), old._hint.known
            T_map_body = before if known.T_map_body is None else known.T_map_body
            calibration, forgotten = old.calibration or old._hint.calibration, old._hint.forgotten
            said = old._said if old.parts is None and self.parts is None else None
            with self._lock:  # as other sessions of the robot, which know nothing of each other
                self.odometry.continue_from(old.odometry)
                self._cloud_at = old._cloud_at
        with self._lock:
            self._guess = self._said = _without_circle(said)  # it may be on this map only
            self._hint.forgotten = forgotten
            if T_map_body is not None:
                self._hint.offer(T_map_body, None if calibration is None else replace(calibration, ground=0.0))

    def continue_from(self, old: Session) -> None:
        """Go on where the robot's session on another map stops: its counters, its transitions, its newest pose."""
        with old._lock, self._lock:
            for name, value in vars(old.counters).items():
                setattr(self.counters, name, value)
            self.history = old.history
            self.robot_state.publish_after(old.robot_state)
            self._record_state()

    def engine_restarted(self, engine: str = "track", why: str = "it died") -> None:
        """Note that an engine has forgotten all it knew; only that of ``track`` knew where the robot is."""
        with self._lock:
            self.counters.engine_restarts += 1
            # logged once for all robots
            self.errors.add(f"the {engine} engine is started again: {why}", logged=False)
            if engine == "track":
                self.robot_state.explain_loss(reason := f"the engine was started again: {why}")
                self.restart_search(reason)

    # ---- jobs for the engines; the result or failure of each has to come back before the next one of its kind

    def take_frame(self) -> FrameJob | None:
        """Hand the newest frame to the tracking engine."""
        with self._lock:
            return self.queue.take_frame(
                self.robot_state.requires_verification, self._hint.pending, self._hint.calibration, self._guess
            )

    def take_search_request(self) -> SearchJob | None:
        """Hand the newest keyframe to the search engine."""
        with self._lock:
            return self.queue.take_search_request()

    def take_lidar_frame(self) -> OdometryJob | None:
        """Hand a frame to the odometry engine; None, for the robot sends its odometry."""
        return None

    def has_job(self, engine: str) -> bool:
        """Whether there is a job for ``track``, ``search`` or ``odometry``; without the lock: perhaps no more."""
        if engine == "track":
            return self.queue.has_frame
        return engine == "search" and self.search_demand is not None

    @property
    def search_demand(self) -> SearchDemand | None:
        """Demand for a search, as :attr:`EngineQueue.search_demand`; without the lock."""
        return self.queue.search_demand

    def handle_result(self, job: Job, result: Result, now: float) -> None:
        """Apply the result of a job at local time ``now``: a fix at once, that of a search with the next frame."""
        with self._lock:
            if isinstance(job, FrameJob) and isinstance(result, FrameResult):
                frame = self.queue.frame_done(job, result, now)
                if frame is not None:
                    self._hint.delivered(frame.job.hint)
                    if frame.job.guess is self._guess:
                        self._guess = None
                    self.robot_state.add_fix(result.fix, frame, result.events)
                    if self.robot_state.correction is not None:
                        self._said = None
                    self._record_state()
            elif isinstance(job, SearchJob) and isinstance(result, SearchResult):
                self.queue.search_done(job, result, now)

    def handle_failure(self, job: Job, reason: str, rejected: bool = False) -> None:
        """Count a job without a result; unless it was ``rejected``, its engine has forgotten the robot."""
        with self._lock:
            if isinstance(job, FrameJob):
                if self.queue.frame_failed(job, reason, rejected) and not rejected:
                    if job.hint is not None:
                        self._hint.drop()  # it may be the reason
                    self.restart_search("the engine failed on a frame")
            elif isinstance(job, SearchJob):
                self.queue.search_failed(job, reason)

    # ---- what is published

    def pose(self) -> PoseMessage | None:
        """Newest odometry corrected by the newest fix, with that odometry's stamp; None unless TRACKING.

        Of several maps it is in the frame of the one that the robot is on, whose name is its ``frame_id``.
        """
        with self._lock:
            pose = self.robot_state.pose(self.odometry)
        if pose is None or self.parts is None:
            return pose
        part = self.parts.at(pose.T_map_body[:3, 3])
        T_map_odom = None if pose.T_map_odom is None else part.own(pose.T_map_odom)
        return replace(pose, T_map_body=part.own(pose.T_map_body), T_map_odom=T_map_odom, frame_id=part.name)

    def map_name(self) -> str | None:
        """Return which of several maps the robot is on; None while that is not known, and where there is one map."""
        with self._lock:
            correction = self.robot_state.correction
            if self.parts is None or correction is None or not self.robot_state.state.has_place:
                return None
            return self.parts.at(correction.T_map_body[:3, 3]).name

    def state(self) -> tuple[State, str]:
        """Return the state and one clause that gives its reason."""
        with self._lock:
            reason = self.robot_state.reason()
            if reason is None:
                has_odometry = self.odometry_source != "robot" or self.odometry.newest is not None
                reason = status_text(self.keys, self.counters, has_odometry)
            elif self.robot_state.state in _SEARCHING and (missing := self._missing_input()):
                reason = f"{missing}; before: {reason}"
            return self.robot_state.state, reason

    def _missing_input(self) -> str:
        """Return what has not come for a while, and for how long, at the newest tick; empty if nothing is missing."""
        arrived = {"clouds": self._cloud_at}
        if self.odometry_source == "robot":
            arrived["odometry"] = self.odometry.arrived
        silent = {name: self._now - at for name, at in arrived.items() if self._now - at > self.config.max_outage}
        return " and ".join(f"no {name} for {seconds:.0f} s" for name, seconds in silent.items() if seconds < _EVER)

    def hypotheses(self) -> HypothesesMessage | None:
        """Places that the search considers; None while there is a place, and before the first search."""
        with self._lock:
            seen = self.queue.considered
            if seen is None or self.robot_state.state.has_place:
                return None
            stamp_ns = round(seen.stamp * 1e9)
            message = HypothesesMessage(stamp_ns, self.keys.robot, seen.places, seen.none, self.map_sha256)
        if self.parts is None:
            return message
        of = [self.parts.at(place[:3]) for place in message.places]
        places = message.places.copy()
        places[:, :3] -= np.array([part.shift for part in of]).reshape(-1, 3)
        return replace(message, places=places, maps=tuple(part.name for part in of))

    @property
    def calibration(self) -> Calibration | None:
        """What is corrected of the robot's sensor and odometry; None before anything was measured."""
        with self._lock:
            return self.robot_state.calibration

    def age(self) -> float | None:
        """Seconds of sensor time from the newest registration to the newest odometry; None unless TRACKING."""
        with self._lock:
            return self.robot_state.age(self.odometry)

    def confidence(self) -> float | None:
        """Probability that the robot is at the place that it is tracked at; None unless TRACKING."""
        with self._lock:
            correction = self.robot_state.correction
            return None if correction is None else correction.confidence

    def protection_level(self) -> ProtectionLevel | None:
        """Metres and degrees that the newest pose's error exceeds at most once in a thousand; None unless TRACKING."""
        with self._lock:
            return self.robot_state.protection_level(self.odometry)

    def last_known_pose(self) -> LastKnownPose:
        """Return where the robot is, if that is known, for the next start of the node."""
        with self._lock:
            return self.robot_state.last_known_pose(self.odometry)

    def _record_state(self) -> None:
        """Add the state to the history, wherever it may have changed."""
        self.history.add(*self.state(), self.robot_state.last_frame_ns, self.robot_state.evidence)


def _without_circle(said: PlaceGuess | None) -> PlaceGuess | None:
    return None if said is None else replace(said, within=None)
