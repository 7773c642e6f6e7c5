"""One robot's frames, search requests and hints for the engines, and the order in which an engine serves robots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.result import Fix
from coview_stream.localization.search.acceptance import Considered, SearchResult
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.localization.search.request import Epoch, SearchRequest
from coview_stream.localization.state import Event, State
from coview_stream.odometry.buffer import Segment
from coview_stream.stream.node.counters import Counters, ErrorLog, Latency, last_line
from coview_stream.stream.node.inputs import OdometryJob, OdometryResult, PairedFrame

# for the order of searches
_PATIENCE = 1.5  # seconds of waiting after which a keyframe goes before those that have waited less
_NEW = 8  # searches for which a robot counts as newly lost; most are found within them
_MAX_SUPPORT = 16  # searches in a row that propose a place: beyond it the map probably has a similar place


@dataclass(frozen=True)
class FrameJob:
    """One lidar frame for the tracking engine."""

    robot: str  # name
    epoch: int  # id of the odometry frame; a new one makes the engine forget the place
    stamp_ns: int  # sensor time, nanoseconds
    points: Points | None  # (N, 3) float32 body frame, metres; None: previous frame, with another search result
    T_odom_body: Pose  # (4, 4) odometry at the stamp
    times: Floats | None = None  # (N,) seconds after the stamp at which each point was measured; None: no deskewing
    segment: Segment | None = None  # odometry while the frame was measured; accompanies ``times``
    require_verification: bool = False  # withhold poses until this frame has verified the place
    search_result: SearchResult | None = None  # from an earlier search, applied first
    defer: bool = False  # frames wait for the engine: postpone all work that can wait
    # (4, 4) ``T_map_body`` where the robot may be at this frame, verified like any hypothesis
    hint: Pose | None = None
    guess: PlaceGuess | None = None  # guess of the place; tried, never trusted
    calibration: Calibration | None = None  # of sensor and odometry at ``hint``, a prior
    # the first epoch since the robot was reset; another one makes the engine forget the calibration too
    first_epoch: int = 0


@dataclass(frozen=True)
class FrameResult:
    """The tracking engine's answer to a frame."""

    fix: Fix  # after the frame
    request: SearchRequest | None  # keyframe to search for; None: none
    seconds: float  # of the engine's work
    events: tuple[Event, ...]  # state changes since the last answer for this robot and epoch, in order


@dataclass(frozen=True)
class SearchJob:
    """One keyframe of a robot for the search engine."""

    robot: str
    request: SearchRequest

    @property
    def epoch(self) -> int:
        """Odometry epoch of the frame job that made the keyframe."""
        return self.request.epoch[0]


Job: TypeAlias = FrameJob | SearchJob | OdometryJob
Result: TypeAlias = FrameResult | SearchResult | OdometryResult


class SearchDemand(NamedTuple):
    """A robot's waiting keyframe, to order the searches."""

    since: float  # local time, seconds, since when this keyframe, or one it replaced, has waited
    searches: int = 0  # number of searches since the robot was lost
    support: int = 0  # number of newest searches, in a row, that proposed a place


def search_order(demands: Sequence[SearchDemand | None], now: float) -> list[int]:
    """Return the robots of ``demands`` that want a search, in order of their turns at local time ``now``.

    A keyframe that has waited for 1.5 s comes first, the oldest before the others: no robot waits much longer, unless
    the engine cannot keep up, and then all wait equally long. Otherwise robots with a proposed place, which need the
    fewest further searches, come first, then the newly lost, then the long lost.
    """

    def rank(demand: SearchDemand) -> tuple[bool, int, bool, float]:
        overdue = now - demand.since >= _PATIENCE
        support = demand.support if demand.support <= _MAX_SUPPORT and not overdue else 0
        new = overdue or demand.searches < _NEW
        return not overdue, -support, not new, demand.since

    return [k for _, k in sorted((rank(demand), k) for k, demand in enumerate(demands) if demand is not None)]


