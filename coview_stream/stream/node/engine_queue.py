"""One robot's frames, search requests and hints for the engines, their jobs, and the order of robots at an engine."""

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

# of searches
_PATIENCE = 1.5  # seconds after which a waiting keyframe comes before all that have waited less
_NEW = 8  # searches in which a robot counts as newly lost; most are found within them
_MAX_SUPPORT = 16  # searches in a row that propose a place: with more, the map has another one like it


@dataclass(frozen=True)
class FrameJob:
    """One lidar frame for the tracking engine."""

    robot: str  # name
    epoch: int  # number of the robot's odometry frame; a new one makes the engine forget the robot's place
    stamp_ns: int  # sensor time, nanoseconds
    points: Points | None  # (N, 3) float32 body frame, metres; None: the frame before, and another search's result
    T_odom_body: Pose  # (4, 4) odometry at the stamp
    times: Floats | None = None  # (N,) seconds after the stamp at which each point was measured; None for no deskewing
    segment: Segment | None = None  # odometry while the frame was measured; goes with ``times``
    require_verification: bool = False  # give no pose before this frame has verified the place
    search_result: SearchResult | None = None  # of an earlier search, to be applied first
    defer: bool = False  # frames wait for the engine: put off all work that can wait
    # (4, 4) ``T_map_body`` where the robot may be at this frame, to be verified like any hypothesis
    hint: Pose | None = None
    guess: PlaceGuess | None = None  # of the place; tried, never trusted
    calibration: Calibration | None = None  # of its sensor and odometry at ``hint``, a prior
    # the first one since a client reset the robot; another one makes the engine forget the calibration as well
    first_epoch: int = 0


@dataclass(frozen=True)
class FrameResult:
    """The tracking engine's answer to a frame."""

    fix: Fix  # after the frame
    request: SearchRequest | None  # keyframe to search for; None for none
    seconds: float  # of the engine's work
    events: tuple[Event, ...]  # changes of the engine's state since its last answer for this robot and epoch, in order


@dataclass(frozen=True)
class SearchJob:
    """One keyframe of a robot for the search engine."""

    robot: str
    request: SearchRequest

    @property
    def epoch(self) -> int:
        """Epoch of the frame's job."""
        return self.request.epoch[0]


Job: TypeAlias = FrameJob | SearchJob | OdometryJob
Result: TypeAlias = FrameResult | SearchResult | OdometryResult


class SearchDemand(NamedTuple):
    """A robot's waiting keyframe, for the order of searches."""

    since: float  # local time in seconds from which a keyframe has been waiting, this one or one that it replaced
    searches: int = 0  # number of searches since the robot was lost
    support: int = 0  # how many of the newest of them, in a row, proposed a place


def search_order(demands: Sequence[SearchDemand | None], now: float) -> list[int]:
    """Return the robots of ``demands`` that want a search, in the order of their turns at local time ``now``.

    A keyframe that has waited for 1.5 s comes first, the oldest before the others: no robot waits much longer, unless
    the engine cannot keep up, and then all wait equally long. Otherwise a robot whose place has been proposed, which
    needs the fewest further searches, comes before the newly lost, and these before the long lost.
    """

    def rank(demand: SearchDemand) -> tuple[bool, int, bool, float]:
        overdue = now - demand.since >= _PATIENCE
        support = demand.support if demand.support <= _MAX_SUPPORT and not overdue else 0
        new = overdue or demand.searches < _NEW
        return not overdue, -support, not new, demand.since

    return [k for _, k in sorted((rank(demand), k) for k, demand in enumerate(demands) if demand is not None)]


class RoundRobin:
    """Order in which robots, numbered from 0, are served by one engine: the longest wait first."""

    def __init__(self, count: int) -> None:
        self._order = list(range(count))

    def order(self) -> list[int]:
        """Return the robots in the order in which they may be served now."""
        return list(self._order)

    def serve(self, k: int) -> None:
        """Count the turn that robot ``k`` has now."""
        self._order.remove(k)
        self._order.append(k)


