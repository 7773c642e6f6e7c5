"""A robot's work for the engines: what waits, what is under way, what has come back and is still to be handed on."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coview_stream.decision import Verdict
from coview_stream.geometry import Pose
from coview_stream.query import Query
from coview_stream.stream.jobs import FrameJob, SearchJob
from coview_stream.stream.pairing import Paired


@dataclass(frozen=True)
class Ready:
    """A frame for the engine.

    Attributes:
        job: the frame.
        received: local time at which it came, seconds.
        since: local time from which on a frame of this robot has been waiting.
        travelled: metres that odometry had driven when it was taken.
        turned: radians that odometry had turned.
    """

    job: FrameJob
    received: float
    since: float
    travelled: float
    turned: float


class Desk:
    """One robot's work in one odometry frame; with another odometry frame comes another desk.

    Of frames and of queries only the newest waits; one of each is under way.
    """

    def __init__(self, robot: str, epoch: int) -> None:
        self.robot = robot
        self.epoch = epoch
        self._ready: Ready | None = None
        self._busy: Ready | None = None
        self._query: Query | None = None
        self._searching = False
        self._verdict: Verdict | None = None

    @property
    def waiting(self) -> int:
        """Frames that wait: 0 or 1."""
        return int(self._ready is not None)

    def put_frame(self, frame: Paired, now: float, travelled: float, turned: float) -> bool:
        """Make a frame the next one; return whether another had to make room for it: then there is a hurry."""
        message = frame.message
        job = FrameJob(
            self.robot, self.epoch, message.stamp_ns, message.points, frame.T_odom_body, message.times,
            frame.segment, hurry=self._ready is not None,
        )  # fmt: skip
        before = self._ready
        since = now if before is None else before.since
        self._ready = Ready(job, frame.received, since, travelled, turned)
        return before is not None

    def take_frame(self, suspect: bool, suggested: Pose | None = None) -> FrameJob | None:
        """Hand out the newest frame, with the verdict of a search if one has come; None while one is under way."""
        if self._ready is None or self._busy is not None:
            return None
        self._busy, self._ready = self._ready, None
        job = replace(self._busy.job, suspect=suspect, verdict=self._verdict, suggested=suggested)
        self._verdict = None
        return job

    def frame_over(self, unused: Verdict | None = None) -> Ready | None:
        """Return what was under way; ``unused`` is a verdict that was not taken note of and goes with the next one."""
        busy, self._busy = self._busy, None
        self._verdict = self._verdict or unused
        return busy

    def put_query(self, query: Query) -> bool:
        """Make a query the next one; return whether another had to make room for it."""
        before, self._query = self._query, query
        return before is not None

    def take_search(self) -> SearchJob | None:
        """Hand out the newest query; None while one is under way."""
        if self._query is None or self._searching:
            return None
        job = SearchJob(self.robot, self.epoch, self._query)
        self._query, self._searching = None, True
        return job

    def search_over(self, verdict: Verdict | None) -> None:
        """Take in a verdict, None if the search failed; it goes with the next frame.

        An acceptance that still waits is kept: what is found after it comes from a search begun anew.
        """
        self._searching = False
        if verdict is not None and (self._verdict is None or self._verdict.accepted is None):
            self._verdict = verdict
