"""One robot's session: carries its messages to the engines, and derives its state from the engines' results.

Pure logic: no thread, no network, no clock. Times called ``now`` are local and monotonic, in seconds; stamps are the
robot's. Every method may be called from any thread.
"""

from __future__ import annotations

import threading
from dataclasses import replace

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.map_parts import MapParts
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import InputError, MessageError
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.hints import PlaceGuess, require_ground
from coview_stream.localization.state import State
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.stream.node.counters import Counters, ErrorLog
from coview_stream.stream.node.engine_queue import (
    EngineQueue,
    FrameJob,
    FrameResult,
    Job,
    PlaceHints,
    Result,
    SearchJob,
)
from coview_stream.stream.node.inputs import Break, Inputs, LidarInputs, OdometryJob, OdometryResult
from coview_stream.stream.node.last_place import LastPlace
from coview_stream.stream.node.robot_state import RobotState, StateHistory
from coview_stream.stream.transport.keys import RobotKeys


class Session:
    """A robot's inputs, its queue to the engines and its state, behind one lock.

    Args:
        codecs: for clouds and odometry; they override the messages' own encodings.
        parts: the maps joined in this map; None for a single map.
        lidar: how odometry is computed from the clouds; None if the robot sends it.
        site_sha256: hash of the site's state, common to all its parts; None: the map is a single file.
        base_map: refuses guesses where it has no ground; None refuses none.
    """

    def __init__(
        self, keys: RobotKeys, map_sha256: str, config: NodeConfig | None = None,
        codecs: tuple[str | None, str | None] = (None, None), parts: MapParts | None = None,
        lidar: LidarOdometryConfig | None = None, site_sha256: str | None = None, base_map: BaseMap | None = None,
    ) -> None:  # fmt: skip
        self.keys = keys
        self.map_sha256, self.site_sha256 = map_sha256, site_sha256 or map_sha256
        self.config = config or NodeConfig()
        self.parts = parts
        self.lock = threading.RLock()  # held to read several attributes together
        self._codecs = codecs
        self._lidar = lidar
        self._base_map = base_map
        self._epoch = 0  # id of the odometry frame, counted through all resets
        self.reset(forget=False)

    # ---- messages

    def on_cloud(self, sample: Sample, now: float) -> None:
        """Decode a cloud, pair it with odometry and queue it. The sample's content never raises."""
        try:
            message = self.inputs.decode_cloud(sample)
        except MessageError as error:
            with self.lock:
                self.inputs.count_undecodable(error, sample.key)
        else:
            with self.lock:
                self._proceed(self.inputs.note_mount(sample.mount), now)
                self._proceed(self.inputs.add_cloud(message, now), now)

    def on_odometry(self, sample: Sample, now: float) -> None:
        """Add an odometry sample. The sample's content never raises."""
        try:
            message = self.inputs.decode_odometry(sample)
        except MessageError as error:
            with self.lock:
                self.inputs.count_undecodable(error, sample.key, "odometry_")
        else:
            with self.lock:
                self._proceed(self.inputs.add_odometry(message, now), now)
                self._record_state()

    def _proceed(self, interruption: Break | None, now: float) -> None:
        """Verify the place, or restart the search, after an interruption of odometry; queue frames with odometry."""
        if interruption is not None:
            if interruption.verify_from_ns is not None and self.robot_state.engine_has_place:
                self.robot_state.require_verification(interruption.verify_from_ns)
            else:
                self.restart_search(interruption.reason)
        for frame in self.inputs.take_paired(now):
            self.queue.put_frame(frame, now)

    # ---- time and other events

    def tick(self, now: float) -> None:
        """Advance time: without frames or odometry the place is lost."""
        with self.lock:
            self._now = now
            self._proceed(None, now)
            if not self.robot_state.state.has_place:
                if repeating := self.inputs.repeating(now):
                    self.robot_state.explain_loss(repeating)
                return
            odometry, processed_at = self.inputs.odometry, self.queue.processed_at
            newest_ns = odometry.newest.stamp_ns if odometry.newest else 0
            timeout = self.config.dead_reckoning_timeout
            if now - odometry.arrived > self.config.odometry_timeout:
                self.robot_state.on_silence(self.inputs.silence_reason(now), newest_ns)
            elif processed_at is not None and now - processed_at > timeout:
                reason = self.inputs.repeating(now) or f"no usable frame for {timeout:g} s"
                self.robot_state.on_silence(reason, newest_ns)
            self._record_state()

    def restart_search(self, reason: str, forget: bool = False) -> None:
        """Restart the search in a new epoch; odometry stays. ``forget``: a client says that the place is wrong."""
        with self.lock:
            if forget:
                self.hints.forget()
            self._epoch += 1
            self.robot_state.restart_search(reason)
            self.inputs.drop_frames()
            self.queue.begin_epoch(self._epoch)
            self._record_state()

    def reset(self, forget: bool = True) -> None:
        """Forget all but the map. ``forget``: a client asked for it; then :meth:`offer` refuses earlier places."""
        with self.lock:
            if forget:
                self.hints.forget()
            else:
                self.hints: PlaceHints = PlaceHints()
            self._epoch += 1
            self._now = float("-inf")  # local time of the newest tick
            self.counters, self.errors, self.history = Counters(), ErrorLog(), StateHistory()
            given = (self.keys, self.config, self._codecs, self.counters, self.errors)
            # computes odometry from the clouds; None if the robot sends it
            self._odometry = None if self._lidar is None else LidarInputs(*given, self._lidar, self._epoch)
            self.inputs: Inputs = self._odometry or Inputs(*given)
            self.queue = EngineQueue(self.keys.robot, self._epoch, self.counters, self.errors)
            self.robot_state: RobotState = RobotState(self.keys.robot, self.map_sha256, self.counters, self.hints)

    def offer(self, place: LastPlace) -> bool:
        """Offer the engine an earlier place as a hypothesis; no effect once the place is known or was forgotten.

        Returns False, and does nothing, while the place needs odometry that has not come yet.
        """
        with self.lock:
            T_map_body, newest = place.T_map_body, self.inputs.odometry.newest
            if T_map_body is None and place.T_map_odom is not None and newest is not None:
                T_map_body = place.T_map_odom @ newest.T_odom_body
            if T_map_body is None:
                return False
            if self.robot_state.correction is None and not self.hints.forgotten:
                self.hints.offer(T_map_body, place.calibration)
            return True

    def guess_place(self, guess: PlaceGuess) -> bool:
        """Let the search try a guess; return False, and do nothing, while a place is known.

        InputError: the guess names none of several maps; it names another map than the single one; or the map has no
        ground there.
        """
        if self.parts is not None:
            part = self.parts.named(guess.map)
            x, y = guess.x + part.shift[0], guess.y + part.shift[1]
            guess = replace(guess, x=x, y=y, map=None, begin=part.begin, end=part.end)
        elif guess.map not in (None, "map"):
            raise InputError(f"initial pose: it is in frame {guess.map!r}; give it in 'map', or name none")
        if self._base_map is not None:
            require_ground(guess, self._base_map)
        with self.lock:
            if self.robot_state.correction is not None:
                return False
            self.hints.offer_guess(guess)
            return True

    def begin_beside(self, old: Session) -> None:
        """Start from the place of the robot's session on another map: a hypothesis, to be verified on this one.

        The calibration of sensor and odometry carries over, except for the ground, which belongs to the survey.
        """
        with old.lock:
            pose = old.robot_state.newest_pose(old.inputs.odometry)
            T_map_body = old.hints.T_map_body if pose is None else pose.T_map_body
            calibration, forgotten = old.robot_state.calibration or old.hints.calibration, old.hints.forgotten
            guess = old.hints.guess if old.parts is None and self.parts is None else None
            with self.lock:  # under both locks, the old session's first, as in continue_from
                self.inputs.continue_from(old.inputs)
        with self.lock:
            # without its circle, which belongs to the old map
            self.hints.offer_guess(None if guess is None else replace(guess, within=None))
            self.hints.forgotten = forgotten
            if T_map_body is not None:
                self.hints.offer(T_map_body, None if calibration is None else replace(calibration, ground=0.0))

    def continue_from(self, old: Session) -> None:
        """Continue where the robot's session on another map stops: its counters, transitions and newest pose."""
        with old.lock, self.lock:
            vars(self.counters).update(vars(old.counters))
            self.history = old.history
            self.robot_state.publish_after(old.robot_state)
            self._record_state()

    # ---- the engines; a job's result or failure must come back before the next job of its kind is taken

    def has_job(self, engine: str) -> bool:
        """Whether ``track``, ``search`` or ``odometry`` has a job; read without the lock, so it may be gone."""
        if engine == "track":
            return self.queue.has_frame
        if engine == "odometry":
            return self._odometry is not None and self._odometry.has_job
        return self.queue.search_demand is not None

    def take_job(self, engine: str) -> Job | None:
        """Hand the newest frame or keyframe to ``track`` or ``search``, the oldest frame to ``odometry``."""
        with self.lock:
            if engine == "track":
                return self.queue.take_frame(self.robot_state.requires_verification, self.hints)
            if engine == "odometry":
                return None if self._odometry is None else self._odometry.take_job()
            return self.queue.take_search_request()

    def handle_result(self, job: Job, result: Result, now: float) -> None:
        """Apply a job's result at local time ``now``: a fix at once, a search result with the next frame."""
        with self.lock:
            if isinstance(job, FrameJob) and isinstance(result, FrameResult):
                frame = self.queue.frame_done(job, result, now)
                if frame is not None:
                    self.hints.delivered(frame.job.hint, frame.job.guess)
                    self.robot_state.add_fix(result.fix, frame, result.events)
                    self._record_state()
            elif isinstance(job, SearchJob) and isinstance(result, SearchResult):
                self.queue.search_done(job, result, now)
            elif isinstance(job, OdometryJob) and isinstance(result, OdometryResult) and self._odometry is not None:
                for interruption in self._odometry.job_done(job, result, now):
                    self._proceed(interruption, now)
                self._proceed(None, now)
                self._record_state()

    def note_doubt(self, job: Job) -> None:
        """Withhold poses until the result of a job comes: its frame contradicts the place."""
        with self.lock:
            self.queue.note_doubt(job)

    def handle_failure(self, job: Job, reason: str, rejected: bool = False) -> None:
        """Count a job without a result; unless it was ``rejected``, its engine has forgotten the robot."""
        with self.lock:
            if isinstance(job, FrameJob):
                if self.queue.frame_failed(job, reason, rejected) and not rejected:
                    if job.hint is not None:
                        self.hints.drop()  # it may be the cause
                    self.restart_search("the engine failed on a frame")
            elif isinstance(job, SearchJob):
                self.queue.search_failed(job, reason)
            elif self._odometry is not None and (interruption := self._odometry.job_failed(job, reason, rejected)):
                self.restart_search(interruption.reason)

    def engine_restarted(self, engine: str = "track", why: str = "it died") -> None:
        """Note that an engine has forgotten everything: ``track`` the place, ``odometry`` the path driven."""
        with self.lock:
            self.counters.engine_restarts += 1
            # logged once for all robots
            self.errors.add(f"the {engine} engine is started again: {why}", logged=False)
            if engine == "track":
                reason = f"the engine was started again: {why}"
                self.robot_state.explain_loss(reason)
                self.restart_search(reason)
            elif self._odometry is not None and engine == "odometry":
                again = self._odometry.restart_odometry(f"lidar odometry was started again: {why}")
                self.restart_search(again.reason)

    # ---- published

    def pose(self) -> PoseMessage | None:
        """Return the newest odometry corrected by the newest fix, with the odometry's stamp; None unless TRACKING.

        Also None while a frame that contradicts the place is processed: other places are tried for up to a second. With
        several maps the pose is in the frame of the robot's map, whose name is its ``frame_id``.
        """
        with self.lock:
            pose = None if self.queue.in_doubt else self.robot_state.pose(self.inputs.odometry)
        if pose is None or self.parts is None:
            return pose
        part = self.parts.at(pose.T_map_body[:3, 3])
        T_map_odom = None if pose.T_map_odom is None else part.own(pose.T_map_odom)
        return replace(pose, T_map_body=part.own(pose.T_map_body), T_map_odom=T_map_odom, frame_id=part.name)

    def state(self) -> tuple[State, str]:
        """Return the state and its reason in one clause."""
        with self.lock:
            state, reason = self.robot_state.state, self.robot_state.reason(self.queue.pending_search(self._now))
            if reason is None:
                reason = self.inputs.waiting_for()
            elif not state.has_place:
                now = self.inputs.silent(self._now) or self.robot_state.searched()
                if now and now.partition(" for ")[0] == reason.partition(" for ")[0]:
                    reason = now  # of the same input, still silent
                elif now:
                    reason = f"{now}; before: {reason}"
            return state, reason

    def last_place(self) -> LastPlace | None:
        """Return the robot's place, for the next start or another node; None unless TRACKING."""
        with self.lock:
            pose = self.robot_state.newest_pose(self.inputs.odometry)
            if pose is None:
                return None
            calibration = self.robot_state.calibration
            return LastPlace(self.site_sha256, pose.stamp_ns, pose.T_map_body, pose.T_map_odom, calibration)

    def _record_state(self) -> None:
        """Add the state to the history where it may have changed; once the robot is found, earlier errors are over."""
        state, reason = self.robot_state.state, self.robot_state.reason() or self.inputs.waiting_for()
        changed = self.history.add(state, reason, self.robot_state.last_frame_ns, self.robot_state.evidence)
        if changed and state is State.TRACKING:
            self.errors.clear()