class RoundRobin:
    """Order in which one engine serves robots, numbered from 0: the longest wait first."""

    def __init__(self, count: int) -> None:
        self._order = list(range(count))

    def order(self) -> list[int]:
        """Return the robots in the order in which they may be served now."""
        return list(self._order)

    def serve(self, k: int) -> None:
        """Move robot ``k``, which is served now, to the end."""
        self._order.remove(k)
        self._order.append(k)


class PlaceHints:
    """Hints for the engine: the last place and a guess, each sent once in every odometry epoch.

    Attributes:
        forgotten: number of times a client has asked to forget the place.
        T_map_body: (4, 4) of the last place, whether the engine has it or not; None without one.
        calibration: of sensor and odometry at that place; sent with the pose, as a prior.
        guess: the newest guess, until the place is known.
        pending_guess: the same, until a frame has carried it to the engine.
    """

    def __init__(self) -> None:
        self.forgotten = 0
        self.guess: PlaceGuess | None = None
        self.pending_guess: PlaceGuess | None = None
        self.drop()

    def drop(self) -> None:
        """Drop the last place and its calibration for good: no later epoch offers them again."""
        self.T_map_body: Pose | None = None
        self.calibration: Calibration | None = None
        self._pending = False

    @property
    def pending(self) -> Pose | None:
        """``T_map_body`` (4, 4) to send with the next frame; None if the engine has it."""
        return self.T_map_body if self._pending else None

    def offer(self, T_map_body: Pose, calibration: Calibration | None) -> None:
        """Take a pose that the engine does not know, as from before this session, and its calibration."""
        self.T_map_body, self.calibration, self._pending = T_map_body, calibration, True

    def offer_guess(self, guess: PlaceGuess | None) -> None:
        """Replace the guess."""
        self.guess = self.pending_guess = guess

    def verified(self, T_map_body: Pose, calibration: Calibration | None) -> None:
        """Take a pose that the engine itself has verified."""
        self.T_map_body, self.calibration, self._pending = T_map_body, calibration, False
        self.guess = None

    def begin_epoch(self) -> None:
        """Offer pose and guess again: in a new odometry epoch the engine forgets both, but they may still be right.

        A guess loses its circle, as the distance driven is unknown.
        """
        self._pending = self.T_map_body is not None
        self.offer_guess(None if self.guess is None else replace(self.guess, within=None))

    def delivered(self, hint: Pose | None, guess: PlaceGuess | None) -> None:
        """Stop offering the pose and the guess that a frame carried."""
        if hint is self.T_map_body:
            self._pending = False
        if guess is self.pending_guess:
            self.pending_guess = None

    def forget(self) -> None:
        """Drop everything at a client's request; the file for the next start is deleted too."""
        self.drop()
        self.offer_guess(None)
        self.forgotten += 1


class QueuedFrame(NamedTuple):
    """A frame for the tracking engine, waiting or under way."""

    job: FrameJob  # the frame as sent to the engine
    paired: PairedFrame  # the frame with its odometry
    waiting_since: float  # local time since when a frame of this robot has waited


