"""A robot's work for the engines: a desk for each odometry frame, what became of its jobs, and how long they took."""

# FOLDED coview_stream/stream/node/engine_queue.py: """A robot's work for the engines: what waits, what is under way, what has come back and is still to be handed on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from coview_stream.geometry.transforms import Pose
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.request import SearchRequest
from coview_stream.stream.node.counters import Counters, Latency
from coview_stream.stream.node.decoding import ErrorLog, last_line
from coview_stream.stream.node.frame_sync import Paired
from coview_stream.stream.node.jobs import FrameJob, FrameResult, SearchJob


class Work:
    """The work from one reset of a session to the next; the session holds the lock.

    A job from before the reset is nobody's. One from an odometry frame that is no more is counted and comes to nothing.

    Attributes:
        desk: the work in the present odometry frame.
        latency: from the coming of a cloud to its fix.
        engine_latency: what of that the engine took.
        longest_wait: seconds that a frame of this robot has been waiting, at most.
        processed_at: local time of the newest fix; None before the first.
    """

    def __init__(self, robot: str, epochs: Iterator[int], counters: Counters, complaints: ErrorLog) -> None:
        """Begin with nothing to do; ``epochs`` numbers odometry frames, all resets through."""
        self.robot = robot
        self._epochs = epochs
        self._counters = counters
        self._complaints = complaints
        self.latency = Latency()
        self.engine_latency = Latency()
        self.longest_wait = 0.0
        self.processed_at: float | None = None
        self.desk = _Slots(robot, next(epochs))
        self._first = self.desk.epoch

    def begin_anew(self) -> None:
        """Drop what waits: there is another odometry frame."""
        self._counters.dropped += self.desk.waiting
        self.desk = _Slots(self.robot, next(self._epochs))

    def frame_done(self, job: FrameJob, result: FrameResult, now: float) -> Ready | None:
        """Take note of a frame's end; return what it was, if its fix still matters."""
        if job.epoch < self._first:
            return None
        self._counters.processed += 1
        self.processed_at = now
        self.engine_latency.add(result.seconds)
        busy = self.desk.frame_over() if job.epoch == self.desk.epoch else None
        if busy is not None:
            self.latency.add(now - busy.received)
            self.longest_wait = max(self.longest_wait, now - busy.since)
            if result.query is not None:
                self._counters.searches_skipped += self.desk.put_query(result.query)
        return busy

    def frame_failed(self, job: FrameJob, reason: str, rejected: bool) -> bool:
        """Take note of a frame of no use (``rejected``) or that the engine failed at; return whether that matters."""
        if job.epoch < self._first:
            return False
        self._counters.count("rejected" if rejected else "engine_errors")
        kind = "frames of no use" if rejected else "frames that the engine failed at"
        self._complaints.add_first(f"{self.robot}: {kind}", last_line(reason))
        if job.epoch != self.desk.epoch:
            return False
        self.desk.frame_over(unused=job.verdict)
        return True

    def search_done(self, job: SearchJob, verdict: SearchResult | None) -> None:
        """Take note of a verdict; None if the search failed."""
        if job.epoch < self._first:
            return
        self._counters.searches += 1
        if job.epoch == self.desk.epoch:
            self.desk.search_over(verdict)

    def search_failed(self, job: SearchJob, reason: str) -> None:
        """Take note that the search engine failed."""
        self._counters.search_errors += 1
        self._complaints.add_first(f"{self.robot}: failed searches", last_line(reason))
        if job.epoch == self.desk.epoch:
            self.desk.search_over(None)


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


class _Slots:
    """One robot's work in one odometry frame; with another odometry frame comes another desk.

    Of frames and of queries only the newest waits; one of each is under way.
    """

    def __init__(self, robot: str, epoch: int) -> None:
        self.robot = robot
        self.epoch = epoch
        self._ready: Ready | None = None
        self._busy: Ready | None = None
        self._query: SearchRequest | None = None
        self._searching = False
        self._verdict: SearchResult | None = None

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

    def frame_over(self, unused: SearchResult | None = None) -> Ready | None:
        """Return what was under way; ``unused`` is a verdict that was not taken note of and goes with the next one."""
        busy, self._busy = self._busy, None
        self._verdict = self._verdict or unused
        return busy

    def put_query(self, query: SearchRequest) -> bool:
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

    def search_over(self, verdict: SearchResult | None) -> None:
        """Take in a verdict, None if the search failed; it goes with the next frame.

        An acceptance that still waits is kept: what is found after it comes from a search begun anew.
        """
        self._searching = False
        if verdict is not None and (self._verdict is None or self._verdict.accepted is None):
            self._verdict = verdict
