"""One robot's side of the node: what its messages come to, and what the engines make of them.

Pure logic: no thread, no network, no clock. Times called ``now`` are local and monotonic, in seconds; stamps are the
robot's. Every method may be called from any thread.
"""

# FOLDED coview_stream/stream/node/session.py: """Why nothing is known yet, or not any more, in clauses for people."""

from __future__ import annotations

import threading
from itertools import count

from coview_stream.config.node import NodeConfig
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.result import State
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.messages import decode_cloud, decode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, PoseMessage, Sample
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters, Missing
from coview_stream.stream.node.decoding import ErrorLog, note, received, voxelized_cloud
from coview_stream.stream.node.engine_queue import Work
from coview_stream.stream.node.frame_sync import FrameSync
from coview_stream.stream.node.jobs import FrameJob, FrameResult, SearchJob
from coview_stream.stream.node.last_pose import LastKnownPose, PoseHint
from coview_stream.stream.node.robot_state import RobotState, StateHistory
from coview_stream.stream.transport.keys import RobotKeys


class Session:
    """A robot's odometry, its work for the engines and what is known of its place, behind one lock.

    Attributes:
        keys: where its messages come and go.
        counters: what became of them.
        complaints: about its input, for people.
        transitions: of its state.
        odometry: the newest of it.
        work: frames and queries for the engines, and how long they took.
        whereabouts: what is known of its place.
        odometry_source: who makes the odometry: ``robot``, or what does so here.
    """

    odometry_source = "robot"

    def __init__(
        self,
        keys: RobotKeys,
        map_sha256: str,
        config: NodeConfig | None = None,
        options: tuple[str | None, str | None] = (None, None),
    ) -> None:
        """Begin to know nothing; ``options`` force the codecs of clouds and odometry."""
        self.keys = keys
        self.map_sha256 = map_sha256
        self.config = config or NodeConfig()
        self.options = options
        self._lock = threading.RLock()
        self._epochs = count(1)
        self._place = PoseHint()
        self._clear()

    def _clear(self) -> None:
        """Forget everything."""
        self.counters = Counters()
        self.complaints = ErrorLog()
        self.transitions = StateHistory()
        self.odometry = OdometryBuffer(self.config)
        self._pairing = FrameSync(self.config, self.odometry, self.counters)
        self.work = Work(self.keys.robot, self._epochs, self.counters, self.complaints)
        self.whereabouts = RobotState(self.keys.robot, self.map_sha256, self.counters, self._place)
        self._missing = Missing()
        self._unreachable = float("-inf")  # local time at which nobody was connected

    # ---- what comes in

    def on_cloud(self, sample: Sample, now: float) -> None:
        """Take in a cloud: decode, check, pair with odometry. Never raises for what the sample holds."""
        limit, hint = self.config.max_payload, self.keys.cloud_hint
        message, name, reason = received(sample, decode_cloud, self.options[0], hint, limit)
        with self._lock:
            self.counters.received += 1
            if message is None:
                note(self.counters, self.complaints, "", name, sample.key, reason)
                return
            self.counters.missing += self._missing.after(message.stamp_ns, message.sequence)
            self._take_in(voxelized_cloud(message, self.config.max_points), now)

    def _take_in(self, message: CloudMessage, now: float) -> None:
        """Pair a cloud with the odometry that there is, or wait for it."""
        self._pairing.add(message, now)
        self._pair(now)

    def on_odometry(self, sample: Sample, now: float) -> None:
        """Take in an odometry sample. Never raises for what the sample holds."""
        limit, hint = self.config.max_payload, self.keys.odometry_hint
        message, name, reason = received(sample, decode_odometry, self.options[1], hint, limit)
        with self._lock:
            self.counters.odometry_received += 1
            if message is None:
                note(self.counters, self.complaints, "odometry_", name, sample.key, reason)
                return
            unreachable = self._unreachable > self.odometry.arrived
            self._continue(self.odometry.add(message, now, unreachable), message)
            self._pair(now)
            self._look()

    def _continue(self, intake: SampleKind, message: OdometryMessage) -> None:
        """Draw the consequences of what an odometry sample was."""
        if intake in COUNTED_AS:
            self.counters.count(COUNTED_AS[intake])
        if intake is SampleKind.GAP and self.whereabouts.found:
            self.whereabouts.doubt(message.stamp_ns)
        elif intake in WHY_ANEW:
            self.begin_anew(WHY_ANEW[intake])

    def unreachable(self, now: float) -> None:
        """Take note that nobody is connected to the node: that odometry pauses says nothing of the robot then."""
        with self._lock:
            self._unreachable = now

    def begin_anew(self, reason: str) -> None:
        """Search from nothing, because what came before no longer fits. Odometry that has come stays."""
        with self._lock:
            self.whereabouts.begin_anew(reason)
            self.counters.dropped += len(self._pairing)
            self._pairing = FrameSync(self.config, self.odometry, self.counters)
            self.work.begin_anew()
            self._look()

    def relocalize(self) -> None:
        """Search from nothing because somebody asks: not even where the robot was last known to be."""
        with self._lock:
            self._place.forget()
            self.begin_anew("asked to search again")

    def reset(self) -> None:
        """Forget everything, counters and odometry too, and where the robot was last known to be."""
        with self._lock:
            self._place.forget()
            self._clear()

    def suggest(self, T_map_body: Pose) -> None:
        """Hand the engine (4, 4) where the robot may be, as a hypothesis; ignored once something better is known."""
        with self._lock:
            if not self.whereabouts.known and not self._place.forgotten:
                self._place.suggest(T_map_body)

    def tick(self, now: float) -> None:
        """Let time pass: frames and odometry that do not come have consequences."""
        with self._lock:
            self._pair(now)
            if not self.whereabouts.at_stake:
                return
            silent = now - self.odometry.arrived
            unseen = now - (now if self.work.processed_at is None else self.work.processed_at)
            newest_ns = self.odometry.newest.stamp_ns if self.odometry.newest else 0
            if silent > self.config.odometry_timeout:
                self.whereabouts.stop(self._silence(now), newest_ns)
            elif unseen > self.config.dead_reckoning_timeout:
                self.whereabouts.stop(f"no usable frame for {self.config.dead_reckoning_timeout:g} s", newest_ns)
            self._look()

    def _silence(self, now: float) -> str:
        """Why there is no pose without odometry."""
        return f"no odometry for {self.config.odometry_timeout:g} s"

    def _pair(self, now: float) -> None:
        """Make the newest frame ready whose odometry is there."""
        for frame in self._pairing.paired(now):
            driven, turned = self.odometry.driven_since(frame.message.stamp_ns)  # which may be a while ago
            then = self.odometry.travelled - driven, self.odometry.turned - turned
            self.counters.dropped += self.work.desk.put_frame(frame, now, *then)

    # ---- the engine's work

    def take_frame(self) -> FrameJob | None:
        """Hand the newest ready frame to the engine; its result or failure must be reported before the next one."""
        with self._lock:
            return self.work.desk.take_frame(self.whereabouts.suspect, self._place.due)

    def take_search(self) -> SearchJob | None:
        """Hand the newest keyframe to the search; its verdict or failure must be reported before the next one."""
        with self._lock:
            return self.work.desk.take_search()

    def hopeful(self) -> bool:
        """Whether the search has come up with a place that only needs confirmation."""
        return self.whereabouts.hopeful

    def frame_done(self, job: FrameJob, result: FrameResult, now: float) -> None:
        """Take note of the fix after a frame."""
        with self._lock:
            busy = self.work.frame_done(job, result, now)
            if busy is not None:
                self._place.told(job.suggested)
                self.whereabouts.note(result.fix, busy, job.suspect)
                self._look()

    def frame_failed(self, job: FrameJob, reason: str, rejected: bool) -> None:
        """Take note that the engine could not use a frame (``rejected``) or failed and has forgotten the robot."""
        with self._lock:
            if self.work.frame_failed(job, reason, rejected) and not rejected:
                if job.suggested is not None:
                    self._place.drop()  # for it may be the reason
                self.begin_anew("the engine failed on a frame")

    def search_done(self, job: SearchJob, verdict: SearchResult | None) -> None:
        """Take note of a verdict; None if the search failed, which costs this keyframe's vote only."""
        with self._lock:
            self.work.search_done(job, verdict)

    def search_failed(self, job: SearchJob, reason: str) -> None:
        """Take note that the search engine failed, which costs this keyframe's vote only."""
        with self._lock:
            self.work.search_failed(job, reason)

    def engine_restarted(self, kind: str = "track", why: str = "it died") -> None:
        """Take note that an engine has forgotten all it knew; only that of ``track`` knew where the robot is."""
        with self._lock:
            self.counters.engine_restarts += 1
            self.complaints.add(
                f"the {kind} engine is started again: {why}", logged=False
            )  # once for all robots
            if kind == "track":
                self.whereabouts.explain(reason := f"the engine was started again: {why}")
                self.begin_anew(reason)

    # ---- what goes out

    def pose(self) -> PoseMessage | None:
        """Newest odometry corrected by the newest fix, with that odometry's stamp; None unless TRACKING."""
        with self._lock:
            return self.whereabouts.pose(self.odometry)

    def state(self) -> tuple[State, str]:
        """Return the state and one clause that gives its reason."""
        with self._lock:
            has_odometry = self.odometry_source != "robot" or self.odometry.newest is not None
            return self.whereabouts.state(lambda: status_text(self.keys, self.counters, has_odometry))

    def age(self) -> float | None:
        """Seconds of sensor time from the newest registration to the newest odometry; None unless TRACKING."""
        with self._lock:
            return self.whereabouts.age(self.odometry)

    def recall(self) -> LastKnownPose:
        """Say where the robot is, if that is known, for the next start."""
        with self._lock:
            return self.whereabouts.recall(self.odometry)

    def _look(self) -> None:
        """Take note of the state, wherever it may have changed."""
        known = self.whereabouts
        self.transitions.note(*self.state(), known.last_frame_ns, known.evidence)