class PlaceHints:
    """Hints for the engine: the last place and a guess, each once in every odometry epoch.

    Attributes:
        forgotten: number of times that a client has asked to forget the place.
        T_map_body: (4, 4) of the last place, whether the engine has it or not; None for none.
        calibration: of the sensor and odometry there; goes with the pose, as a prior.
        guess: the newest one, until the place is known.
        pending_guess: the same, until a frame has taken it to the engine.
    """

    def __init__(self) -> None:
        self.forgotten = 0
        self.guess: PlaceGuess | None = None
        self.pending_guess: PlaceGuess | None = None
        self.drop()

    def drop(self) -> None:
        """Never offer this pose again; only a new one."""
        self.T_map_body: Pose | None = None
        self.calibration: Calibration | None = None
        self._pending = False

    @property
    def pending(self) -> Pose | None:
        """``T_map_body`` (4, 4) that goes with the next frame; None if the engine has it already."""
        return self.T_map_body if self._pending else None

    def offer(self, T_map_body: Pose, calibration: Calibration | None) -> None:
        """Take over a pose from before this session, which the engine does not know."""
        self.T_map_body, self.calibration, self._pending = T_map_body, calibration, True

    def offer_guess(self, guess: PlaceGuess | None) -> None:
        """Take over a guess in place of the one before."""
        self.guess = self.pending_guess = guess

    def verified(self, T_map_body: Pose, calibration: Calibration | None) -> None:
        """Take over a pose that the engine itself has verified."""
        self.T_map_body, self.calibration, self._pending = T_map_body, calibration, False
        self.guess = None

    def begin_epoch(self) -> None:
        """Offer all again: the engine forgets everything with an odometry frame, but the robot stands where it stood.

        A guess loses its circle, for it is not known how far the robot has come.
        """
        self._pending = self.T_map_body is not None
        self.offer_guess(None if self.guess is None else replace(self.guess, within=None))

    def delivered(self, hint: Pose | None, guess: PlaceGuess | None) -> None:
        """Offer no more the pose and the guess that went with a frame."""
        if hint is self.T_map_body:
            self._pending = False
        if guess is self.pending_guess:
            self.pending_guess = None

    def forget(self) -> None:
        """Drop everything because a client asks; the file for the next start is to go as well."""
        self.drop()
        self.offer_guess(None)
        self.forgotten += 1


class QueuedFrame(NamedTuple):
    """A frame for the tracking engine, waiting or under way."""

    job: FrameJob  # the frame, as the engine gets it
    paired: PairedFrame  # the frame with its odometry
    waiting_since: float  # local time from which on a frame of this robot has been waiting


