"""Queue of one robot's frames and search requests to the engines: the two mailboxes between the processes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coview_stream.geometry.transforms import Pose
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.request import SearchRequest
from coview_stream.stream.node.counters import Counters, ErrorLog, Latency, last_line
from coview_stream.stream.node.frame_sync import PairedFrame
from coview_stream.stream.node.jobs import FrameJob, FrameResult, SearchJob


@dataclass(frozen=True)
class QueuedFrame:
    """A frame for the tracking engine, waiting or under way.

    Attributes:
        job: the frame, as the engine gets it.
        received: local time at which it came, seconds.
        waiting_since: local time from which on a frame of this robot has been waiting.
        travelled: metres that odometry had driven when it was taken.
        turned: radians that odometry had turned.
    """

    job: FrameJob
    received: float
    waiting_since: float
    travelled: float
    turned: float


class EngineQueue:
    """One robot's work for the engines, from one reset of its session to the next; the session holds the lock.

    Of frames and of search requests only the newest waits, and one of each is under way. The result of a search waits
    here too: it goes to the tracking engine with the next frame. Jobs issued before a reset are ignored; jobs of an old
    odometry epoch are only counted.

    Attributes:
        epoch: number of the robot's odometry frame.
        latency: from the coming of a cloud to its fix.
        engine_latency: the part of it that the engine took.
        longest_wait: seconds that a frame of this robot has been waiting, at most.
        processed_at: local time of the newest fix; None before the first.
    """

    def __init__(self, robot: str, epoch: int, counters: Counters, errors: ErrorLog) -> None:
        """Begin with nothing to do in odometry epoch ``epoch``, which no job of this robot has had before."""
        self.robot = robot
        self.epoch = epoch
        self._first_epoch = epoch
        self._counters = counters
        self._errors = errors
        self.latency = Latency()
        self.engine_latency = Latency()
        self.longest_wait = 0.0
        self.processed_at: float | None = None
        self._frame: QueuedFrame | None = None
        self._frame_under_way: QueuedFrame | None = None
        self._request: SearchRequest | None = None
        self._searching = False
        self._search_result: SearchResult | None = None

    def begin_epoch(self, epoch: int) -> None:
        """Drop what waits, and forget what is under way: there is another odometry frame."""
        self._counters.dropped += self._frame is not None
        self.epoch = epoch
        self._frame = self._frame_under_way = self._request = self._search_result = None
        self._searching = False

    # ---- frames for the tracking engine

    def put_frame(self, frame: PairedFrame, now: float, travelled: float, turned: float) -> None:
        """Make a frame the next one; one that waits already is dropped, and the engine is behind."""
        message, before = frame.message, self._frame
        self._counters.dropped += before is not None
        job = FrameJob(
            self.robot, self.epoch, message.stamp_ns, message.points, frame.T_odom_body, message.times,
            frame.segment, defer=before is not None,
        )  # fmt: skip
        waiting_since = now if before is None else before.waiting_since
        self._frame = QueuedFrame(job, frame.received, waiting_since, travelled, turned)

    def take_frame(self, require_verification: bool, hint: Pose | None = None) -> FrameJob | None:
        """Hand out the newest frame, with the result of a search if one has come; None while one is under way."""
        if self._frame is None or self._frame_under_way is not None:
            return None
        job = replace(
            self._frame.job, require_verification=require_verification, search_result=self._search_result, hint=hint
        )
        self._frame_under_way = replace(self._frame, job=job)
        self._frame = self._search_result = None
        return job

    def frame_done(self, job: FrameJob, result: FrameResult, now: float) -> QueuedFrame | None:
        """Count a frame's fix, and queue what it asks to search for; return the frame if its fix still matters."""
        if job.epoch < self._first_epoch:
            return None
        self._counters.processed += 1
        self.processed_at = now
        self.engine_latency.add(result.seconds)
        frame = self._frame_under_way
        if job.epoch != self.epoch or frame is None:
            return None
        self._frame_under_way = None
        self.latency.add(now - frame.received)
        self.longest_wait = max(self.longest_wait, now - frame.waiting_since)
        if result.request is not None:
            self.put_search_request(result.request)
        return frame

    def frame_failed(self, job: FrameJob, reason: str, rejected: bool) -> bool:
        """Count a frame of no use (``rejected``) or that the engine failed at; return whether that still matters."""
        if job.epoch < self._first_epoch:
            return False
        self._counters.count("rejected" if rejected else "engine_errors")
        kind = "frames of no use" if rejected else "frames that the engine failed at"
        self._errors.add_first(f"{self.robot}: {kind}", last_line(reason))
        if job.epoch != self.epoch:
            return False
        self._frame_under_way = None
        # perhaps not applied: it goes with the next frame too, and applied twice it changes nothing
        self._search_result = self._search_result or job.search_result
        return True

    # ---- requests for the search engine

    def put_search_request(self, request: SearchRequest) -> None:
        """Make a request the next one; one that waits already is skipped."""
        self._counters.searches_skipped += self._request is not None
        self._request = request

    def take_search_request(self) -> SearchJob | None:
        """Hand out the newest request; None while one is under way."""
        if self._request is None or self._searching:
            return None
        job = SearchJob(self.robot, self._request)
        self._request, self._searching = None, True
        return job

    def search_done(self, job: SearchJob, result: SearchResult) -> None:
        """Count a search; its result goes with the next frame.

        An acceptance that still waits is kept: a result after it comes from a search that began again.
        """
        if job.epoch < self._first_epoch:
            return
        self._counters.searches += 1
        if job.epoch == self.epoch:
            self._searching = False
            if self._search_result is None or self._search_result.accepted is None:
                self._search_result = result

    def search_failed(self, job: SearchJob, reason: str) -> None:
        """Count a search that failed; it costs this keyframe's vote only."""
        if job.epoch < self._first_epoch:
            return
        self._counters.search_errors += 1
        self._errors.add_first(f"{self.robot}: failed searches", last_line(reason))
        if job.epoch == self.epoch:
            self._searching = False
