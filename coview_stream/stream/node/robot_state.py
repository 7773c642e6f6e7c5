"""State of one robot as its node publishes it: the engine's, or LOST or DOUBTED where the session withholds poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.state import Event, State
from coview_stream.messages.types import PoseMessage
from coview_stream.odometry.buffer import OdometryBuffer
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.engine_queue import PlaceHints, QueuedFrame

_NS = 1_000_000_000
_MAX_TRANSITIONS = 5  # in a status: a status a second with only the newest change would miss some


class RobotState:
    """State and odometry correction of one robot between two resets of its session, which locks it."""

    def __init__(self, robot: str, map_sha256: str, counters: Counters, hints: PlaceHints) -> None:
        """Start in SEARCHING; ``hints`` outlive resets."""
        self.robot = robot
        self.map_sha256 = map_sha256
        self.last_frame_ns: int | None = None  # stamp of the newest processed frame
        self.calibration: Calibration | None = None  # of sensor and odometry at the newest frame, in any state
        self._hints = hints
        self._counters = counters
        self._lost = False  # no fix has restored the place since
        self._loss_reason = ""
        self._restart_reason = ""
        self._forget_epoch()

    def _forget_epoch(self) -> None:
        """Forget everything that refers to the odometry frame, which has ended."""
        self._hints.begin_epoch()
        self._fix: Fix | None = None
        self._correction: OdomCorrection | None = None
        self._verify_from_ns: int | None = None  # frames stamped from here on may verify the place
        self._published: PoseMessage | None = None

    @property
    def state(self) -> State:
        """The engine's state, except for a lost place and a pause of odometry; there is a pose while it is TRACKING.

        A place is lost when odometry or usable frames stop, and with every new odometry epoch. Only a fix in TRACKING
        ends the loss: after silence a verified frame suffices, in a new epoch the place is searched for.
        """
        if self._lost:
            return State.LOST
        engine = State.SEARCHING if self._fix is None else self._fix.state
        return State.DOUBTED if engine is State.TRACKING and self.requires_verification else engine

    @property
    def evidence(self) -> KeyframeEvidence | None:
        """Evidence of the newest keyframe; None without one in this odometry epoch."""
        return None if self._fix is None else self._fix.evidence

    @property
    def engine_has_place(self) -> bool:
        """Whether the engine has a place, even if there is no pose until it is verified."""
        return self._fix is not None and self._fix.state.has_place

    @property
    def requires_verification(self) -> bool:
        """Whether a frame must verify the place before poses return."""
        return self._verify_from_ns is not None

    # ---- events

    def add_fix(self, fix: Fix, frame: QueuedFrame, events: Sequence[Event]) -> None:
        """Apply the fix at a frame; the engine's ``events`` up to it show how often the place was lost."""
        stamp_ns = self.last_frame_ns = frame.job.stamp_ns
        before, engine_before = self.state, None if self._fix is None else self._fix.state
        reason = fix.evidence.reason if fix.evidence else "evidence gone"
        if Event.PLACE_GIVEN_UP in events and engine_before is not State.LOST:
            self._lose(reason)  # a place accepted and given up at this one frame is no second loss
        self._fix = fix
        self._lost |= fix.state is State.LOST
        self.calibration = fix.calibration or self.calibration
        asked = frame.job.require_verification
        if asked and self._verify_from_ns is not None and stamp_ns >= self._verify_from_ns:
            self._verify_from_ns = None  # this frame has checked the place: any doubt left is the engine's own
        if fix.state is State.TRACKING and self._verify_from_ns is None:
            self._lost = False
            self._counters.fixes += before is not State.TRACKING
            self._correction = OdomCorrection(fix, stamp_ns, frame.paired.travelled, frame.paired.turned)
            assert fix.T_map_body is not None  # while TRACKING
            self._hints.verified(fix.T_map_body, self.calibration)

    def restart_search(self, reason: str) -> None:
        """Forget the place: the odometry frame has changed."""
        if self.engine_has_place:
            self._loss_reason = reason
        if self.state.has_place:
            self._lose(reason)
        self._restart_reason = f"searching anew: {reason}"
        self._forget_epoch()

    def require_verification(self, from_ns: int) -> None:
        """Withhold poses until a frame stamped ``from_ns`` or later has verified the place."""
        self._verify_from_ns = from_ns if self._verify_from_ns is None else max(self._verify_from_ns, from_ns)

    def on_silence(self, reason: str, newest_ns: int) -> None:
        """Lose the place until a frame after the odometry of ``newest_ns`` has verified it."""
        self._lose(reason)
        self._verify_from_ns = newest_ns + 1

    def explain_loss(self, reason: str) -> None:
        """If the place is lost, replace the reason of the loss by the reason why the place is not regained."""
        if self.state is State.LOST:
            self._loss_reason = reason

    def _lose(self, reason: str) -> None:
        """Lose the place; a loss for two reasons counts once, and the newer reason replaces the older."""
        self._counters.losses += self.state is not State.LOST
        self._lost, self._loss_reason = True, reason

    # ---- published

    def reason(self, pending: str = "") -> str | None:
        """Return the reason of the state in one clause; None before the first frame has been processed.

        ``pending`` describes an unfinished search; it is the reason if no search has ended.
        """
        evidence = self.evidence.reason if self.evidence else ""
        if self.state is State.TRACKING:
            return evidence
        if self.state is State.LOST:
            return self._loss_reason
        if self._fix is not None and self._fix.state is State.TRACKING:
            return "verifying the place after a pause of odometry"
        if self.last_frame_ns is None:
            return None
        return evidence or self._restart_reason or pending or "too little has been seen"

    def searched(self) -> str:
        """Return why a lost place is not found again; empty if nothing new is known since the loss."""
        fix = self._fix
        if not self._lost or fix is None or fix.state.has_place or fix.evidence is None:
            return ""
        return "" if fix.evidence.reason == self._loss_reason else fix.evidence.reason

    @property
    def correction(self) -> OdomCorrection | None:
        """The odometry correction in force; None unless TRACKING."""
        return self._correction if self.state is State.TRACKING else None

    def pose(self, odometry: OdometryBuffer) -> PoseMessage | None:
        """Return the newest odometry, corrected, with its stamp, for publication; None unless TRACKING."""
        pose, previous = self.newest_pose(odometry), self._published
        if pose is None or (previous is not None and pose.stamp_ns < previous.stamp_ns):
            return None
        if previous is not None and pose.stamp_ns == previous.stamp_ns:
            pose = previous  # never two different poses for one stamp
        self._published = pose
        self._counters.poses += 1
        return pose

    def publish_after(self, other: RobotState) -> None:
        """Publish nothing older than another state has published, and no other pose for the same stamp."""
        self._published = other._published

    def newest_pose(self, odometry: OdometryBuffer) -> PoseMessage | None:
        """Return the newest odometry, corrected; None unless TRACKING."""
        correction = self.correction
        return None if correction is None else correction.pose(odometry, self.robot, self.map_sha256)

    def age(self, odometry: OdometryBuffer) -> float | None:
        """Return sensor time, seconds, from the newest registration to the newest odometry; None unless TRACKING."""
        newest, correction = odometry.newest, self.correction
        return None if newest is None or correction is None else correction.age(newest.stamp_ns)

    def protection_level(self, odometry: OdometryBuffer) -> ProtectionLevel | None:
        """Return the protection level of the pose at the newest odometry; None unless TRACKING."""
        pose = self.newest_pose(odometry)
        return None if pose is None else pose.protection