class EngineQueue:
    """One robot's work for the engines between two resets of its session; the session holds the lock.

    At most one frame and one search request wait, the newest, and one of each is under way. A search result also
    waits here: it goes to the tracking engine with the next frame. Jobs from before a reset are ignored; jobs of an
    old odometry epoch are only counted.
    """

    def __init__(self, robot: str, epoch: int, counters: Counters, errors: ErrorLog) -> None:
        """Start without work in odometry epoch ``epoch``, which no earlier job of this robot has had."""
        self.robot = robot
        self._first_epoch = self.epoch = epoch  # id of the robot's odometry frame
        self._counters = counters
        self._errors = errors
        self.latency = Latency()  # from the arrival of a cloud to its fix
        self.engine_latency = Latency()  # the engine's share of it
        self.longest_wait = 0.0  # longest wait of a frame of this robot, seconds
        # longest seconds from a keyframe to the end of its search; a keyframe inherits the wait of one it replaces
        self.longest_search_wait = 0.0
        self.processed_at: float | None = None  # local time of the newest fix
        self._search_epoch: Epoch | None = None
        self._searches = self._support = 0  # in that epoch, as in SearchDemand
        self._forget_epoch()

    def _forget_epoch(self) -> None:
        self.considered: Considered | None = None  # places in the newest search; None once there is a place
        self._frame: QueuedFrame | None = None
        self._frame_under_way: QueuedFrame | None = None
        self._doubting: Job | None = None  # the job under way, if it contradicts the place
        self._frame_done: QueuedFrame | None = None  # the newest processed frame
        self._search_result: SearchResult | None = None
        self._request: SearchRequest | None = None
        self._requested_at: float | None = None  # local time since when a keyframe has waited
        self._searching_since: float | None = None  # the same for the keyframe under way

    def begin_epoch(self, epoch: int) -> None:
        """Drop all frames and requests, waiting or under way: the odometry frame has changed."""
        self._counters.dropped += self._frame is not None
        self.epoch = epoch
        self._forget_epoch()

    def put_frame(self, frame: PairedFrame, now: float) -> None:
        """Make a frame the next one; a frame already waiting is dropped: the engine is behind."""
        message, waiting = frame.message, self._frame
        self._counters.dropped += waiting is not None
        job = FrameJob(
            self.robot,
            self.epoch,
            message.stamp_ns,
            message.points,
            frame.T_odom_body,
            times=message.times,
            segment=frame.segment,
            defer=waiting is not None,
            first_epoch=self._first_epoch,
        )
        self._frame = QueuedFrame(job, frame, now if waiting is None else waiting.waiting_since)

    @property
    def has_frame(self) -> bool:
        """Whether a frame may be taken; read without the lock, so it may be gone."""
        return self._frame is not None and self._frame_under_way is None

    @property
    def has_result(self) -> bool:
        """Whether a search result waits for a frame; read without the lock, so it may be gone."""
        return self._search_result is not None and self._frame_under_way is None

    @property
    def searching(self) -> bool:
        """Whether a search is waiting or running."""
        return self._request is not None or self._searching_since is not None

    @property
    def idle(self) -> bool:
        """Whether nothing is waiting or under way."""
        waiting = (self._frame, self._frame_under_way, self._search_result, self._request, self._searching_since)
        return all(work is None for work in waiting)

    def take_result(self) -> FrameJob | None:
        """Hand out a search result without a frame; None without one, or while a frame waits or is under way."""
        done, result = self._frame_done, self._search_result
        if result is None or done is None or self._frame is not None or self._frame_under_way is not None:
            return None
        job = replace(
            done.job, points=None, search_result=result, require_verification=False, hint=None, guess=None,
            calibration=None,
        )  # fmt: skip
        self._frame_under_way, self._search_result = done._replace(job=job), None
        return job

    def take_frame(self, require_verification: bool, hints: PlaceHints) -> FrameJob | None:
        """Hand out the newest frame with any search result; None without one, or while one is under way."""
        if self._frame is None or self._frame_under_way is not None:
            return None
        hint = hints.pending
        job = replace(
            self._frame.job,
            require_verification=require_verification,
            search_result=self._search_result,
            hint=hint,
            guess=hints.pending_guess,
            calibration=None if hint is None else hints.calibration,
        )
        self._frame_under_way = self._frame._replace(job=job)
        self._frame = self._search_result = None
        return job

    def frame_done(self, job: FrameJob, result: FrameResult, now: float) -> QueuedFrame | None:
        """Count a frame's fix and queue its search request; return the frame if its fix still matters."""
        if job.epoch < self._first_epoch:
            return None
        if job.points is not None:
            self._counters.processed += 1
            self.processed_at = now
            self.engine_latency.add(result.seconds)
        frame = self._frame_under_way
        if job.epoch != self.epoch or frame is None:
            return None
        self._frame_under_way, self._doubting, self._frame_done = None, None, frame
        if job.points is not None:
            self.latency.add(now - frame.paired.received)
            self.longest_wait = max(self.longest_wait, now - frame.waiting_since)
        if result.fix.state.has_place:
            self._request = self._requested_at = self.considered = None
        if result.request is not None:
            self.put_search_request(result.request, now)
        return frame

    def frame_failed(self, job: FrameJob, reason: str, rejected: bool) -> bool:
        """Count a useless frame (``rejected``) or an engine failure at it; return whether that still matters."""
        if job.epoch < self._first_epoch:
            return False
        self._counters.count("rejected" if rejected else "engine_errors")
        kind = "frames of no use" if rejected else "frames that the engine failed at"
        self._errors.add_first(f"{self.robot}: {kind}", last_line(reason))
        if job.epoch != self.epoch:
            return False
        self._frame_under_way = self._doubting = None
        if job.points is not None:
            # the engine may not have applied this result: the next frame carries it again; a second time is harmless
            self._search_result = self._search_result or job.search_result
        return True

    def note_doubt(self, job: Job) -> None:
        """Note that the frame of a job contradicts the place."""
        self._doubting = job

    @property
    def in_doubt(self) -> bool:
        """Whether the frame under way contradicts the place."""
        return self._frame_under_way is not None and self._frame_under_way.job is self._doubting

    def put_search_request(self, request: SearchRequest, now: float) -> None:
        """Make a request the next one; a request already waiting is skipped, and its waiting time continues."""
        self._counters.searches_skipped += self._request is not None
        if request.epoch != self._search_epoch:
            self._search_epoch, self._requested_at = request.epoch, None
            self._searches = self._support = 0
        waiting = self._request
        if waiting is not None and waiting.epoch == request.epoch and not request.earlier:
            request = replace(request, earlier=waiting.earlier)  # keyframes from before the search restarted
        self._request = request
        self._requested_at = now if self._requested_at is None else self._requested_at

    def pending_search(self, now: float) -> str:
        """Return how long a search has waited or run, and the number of dropped frames; empty without a search."""
        since = self._requested_at if self._searching_since is None else self._searching_since
        if since is None:
            return ""
        dropped, received = self._counters.dropped, self._counters.received
        behind = f": this machine is too slow or busy, {dropped} of {received} clouds were dropped" if dropped else ""
        return f"a search of the map waits or runs since {max(0.0, now - since):.0f} s{behind}"

    @property
    def search_demand(self) -> SearchDemand | None:
        """The robot's demand for a search; None without a keyframe or while a search runs. Read without the lock."""
        since = self._requested_at
        if since is None or self._searching_since is not None:
            return None
        return SearchDemand(since, self._searches, self._support)

    def take_search_request(self) -> SearchJob | None:
        """Hand out the newest request; None without one, or while one is under way."""
        if self._request is None or self._searching_since is not None:
            return None
        job = SearchJob(self.robot, self._request)
        self._searching_since = self._requested_at
        self._request = self._requested_at = None
        return job

    def search_done(self, job: SearchJob, result: SearchResult, now: float) -> None:
        """Count a search; the next frame carries its result.

        A waiting acceptance takes precedence over a later result, which comes from a restarted search.
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
            self._request = self._requested_at = None  # no search for a keyframe that came meanwhile
        if job.request.epoch == self._search_epoch:
            self._searches += 1
            self._support = self._support + 1 if result.evidence.state is State.AMBIGUOUS else 0
        if self._search_result is None or self._search_result.accepted is None:
            self._search_result = result

    def search_failed(self, job: SearchJob, reason: str) -> None:
        """Count a failed search; only this keyframe's vote is lost."""
        if job.epoch < self._first_epoch:
            return
        self._counters.search_errors += 1
        self._errors.add_first(f"{self.robot}: failed searches", last_line(reason))
        if job.epoch == self.epoch:
            self._searching_since = None