COUNTED_AS = {
    SampleKind.GAP: "odometry_gaps",
    SampleKind.OUTAGE: "odometry_gaps",
    SampleKind.JUMP: "odometry_jumps",
    SampleKind.RESTART: "clock_restarts",
    SampleKind.DUPLICATE: "odometry_duplicate",
    SampleKind.OUT_OF_ORDER: "odometry_out_of_order",
}
"""Counter of an odometry sample that does not just continue."""

WHY_ANEW = {
    # frames from before and after a pause must not be searched for as one place
    SampleKind.GAP: "odometry paused",
    SampleKind.OUTAGE: "odometry was away for too long",
    SampleKind.JUMP: "odometry jumped",
    SampleKind.RESTART: "the sender's clock started anew",
}
"""Why the search begins anew with such a sample; after a gap only where no place is known that could be verified."""


def status_text(keys: RobotKeys, counted: Counters, has_odometry: bool) -> str:
    """Say what a robot that has not had one frame processed is waiting for."""
    unread = counted.malformed + counted.oversized + counted.unknown_encoding
    if not counted.received:
        return f"waiting for clouds on {keys.cloud}"
    if counted.received == unread:
        return "not one cloud could be read; see errors"
    if not has_odometry and counted.odometry_received:
        return "not one odometry sample could be read; see errors"
    if not has_odometry:
        return f"waiting for odometry on {keys.odometry}"
    if counted.engine_errors:
        return f"frames at which the engine failed: {counted.engine_errors}; see errors"
    if counted.rejected:
        return f"{counted.rejected} frames were of no use; see errors"
    if counted.late or counted.no_odometry:
        return "odometry and clouds have no common stamps: are both of one clock?"
    return "no frame has been processed yet"
