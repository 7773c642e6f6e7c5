"""What is known of a robot's place, and what can be said of it right now; its session holds the lock."""

# FOLDED coview_stream/stream/node/robot_state.py: """What is known of a robot's place between two lidar frames: a verified correction of its odometry."""
# FOLDED coview_stream/stream/node/robot_state.py: """The newest changes of a robot's state, with what led to each: a status a second would not show them all."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.registration.covariance import propagate, swap_rotation_translation
from coview_stream.localization.result import Fix, KeyframeEvidence, State
from coview_stream.localization.tracking.odometry_noise import Drift
from coview_stream.messages.types import PoseMessage
from coview_stream.odometry.buffer import OdometryBuffer
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.engine_queue import Ready
from coview_stream.stream.node.last_pose import LastKnownPose, PoseHint


class RobotState:
    """State and correction of a robot, from one reset of its session to the next, and the reasons for them.

    Attributes:
        evidence: of the newest keyframe, if there is any in this odometry frame.
        last_frame_ns: stamp of the newest processed frame; None before the first.
        suspect: whether a frame has to verify the place before there is a pose again.
    """

    def __init__(self, robot: str, map_sha256: str, counters: Counters, place: PoseHint) -> None:
        """Know nothing, but keep account of ``place``, which outlives resets."""
        self.robot = robot
        self.map_sha256 = map_sha256
        self._place = place
        self._counters = counters
        self.last_frame_ns: int | None = None
        self._fix_state = State.SEARCHING
        self._doubted = False  # whether the engine's AMBIGUOUS is a doubt of a place that it has found
        self._lost: str | None = None
        self._begun = ""  # why the search began anew
        self._forget_frame()

    def _forget_frame(self) -> None:
        """Forget all that refers to the odometry frame, which is no more."""
        self._place.begin_anew()
        self.evidence: KeyframeEvidence | None = None
        self._correction: OdomCorrection | None = None
        self.suspect = self._doubted = False
        self._trusted_from = -(1 << 63)
        self._published: PoseMessage | None = None
        if self._fix_state is not State.LOST:
            self._fix_state = State.SEARCHING

    @property
    def known(self) -> bool:
        """Whether there is a correction of odometry, and so a pose."""
        return self._correction is not None

    @property
    def found(self) -> bool:
        """Whether the engine has found the place, even if there is no pose because it has to be verified."""
        return self._correction is not None or self._fix_state is State.TRACKING or self._doubted

    @property
    def at_stake(self) -> bool:
        """Whether there is a place that silence would lose."""
        return self.found and self._lost is None

    @property
    def hopeful(self) -> bool:
        """Whether the search has come up with a place that only needs confirmation."""
        return self._fix_state is State.AMBIGUOUS and not self._doubted

    # ---- what happens to it

    def note(self, fix: Fix, ready: Ready, suspected: bool) -> None:
        """Take note of the fix after a frame; ``suspected`` is what its job said."""
        stamp_ns = self.last_frame_ns = ready.job.stamp_ns
        self.evidence = fix.evidence
        if suspected and stamp_ns >= self._trusted_from:
            self.suspect = False
        was, self._fix_state, self._doubted = self._fix_state, fix.state, fix.doubted
        if fix.T_map_odom is None:
            if fix.state is State.LOST and was is not State.LOST:
                self._lose(fix.evidence.reason if fix.evidence else "evidence gone")
            self._correction = None
        elif not self.suspect and stamp_ns >= self._trusted_from:
            self._counters.fixes += self._correction is None
            self._lost = None
            self._correction = OdomCorrection.of(fix, stamp_ns, ready.travelled, ready.turned)
            if fix.T_map_body is not None:
                self._place.seen(fix.T_map_body)

    def begin_anew(self, reason: str) -> None:
        """Know nothing in an odometry frame that is another one."""
        if self.found:
            self._lose(reason)
        self._begun = f"searching anew: {reason}"
        self._forget_frame()

    def doubt(self, from_ns: int) -> None:
        """No pose until a frame stamped ``from_ns`` or later has verified the place."""
        self.suspect = True
        self._trusted_from = max(self._trusted_from, from_ns)
        self._correction = None

    def stop(self, reason: str, newest_ns: int) -> None:
        """Lose the place until a frame from after odometry of ``newest_ns`` has verified it."""
        self.suspect = True
        self._trusted_from = newest_ns + 1
        self._lose(reason)

    def explain(self, reason: str) -> None:
        """Give a newer reason for a loss, if the place is lost: why it does not come back."""
        if self._lost is not None:
            self._lost = reason

    def _lose(self, reason: str) -> None:
        """Give the newest reason, but count once what is lost for two."""
        if self._lost is None:
            self._counters.losses += 1
        self._lost = reason
        self._correction = None

    # ---- what can be said of it

    def state(self, why_nothing: Callable[[], str]) -> tuple[State, str]:
        """Return the state and one clause that gives its reason; ``why_nothing`` knows it before the first frame."""
        evidence = self.evidence.reason if self.evidence else ""
        if self._correction is not None:
            return State.TRACKING, evidence
        if self._lost is not None:
            return State.LOST, self._lost
        if self._fix_state is State.TRACKING:
            return State.AMBIGUOUS, "verifying the place after a pause of odometry"
        if self.last_frame_ns is None:
            return self._fix_state, why_nothing()
        return self._fix_state, evidence or self._begun or "too little has been seen"

    def pose(self, odometry: OdometryBuffer) -> PoseMessage | None:
        """Newest odometry corrected by the newest fix, with that odometry's stamp; None unless TRACKING."""
        if self._correction is None:
            return None
        pose = self._correction.pose(odometry, self.robot, self.map_sha256)
        before = self._published
        if pose is None or (before is not None and pose.stamp_ns < before.stamp_ns):
            return None
        if before is not None and pose.stamp_ns == before.stamp_ns:
            pose = before  # what has been said of a time is not said otherwise later
        self._published = pose
        self._counters.poses += 1
        return pose

    def age(self, odometry: OdometryBuffer) -> float | None:
        """Seconds of sensor time from the newest registration to the newest odometry; None unless TRACKING."""
        newest, known = odometry.newest, self._correction
        return None if newest is None or known is None else known.age(newest.stamp_ns)

    def recall(self, odometry: OdometryBuffer) -> LastKnownPose:
        """Say where the robot is, if that is known, for the next start."""
        forgotten, known = self._place.forgotten, self._correction
        pose = known and known.pose(odometry, self.robot, self.map_sha256)
        return LastKnownPose(forgotten, pose.stamp_ns, pose.T_map_body) if pose else LastKnownPose(forgotten)


