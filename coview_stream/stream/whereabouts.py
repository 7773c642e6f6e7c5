"""What is known of a robot's place, and what can be said of it right now; its session holds the lock."""

from __future__ import annotations

from collections.abc import Callable

from coview_stream.fix import Fix, KeyframeEvidence, State
from coview_stream.stream.correction import Correction
from coview_stream.stream.counters import Counters
from coview_stream.stream.desk import Ready
from coview_stream.stream.last_place import LastPlace, Recollection
from coview_stream.stream.messages import PoseMessage
from coview_stream.stream.odometry import OdometryBuffer


class Whereabouts:
    """State and correction of a robot, from one reset of its session to the next, and the reasons for them.

    Attributes:
        evidence: of the newest keyframe, if there is any in this odometry frame.
        last_frame_ns: stamp of the newest processed frame; None before the first.
        suspect: whether a frame has to verify the place before there is a pose again.
    """

    def __init__(self, robot: str, map_sha256: str, counters: Counters, place: LastPlace) -> None:
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
        self._correction: Correction | None = None
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
            self._correction = Correction.of(fix, stamp_ns, ready.travelled, ready.turned)
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

    def recall(self, odometry: OdometryBuffer) -> Recollection:
        """Say where the robot is, if that is known, for the next start."""
        forgotten, known = self._place.forgotten, self._correction
        pose = known and known.pose(odometry, self.robot, self.map_sha256)
        return Recollection(forgotten, pose.stamp_ns, pose.T_map_body) if pose else Recollection(forgotten)