class EngineQueue:
    """One robot's work for the engines, from one reset of its session to the next; the session holds the lock.

    Of frames and of search requests only the newest waits, and one of each is under way. The result of a search waits
    here too: it goes to the tracking engine with the next frame. Jobs issued before a reset are ignored; jobs of an old
    odometry epoch are only counted.
    """

    def __init__(self, robot: str, epoch: int, counters: Counters, errors: ErrorLog) -> None:
        """Begin with nothing to do in odometry epoch ``epoch``, which no job of this robot has had before."""
        self.robot = robot
        self._first_epoch = self.epoch = epoch  # number of the robot's odometry frame
        self._counters = counters
        self._errors = errors
        self.latency = Latency()  # from the arrival of a cloud to its fix
        self.engine_latency = Latency()  # the engine's part of it
        self.longest_wait = 0.0  # most seconds that a frame of this robot has been waiting
        # most seconds from a keyframe to the end of its search; it inherits the wait of one that it replaces
        self.longest_search_wait = 0.0
        self.processed_at: float | None = None  # local time of the newest fix
        self._search_epoch: Epoch | None = None
        self._searches = self._support = 0  # in that epoch, as of SearchDemand
        self._forget_epoch()

    def _forget_epoch(self) -> None:
        self.considered: Considered | None = None  # places of the newest search; None once there is a place
        self._frame: QueuedFrame | None = None
        self._frame_under_way: QueuedFrame | None = None
        self._doubting: Job | None = None  # the job under way, if it contradicts the place
        self._frame_done: QueuedFrame | None = None  # the newest one
        self._search_result: SearchResult | None = None
        self._request: SearchRequest | None = None
        self._requested_at: float | None = None  # local time from which a keyframe has been waiting
        self._searching_since: float | None = None  # the same of the keyframe under way

    def begin_epoch(self, epoch: int) -> None:
        """Drop all frames and requests, waiting or under way: there is another odometry frame."""
        self._counters.dropped += self._frame is not None
        self.epoch = epoch
        self._forget_epoch()

    def put_frame(self, frame: PairedFrame, now: float) -> None:
        """Make a frame the next one; a frame that waits already is dropped, and the engine is behind."""
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
        """Whether a frame may be taken; without the lock: perhaps no more."""
        return self._frame is not None and self._frame_under_way is None

    @property
    def has_result(self) -> bool:
        """Whether the result of a search waits for a frame; without the lock: perhaps no more."""
        return self._search_result is not None and self._frame_under_way is None

    @property
    def searching(self) -> bool:
        """Whether a search waits or is under way."""
        return self._request is not None or self._searching_since is not None

    @property
    def idle(self) -> bool:
        """Whether nothing waits and nothing is under way."""
        waiting = (self._frame, self._frame_under_way, self._search_result, self._request, self._searching_since)
        return all(work is None for work in waiting)

    def take_result(self) -> FrameJob | None:
        """Hand out the result of a search without a frame; None without one, or while a frame waits or is under way."""
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
        """Hand out the newest frame, with the result of a search if one has come; None while one is under way."""
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
        """Count a frame of no use (``rejected``) or an engine's failure at it; return whether that still matters."""
        if job.epoch < self._first_epoch:
            return False
        self._counters.count("rejected" if rejected else "engine_errors")
        kind = "frames of no use" if rejected else "frames that the engine failed at"
        self._errors.add_first(f"{self.robot}: {kind}", last_line(reason))
        if job.epoch != self.epoch:
            return False
        self._frame_under_way = self._doubting = None
        if job.points is not None:
            # perhaps not applied: it goes with the next frame too, and applied twice it changes nothing
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
        """Make a request the next one; a request that waits already is skipped, and its wait goes on."""
        self._counters.searches_skipped += self._request is not None
        if request.epoch != self._search_epoch:
            self._search_epoch, self._requested_at = request.epoch, None
            self._searches = self._support = 0
        waiting = self._request
        if waiting is not None and waiting.epoch == request.epoch and not request.earlier:
            request = replace(request, earlier=waiting.earlier)  # keyframes of before the search began anew
        self._request = request
        self._requested_at = now if self._requested_at is None else self._requested_at

    def pending_search(self, now: float) -> str:
        """Return how long the search that waits or runs has taken, and the frames dropped so far; empty for none."""
        since = self._requested_at if self._searching_since is None else self._searching_since
        if since is None:
            return ""
        dropped, received = self._counters.dropped, self._counters.received
        behind = f": this machine is too slow or busy, {dropped} of {received} clouds were dropped" if dropped else ""
        return f"a search of the map waits or runs since {max(0.0, now - since):.0f} s{behind}"

    @property
    def search_demand(self) -> SearchDemand | None:
        """Demand for a search; None without a keyframe, or while a search is under way. Without the lock."""
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

        An acceptance that still waits goes before a later result, which comes from a search that began again.
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
            self._request = self._requested_at = None  # a keyframe that came meanwhile need not be searched for
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