_NS = 1_000_000_000


@dataclass(frozen=True)
class OdomCorrection:
    """The newest ``T_map_odom``, and how far odometry had driven when it was right.

    Attributes:
        T_map_odom: (4, 4) map <- odometry, source frame of the map.
        T_map_body: (4, 4) map <- body at the frame that it comes from.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), map axes, at that frame.
        confidence: in [0, 1].
        verified_ns: stamp of the newest registration that spoke for it.
        travelled: metres that odometry had driven at the frame.
        turned: radians that it had turned.
        drift: how fast it seems to drift.
    """

    T_map_odom: Pose
    T_map_body: Pose
    covariance: Floats
    confidence: float
    verified_ns: int
    travelled: float
    turned: float
    drift: Drift

    @classmethod
    def of(cls, fix: Fix, stamp_ns: int, travelled: float, turned: float) -> OdomCorrection:
        """Take over a fix that has a pose; ``stamp_ns`` is its frame's."""
        if fix.T_map_odom is None or fix.T_map_body is None or fix.covariance is None or fix.drift is None:
            raise ValueError("a fix without a pose corrects nothing")
        verified = stamp_ns if fix.evidence is None else min(stamp_ns, round(fix.evidence.stamp * _NS))
        return cls(
            fix.T_map_odom, fix.T_map_body, fix.covariance, fix.confidence, verified, travelled, turned, fix.drift
        )  # fmt: skip

    def age(self, stamp_ns: int) -> float:
        """Seconds of sensor time from the newest registration to ``stamp_ns``."""
        return max(0.0, (stamp_ns - self.verified_ns) / _NS)

    def pose(self, odometry: OdometryBuffer, robot: str, map_sha256: str) -> PoseMessage | None:
        """Newest odometry, corrected, with its own stamp and what it may have drifted meanwhile; None before any."""
        newest = odometry.newest
        if newest is None:
            return None
        driven = max(0.0, odometry.travelled - self.travelled)
        turned = max(0.0, odometry.turned - self.turned)
        T_map_body = self.T_map_odom @ newest.T_odom_body
        shift = T_map_body[:3, 3] - self.T_map_body[:3, 3]
        carried = swap_rotation_translation(propagate(swap_rotation_translation(self.covariance), shift))
        return PoseMessage(
            stamp_ns=newest.stamp_ns,
            robot=robot,
            state=State.TRACKING.value,
            T_map_body=T_map_body,
            covariance=carried + self.drift.reported(driven, turned),
            confidence=self.confidence,
            map_sha256=map_sha256,
            age=self.age(newest.stamp_ns),
        )


_KEPT = 5


@dataclass(frozen=True)
class Transition:
    """One change of state, or LOST for another reason than before: the robot is then searched for otherwise.

    Attributes:
        number: counted from 1 since the session began; a gap tells who listens what was missed.
        stamp_ns: of the robot's newest processed frame, nanoseconds; None before the first.
        before: the state that ended.
        state: the state that began.
        reason: one clause for people.
        evidence: of the newest keyframe, if any.
    """

    number: int
    stamp_ns: int | None
    before: State
    state: State
    reason: str
    evidence: KeyframeEvidence | None

    def to_json(self) -> dict[str, Any]:
        """Plain data for the status."""
        return {
            "number": self.number,
            "stamp_ns": self.stamp_ns,
            "from": self.before.value,
            "to": self.state.value,
            "reason": self.reason,
            "evidence": None if self.evidence is None else self.evidence.to_json(),
        }


class StateHistory:
    """Takes note of states and keeps the newest changes."""

    def __init__(self) -> None:
        self._state = State.SEARCHING
        self._reason = ""
        self._kept: deque[Transition] = deque(maxlen=_KEPT)
        self._count = 0

    def note(
        self, state: State, reason: str, stamp_ns: int | None, evidence: KeyframeEvidence | None
    ) -> None:
        """Take note of the present state; a transition if it is another than before, or lost for another reason."""
        if state is not self._state or (state is State.LOST and reason != self._reason):
            self._count += 1
            change = Transition(self._count, stamp_ns, self._state, state, reason, evidence)
            self._kept.append(change)
            self._state, self._reason = state, reason

    def to_json(self) -> list[dict[str, Any]]:
        """Return the newest ones, oldest first."""
        return [change.to_json() for change in tuple(self._kept)]
