"""A robot's work for the engines: a desk for each odometry frame, what became of its jobs, and how long they took."""

from __future__ import annotations

from collections.abc import Iterator

from coview_stream.decision import Verdict
from coview_stream.stream.counters import Counters, Latency
from coview_stream.stream.desk import Desk, Ready
from coview_stream.stream.jobs import FrameJob, FrameResult, SearchJob
from coview_stream.stream.reception import Complaints, last_line


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

    def __init__(self, robot: str, epochs: Iterator[int], counters: Counters, complaints: Complaints) -> None:
        """Begin with nothing to do; ``epochs`` numbers odometry frames, all resets through."""
        self.robot = robot
        self._epochs = epochs
        self._counters = counters
        self._complaints = complaints
        self.latency = Latency()
        self.engine_latency = Latency()
        self.longest_wait = 0.0
        self.processed_at: float | None = None
        self.desk = Desk(robot, next(epochs))
        self._first = self.desk.epoch

    def begin_anew(self) -> None:
        """Drop what waits: there is another odometry frame."""
        self._counters.dropped += self.desk.waiting
        self.desk = Desk(self.robot, next(self._epochs))

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

    def search_done(self, job: SearchJob, verdict: Verdict | None) -> None:
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
