"""One robot's side of the node: what its messages come to, and what can be said of its pose right now.

Pure logic: no thread, no network, no clock. Times called ``now`` are local and monotonic, in seconds; stamps are the
robot's. Every method may be called from any thread.
"""

from __future__ import annotations

import threading

from coview_stream.decision import Verdict
from coview_stream.fix import KeyframeEvidence, State
from coview_stream.geometry import Pose
from coview_stream.stream.codecs import decode_cloud, decode_odometry
from coview_stream.stream.config import NodeConfig
from coview_stream.stream.correction import Correction
from coview_stream.stream.counters import Counters, Latency, Missing
from coview_stream.stream.desk import Desk, Ready
from coview_stream.stream.jobs import FrameJob, FrameResult, SearchJob
from coview_stream.stream.keys import RobotKeys
from coview_stream.stream.last_place import LastPlace, Recollection
from coview_stream.stream.messages import OdometryMessage, PoseMessage, Sample
from coview_stream.stream.odometry import Intake, OdometryBuffer
from coview_stream.stream.pairing import Pairing
from coview_stream.stream.reasons import why_nothing
from coview_stream.stream.reception import Complaints, last_line, note, received, thinned
from coview_stream.stream.transitions import Transitions

_NS = 1_000_000_000


class Session:
    """A robot's odometry, waiting frames, state and counters.

    Attributes:
        keys: where its messages come and go.
        counters: what became of them.
        complaints: about its input, for people.
        transitions: of its state.
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
        self._epoch = 0
        self._desk = Desk(keys.robot, 0)
        self._place = LastPlace()
        self.counters, self.odometry = Counters(), OdometryBuffer(self.config)
        self._pairing = Pairing(self.config, self.odometry, self.counters)
        self._clear()

    def _clear(self) -> None:
        """Forget everything."""
        self.counters = Counters()
        self.complaints = Complaints()
        self.transitions = Transitions()
        self.latency = Latency()
        self.engine_latency = Latency()
        self.odometry = OdometryBuffer(self.config)
        self._pairing, self._desk = (
            Pairing(self.config, self.odometry, self.counters),
            Desk(self.keys.robot, 0),
        )
        self.last_frame_ns: int | None = None
        self.longest_wait = 0.0
        self._missing = Missing()
        self._processed_at: float | None = None
        self._fix_state = State.SEARCHING
        self._lost: str | None = None
        self._unreachable = float("-inf")  # local time at which nobody was connected
        self._begun = ""  # why the search began anew
        self._forget_frame()
        self._first_epoch = self._epoch  # what was under way before is nobody's

    def _forget_frame(self) -> None:
        """Forget all that refers to the odometry frame, which is no more."""
        self.counters.dropped += len(self._pairing) + self._desk.waiting
        self._epoch += 1
        self.evidence: KeyframeEvidence | None = None
        self._pairing = Pairing(self.config, self.odometry, self.counters)
        self._desk = Desk(self.keys.robot, self._epoch)
        self._place.begin_anew()
        self._correction: Correction | None = None
        self._suspect = False
        self._trusted_from = -(1 << 63)
        self._published: PoseMessage | None = None
        if self._fix_state is not State.LOST:
            self._fix_state = State.SEARCHING

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
            self._pairing.add(thinned(message, self.config.max_points), now)
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

    def _continue(self, intake: Intake, message: OdometryMessage) -> None:
        """Draw the consequences of what an odometry sample was."""
        if intake is Intake.DUPLICATE:
            self.counters.odometry_duplicate += 1
        elif intake is Intake.OUT_OF_ORDER:
            self.counters.odometry_out_of_order += 1
        elif intake is Intake.GAP:
            self.counters.odometry_gaps += 1
            if self._correction is None and self._fix_state is not State.TRACKING:
                # frames from before and after the pause must not be searched for as one place
                self.begin_anew("odometry paused")
            else:
                self._doubt(message.stamp_ns)
        elif intake is Intake.OUTAGE:
            self.counters.odometry_gaps += 1
            self.begin_anew("odometry was away for too long")
        elif intake is Intake.JUMP:
            self.counters.odometry_jumps += 1
            self.begin_anew("odometry jumped")
        elif intake is Intake.RESTART:
            self.counters.clock_restarts += 1
            self.begin_anew("the sender's clock started anew")

    def unreachable(self, now: float) -> None:
        """Take note that nobody is connected to the node: that odometry pauses says nothing of the robot then."""
        with self._lock:
            self._unreachable = now

    def _doubt(self, from_ns: int) -> None:
        """No pose until a frame stamped ``from_ns`` or later has verified the place."""
        self._suspect = True
        self._trusted_from = max(self._trusted_from, from_ns)
        self._correction = None

    def begin_anew(self, reason: str) -> None:
        """Search from nothing, because what came before no longer fits. Odometry that has come stays."""
        with self._lock:
            if self._correction is not None or self._fix_state is State.TRACKING:
                self._lose(reason)
            self._begun = f"searching anew: {reason}"
            self._forget_frame()
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
            if self._correction is None and not self._place.forgotten:
                self._place.suggest(T_map_body)

    def recall(self) -> Recollection:
        """Say where the robot is, if that is known, for the next start."""
        with self._lock:
            forgotten, known = self._place.forgotten, self._correction
            pose = known and known.pose(self.odometry, self.keys.robot, self.map_sha256)
            return (
                Recollection(forgotten, pose.stamp_ns, pose.T_map_body) if pose else Recollection(forgotten)
            )

    def _lose(self, reason: str) -> None:
        if self._lost is None:
            self.counters.losses += 1
        self._lost = reason
        self._correction = None

    def _pair(self, now: float) -> None:
        """Make the newest frame ready whose odometry is there."""
        for frame in self._pairing.paired(now):
            driven = self._driven_at(frame.message.stamp_ns)
            self.counters.dropped += self._desk.put_frame(frame, now, *driven)

    def _driven_at(self, stamp_ns: int) -> tuple[float, float]:
        """Metres driven and radians turned when the frame was taken, which may be a while ago."""
        driven, turned = self.odometry.driven_since(stamp_ns)
        return self.odometry.travelled - driven, self.odometry.turned - turned

    # ---- the engine's work

    def take_frame(self) -> FrameJob | None:
        """Hand the newest ready frame to the engine; its result or failure must be reported before the next one."""
        with self._lock:
            return self._desk.take_frame(self._suspect, self._place.due)

    def take_search(self) -> SearchJob | None:
        """Hand the newest keyframe to the search; its verdict or failure must be reported before the next one."""
        with self._lock:
            return self._desk.take_search()

    def hopeful(self) -> bool:
        """Whether a place has been found that only needs confirmation."""
        return self._fix_state is State.AMBIGUOUS

    def frame_done(self, job: FrameJob, result: FrameResult, now: float) -> None:
        """Take note of the fix after a frame."""
        with self._lock:
            if job.epoch < self._first_epoch:
                return
            self.counters.processed += 1
            self._processed_at = now
            self.engine_latency.add(result.seconds)
            busy = self._desk.frame_over() if job.epoch == self._epoch else None
            if busy is not None:
                self.latency.add(now - busy.received)
                self.longest_wait = max(self.longest_wait, now - busy.since)
                self._place.told(job.suggested)
                self._note(result, busy, job.suspect)
                self._look()

    def frame_failed(self, job: FrameJob, reason: str, rejected: bool) -> None:
        """Take note that the engine could not use a frame (``rejected``) or failed and has forgotten the robot."""
        with self._lock:
            if job.epoch < self._first_epoch:
                return
            self.counters.count("rejected" if rejected else "engine_errors")
            kind = "frames of no use" if rejected else "frames that the engine failed at"
            self.complaints.add_first(f"{self.keys.robot}: {kind}", last_line(reason))
            if job.epoch == self._epoch:
                self._desk.frame_over(unused=job.verdict)
                if not rejected:
                    if job.suggested is not None:
                        self._place.drop()  # for it may be the reason
                    self.begin_anew("the engine failed on a frame")

    def search_done(self, job: SearchJob, verdict: Verdict | None) -> None:
        """Take note of a verdict; None if the search failed, which costs this keyframe's vote only."""
        with self._lock:
            if job.epoch < self._first_epoch:
                return
            self.counters.searches += 1
            if job.epoch == self._epoch:
                self._desk.search_over(verdict)

    def search_failed(self, job: SearchJob, reason: str) -> None:
        """Take note that the search engine failed, which costs this keyframe's vote only."""
        with self._lock:
            self.counters.search_errors += 1
            self.complaints.add_first(f"{self.keys.robot}: failed searches", last_line(reason))
            if job.epoch == self._epoch:
                self._desk.search_over(None)

    def engine_restarted(self, kind: str = "track") -> None:
        """Take note that an engine has forgotten all it knew; only that of ``track`` knew where the robot is."""
        with self._lock:
            self.counters.engine_restarts += 1
            if kind == "track":
                self.begin_anew("the engine was started again")

    def _note(self, result: FrameResult, ready: Ready, suspected: bool) -> None:
        fix, job = result.fix, ready.job
        self.last_frame_ns = job.stamp_ns
        self.evidence = fix.evidence
        if result.query is not None:
            self.counters.searches_skipped += self._desk.put_query(result.query)
        if suspected and job.stamp_ns >= self._trusted_from:
            self._suspect = False
        was, self._fix_state = self._fix_state, fix.state
        if fix.T_map_odom is None:
            if fix.state is State.LOST and was is not State.LOST and self._lost is None:
                self._lose(fix.evidence.reason if fix.evidence else "evidence gone")
            self._correction = None
        elif not self._suspect and job.stamp_ns >= self._trusted_from:
            self.counters.fixes += self._correction is None
            self._lost = None
            self._correction = Correction.of(fix, job.stamp_ns, ready.travelled, ready.turned)
            if fix.T_map_body is not None:
                self._place.seen(fix.T_map_body)

    # ---- what goes out

    def tick(self, now: float) -> None:
        """Let time pass: frames and odometry that do not come have consequences."""
        with self._lock:
            self._pair(now)
            if self._correction is None:
                return
            silent = now - self.odometry.arrived
            unseen = now - (self._processed_at if self._processed_at is not None else now)
            if silent > self.config.odometry_timeout:
                self._stop(self._silence(now))
            elif unseen > self.config.coast:
                self._stop(f"no usable frame for {self.config.coast:g} s")
            self._look()

    def _silence(self, now: float) -> str:
        """Why there is no pose without odometry."""
        return f"no odometry for {self.config.odometry_timeout:g} s"

    def _stop(self, reason: str) -> None:
        self._suspect = True
        self._trusted_from = (self.odometry.newest.stamp_ns if self.odometry.newest else 0) + 1
        self._lose(reason)

    def pose(self) -> PoseMessage | None:
        """Newest odometry corrected by the newest fix, with that odometry's stamp; None unless TRACKING."""
        with self._lock:
            if self._correction is None:
                return None
            pose = self._correction.pose(self.odometry, self.keys.robot, self.map_sha256)
            before = self._published
            if pose is None or (before is not None and pose.stamp_ns < before.stamp_ns):
                return None
            if before is not None and pose.stamp_ns == before.stamp_ns:
                pose = before  # what has been said of a time is not said otherwise later
            self._published = pose
            self.counters.poses += 1
            return pose

    def state(self) -> tuple[State, str]:
        """Return the state and one clause that gives its reason."""
        with self._lock:
            evidence = self.evidence.reason if self.evidence else ""
            if self._correction is not None:
                return State.TRACKING, evidence
            if self._lost is not None:
                return State.LOST, self._lost
            if self._fix_state is State.TRACKING:
                return State.AMBIGUOUS, "verifying the place after a pause of odometry"
            if self.last_frame_ns is None:
                has_odometry = self.odometry_source != "robot" or self.odometry.newest is not None
                return self._fix_state, why_nothing(self.keys, self.counters, has_odometry)
            return self._fix_state, evidence or self._begun or "too little has been seen"

    def _look(self) -> None:
        """Take note of the state, wherever it may have changed."""
        self.transitions.note(*self.state(), self.last_frame_ns, self.evidence)

    def age(self) -> float | None:
        """Seconds of sensor time from the newest registration to the newest odometry; None unless TRACKING."""
        with self._lock:
            newest, known = self.odometry.newest, self._correction
            return None if newest is None or known is None else known.age(newest.stamp_ns)