class OdomCorrection(NamedTuple):
    """Correction of odometry by a fix, with what is needed to carry it on by odometry and its drift."""

    fix: Fix  # with a pose
    stamp_ns: int  # of the fix's frame
    travelled: float  # metres driven by odometry at the frame
    turned: float  # radians turned by odometry at the frame

    def age(self, stamp_ns: int) -> float:
        """Return sensor time, seconds, from the newest registration that supported the fix to ``stamp_ns``."""
        evidence = self.fix.evidence
        verified_ns = self.stamp_ns if evidence is None else min(self.stamp_ns, round(evidence.stamp * _NS))
        return max(0.0, (stamp_ns - verified_ns) / _NS)

    def pose(self, odometry: OdometryBuffer, robot: str, map_sha256: str) -> PoseMessage | None:
        """Return the newest odometry, corrected, with its stamp and the drift since the fix; None without odometry."""
        newest = odometry.newest
        if newest is None:
            return None
        driven, turned = odometry.travelled - self.travelled, odometry.turned - self.turned
        fix = self.fix.carried(newest.stamp_ns / _NS, newest.T_odom_body, driven, turned)
        assert fix.T_map_body is not None  # it has a pose
        assert fix.covariance is not None
        return PoseMessage(
            stamp_ns=newest.stamp_ns,
            robot=robot,
            state=State.TRACKING.value,
            T_map_body=fix.T_map_body,
            covariance=fix.covariance,
            confidence=fix.confidence,
            map_sha256=map_sha256,
            age=self.age(newest.stamp_ns),
            protection=fix.protection,
            T_map_odom=fix.T_map_odom,
        )


class StateHistory:
    """The newest changes of a robot's reported state, numbered from 1 so that gaps show, with reasons and evidence."""

    def __init__(self) -> None:
        self._state = State.SEARCHING
        self._reason = ""
        self._newest: deque[tuple[dict[str, Any], KeyframeEvidence | None]] = deque(maxlen=_MAX_TRANSITIONS)
        self._count = 0

    def add(self, state: State, reason: str, stamp_ns: int | None, evidence: KeyframeEvidence | None) -> bool:
        """Record the state at the newest processed frame; return whether the reported state changed.

        LOST for another reason is recorded too, because it changes the search.
        """
        lost_again = state is State.LOST and reason != self._reason
        changed = state.reported != self._state.reported
        if changed or lost_again:
            self._count += 1
            ends = {"from": self._state.reported, "to": state.reported}
            change = {"number": self._count, "stamp_ns": stamp_ns, **ends, "reason": reason}
            self._newest.append((change, evidence))
            self._state, self._reason = state, reason
        return changed

    def to_json(self) -> list[dict[str, Any]]:
        """Return the newest changes, oldest first."""
        newest = tuple(self._newest)
        return [c | {"evidence": None if evidence is None else evidence.to_json()} for c, evidence in newest]
