"""Queue of one robot's frames and search requests to the engines: the two mailboxes between the processes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from coview_stream.geometry.transforms import Pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.considered import Considered
from coview_stream.localization.search.place_guess import PlaceGuess
from coview_stream.localization.search.request import Epoch, SearchRequest
from coview_stream.localization.state import State
from coview_stream.stream.node.counters import Counters, ErrorLog, Latency, last_line
from coview_stream.stream.node.frame_sync import PairedFrame
from coview_stream.stream.node.jobs import FrameJob, FrameResult, SearchJob
from coview_stream.stream.node.scheduling import SearchDemand


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
        longest_search_wait: seconds that a keyframe of this robot has been waiting for its search and that has taken,
            at most; one that is replaced by a newer one waits on.
        processed_at: local time of the newest fix; None before the first.
        considered: places that the newest search has considered; None once there is a place, or another epoch.
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
        self.longest_wait = self.longest_search_wait = 0.0
        self.processed_at: float | None = None
        self.considered: Considered | None = None
        self._frame: QueuedFrame | None = None
        self._frame_under_way: QueuedFrame | None = None
        self._search_result: SearchResult | None = None
        self._search_epoch: Epoch | None = None
        self._searches = self._support = 0  # in that epoch, as SearchDemand says
        self._forget_searches()

    def _forget_searches(self) -> None:
        """Drop the request that waits, and forget the one under way."""
        self._request: SearchRequest | None = None
        self._requested_at: float | None = None  # local time from which a keyframe has been waiting
        self._searching_since: float | None = None  # the same of the keyframe that is being searched for

    def begin_epoch(self, epoch: int) -> None:
        """Drop what waits, and forget what is under way: there is another odometry frame."""
        self._counters.dropped += self._frame is not None
        self.epoch = epoch
        self._frame = self._frame_under_way = self._search_result = self.considered = None
        self._forget_searches()

    # ---- frames for the tracking engine

    def put_frame(self, frame: PairedFrame, now: float, travelled: float, turned: float) -> None:
        """Make a frame the next one; one that waits already is dropped, and the engine is behind."""
        message, before = frame.message, self._frame
        self._counters.dropped += before is not None
        job = FrameJob(
            self.robot, self.epoch, message.stamp_ns, message.points, frame.T_odom_body, message.times,
            frame.segment, defer=before is not None, first_epoch=self._first_epoch,
        )  # fmt: skip
        waiting_since = now if before is None else before.waiting_since
        self._frame = QueuedFrame(job, frame.received, waiting_since, travelled, turned)

    @property
    def has_frame(self) -> bool:
        """Whether a frame may be taken."""
        return self._frame is not None and self._frame_under_way is None

    def take_frame(
        self,
        require_verification: bool,
        hint: Pose | None = None,
        calibration: Calibration | None = None,
        guess: PlaceGuess | None = None,
    ) -> FrameJob | None:
        """Hand out the newest frame, with the result of a search if one has come; None while one is under way."""
        if self._frame is None or self._frame_under_way is not None:
            return None
        job = replace(
            self._frame.job,
            require_verification=require_verification,
            search_result=self._search_result,
            hint=hint,
            guess=guess,
            calibration=None if hint is None else calibration,
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
        if result.fix.state.has_place:
            self._request = self._requested_at = self.considered = None
        if result.request is not None:
            self.put_search_request(result.request, now)
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

    def put_search_request(self, request: SearchRequest, now: float) -> None:
        """Make a request the next one; one that waits already is skipped, and its wait goes on."""
        self._counters.searches_skipped += self._request is not None
        if request.epoch != self._search_epoch:
            self._search_epoch, self._requested_at = request.epoch, None
            self._searches = self._support = 0
        self._request = request
        self._requested_at = now if self._requested_at is None else self._requested_at

    @property
    def search_demand(self) -> SearchDemand | None:
        """Demand for a search; None while there is nothing to search for, or a search is under way."""
        since = self._requested_at
        if since is None or self._searching_since is not None:
            return None
        return SearchDemand(since, self._searches, self._support)

    def take_search_request(self) -> SearchJob | None:
        """Hand out the newest request; None while one is under way."""
        if self._request is None or self._searching_since is not None:
            return None
        job = SearchJob(self.robot, self._request)
        self._searching_since = self._requested_at
        self._request = self._requested_at = None
        return job

    def search_done(self, job: SearchJob, result: SearchResult, now: float) -> None:
        """Count a search; its result goes with the next frame.

        An acceptance that still waits is kept: a result after it comes from a search that began again.
        """
        if job.epoch < self._first_epoch:
            return
        self._counters.searches += 1
        if job.epoch != self.epoch:
            return
        if self._searching_since is not None:
            self.longest_search_wait = max(self.longest_search_wait, now - self._searching_since)
        self._searching_since = None
        self.considered = result.considered
        if result.accepted is not None:
            self._request = self._requested_at = None  # what came meanwhile need not be searched for
        if job.request.epoch == self._search_epoch:
            self._searches += 1
            self._support = self._support + 1 if result.evidence.state is State.AMBIGUOUS else 0
        if self._search_result is None or self._search_result.accepted is None:
            self._search_result = result

    def search_failed(self, job: SearchJob, reason: str) -> None:
        """Count a search that failed; it costs this keyframe's vote only."""
        if job.epoch < self._first_epoch:
            return
        self._counters.search_errors += 1
        self._errors.add_first(f"{self.robot}: failed searches", last_line(reason))
        if job.epoch == self.epoch:
            self._searching_since = None
