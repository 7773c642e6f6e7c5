"""A localizer whose calls never wait: the tracking and search engines of a node run in their own processes."""

from __future__ import annotations

import logging
import os
import threading
import time
import weakref
from dataclasses import replace
from typing import NamedTuple, NoReturn

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CoViewError, InputError
from coview_stream.geometry.arrays import Reals
from coview_stream.geometry.protection import protection_level
from coview_stream.geometry.transforms import Pose, inverse, yaw_of
from coview_stream.geometry.validation import validate_cloud, validate_odometry, validate_pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.frame import StepCheck
from coview_stream.localization.localizer import JUMPED, checked_arguments
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.saved_state import SavedState
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.hints import PlaceGuess, require_ground
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.messages.types import CloudMessage
from coview_stream.stream.node.counters import Counters, ErrorLog, last_line
from coview_stream.stream.node.engine_feed import EngineFeed
from coview_stream.stream.node.engine_process import EngineProcess
from coview_stream.stream.node.engine_queue import (
    EngineQueue,
    FrameJob,
    FrameResult,
    Job,
    PlaceHints,
    Result,
    SearchJob,
)
from coview_stream.stream.node.inputs import PairedFrame
from coview_stream.stream.transport.error_guard import RateLimitedErrors

_NAME = "the robot"  # in log lines
_MAX_UNSEEN = 5.0  # seconds on odometry alone, as NodeConfig.dead_reckoning_timeout
_STEP = 0.05  # seconds between checks of engines that are not ready
_CLOSE_TIMEOUT = 1.0  # seconds for the threads to end, all together

log = logging.getLogger("coview_stream")


class AsyncLocalizer(SavedState):
    """A localizer whose calls never wait: search and registration run in child processes.

    Two processes do the work of a :class:`~coview_stream.localization.localizer.Localizer`: one searches, the other
    does the rest. Both memory-map the map file. They are new interpreters: the script needs no ``__main__`` guard.
    :meth:`step` hands over a frame and returns the newest known pose, carried to that frame by odometry.
    Close it, or use it in a ``with`` block.

    Attributes:
        engines: the processes, by name: ``track`` and ``search``.
    """

    def __init__(self, base_map: BaseMap | str | os.PathLike[str], config: LocalizerConfig | None = None) -> None:
        """Start the processes, which take some seconds to be ready: see :meth:`prepare`.

        Args:
            base_map: the path of a ``.coview`` file, or a map that was loaded from one.
            config: how decisions are made; None: the defaults.

        Raises:
            As :class:`~coview_stream.localization.localizer.Localizer`. InputError: the map is not in a file.
        """
        self.base_map, self.config = checked_arguments(base_map, config)
        if self.base_map.path is None:
            raise InputError("the map is in no file; save it, and give the path: other processes read it from there")
        SearchIndex.of(self.base_map, self.config, load=False)  # errors show here, not in the children
        protection_level(np.eye(6))  # imports SciPy now
        self._mailbox = Mailbox()
        path, sha256 = str(self.base_map.path), self.base_map.sha256
        self.engines = {kind: EngineProcess(kind, path, sha256, self.config) for kind in ("track", "search")}
        self._feed: EngineFeed[Mailbox] = EngineFeed(
            [self._mailbox], self.engines, RateLimitedErrors(log), lambda robot: None
        )
        for engine in self.engines.values():
            engine.start()
        self._feed.start()
        self._pid = os.getpid()
        self._end = weakref.finalize(self, _end, self._feed, self._pid)

    def prepare(self, timeout: float | None = None) -> None:
        """Wait until the processes have opened the map; on a machine's first run they also compile their kernels.

        Raises:
            CoViewError: a process failed; the text says why. TimeoutError: not ready after ``timeout`` seconds.
        """
        self._check_usable()
        end = time.monotonic() + (float("inf") if timeout is None else timeout)
        while not all(engine.ready for engine in self.engines.values()):
            self._mailbox.raise_error()
            if time.monotonic() > end:
                raise TimeoutError(f"the processes are not ready after {timeout:g} s")
            time.sleep(_STEP)

    def step(self, cloud: Reals, T_odom_body: Pose, stamp: float) -> Fix:
        """Hand over one more frame and return at once; arguments as for ``Localizer.step``.

        If frames come faster than they are processed, the newest replaces the waiting one (:attr:`skipped`).

        Returns:
            The fix at this frame: see :meth:`fix`.

        Raises:
            CloudError, RunError: as ``Localizer.step``; nothing changes. CoViewError: a process died, which is then
                restarted, or failed at an earlier frame; if it was the tracking process, the place is searched for
                again. Only the first failure since the last call is raised. This frame has been accepted: continue.
        """
        self._check_usable()
        self._mailbox.add_frame(cloud, T_odom_body, stamp)
        try:
            return self.fix()
        finally:
            self._feed.wake_for(self._mailbox)  # last: a thread that wakes earlier would delay this one

    def fix(self) -> Fix:
        """Return the fix at the newest frame from all results so far; RuntimeError before the first frame.

        The pose is the newest fix of the tracking process, carried on by odometry: covariance and protection level grow
        with odometry drift since then. ``fix.evidence.stamp`` is the stamp of the newest registration. There is no
        pose (DOUBTED) if no frame of the last 5 s has been processed, or while a frame contradicts the place.

        Raises:
            CoViewError: as for :meth:`step`.
        """
        self._check_usable()
        self._mailbox.raise_error()
        return self._mailbox.fix()

    def wait(self, timeout: float | None = None) -> Fix:
        """Wait until all frames have been processed, and any search is done; return :meth:`fix`.

        Called after each step, it gives the fixes of a ``Localizer``. TimeoutError after ``timeout`` seconds.
        """
        self._check_usable()
        if not self._mailbox.wait(timeout):
            raise TimeoutError(f"the newest frame has not been worked on after {timeout:g} s")
        return self.fix()

    @property
    def state(self) -> State:
        """The state of the newest fix."""
        return self._mailbox.state

    @property
    def searching(self) -> bool:
        """Whether a search of the map is waiting or running."""
        return self._mailbox.searching

    @property
    def calibration(self) -> Calibration:
        """The newest calibration of sensor and odometry, and the site's ground offset."""
        return self._mailbox.calibration or Calibration()

    @property
    def skipped(self) -> int:
        """Number of frames that a newer one replaced before they were processed."""
        return self._mailbox.counters.dropped

    def reset(self) -> None:
        """Forget everything but the map; the next frame may use another odometry."""
        self._check_usable()
        self._mailbox.begin(keep_calibration=False)

    def relocalize(self) -> None:
        """Forget the place and search the whole map again; the calibration stays."""
        self._check_usable()
        self._mailbox.begin(keep_calibration=True)

    def hint_pose(self, T_map_body: Pose) -> None:
        """Suggest that the robot may be here at the next frame; as ``Localizer.hint_pose``."""
        self._check_usable()
        validate_pose(T_map_body, self.base_map.origin)
        with self._mailbox.changed:
            self._mailbox.hints.offer(np.array(T_map_body, dtype=np.float64), None)

    def guess_place(self, guess: PlaceGuess) -> None:
        """Let the search try a guess of the robot's place; as ``Localizer.guess_place``."""
        self._check_usable()
        require_ground(guess, self.base_map)
        with self._mailbox.changed:
            self._mailbox.hints.offer_guess(guess)

    def hint_calibration(self, earlier: Calibration) -> None:
        """Start from an earlier calibration of this robot; as ``Localizer.hint_calibration``."""
        self._check_usable()
        with self._mailbox.changed:
            self._mailbox.earlier = earlier.require_plausible()

    def close(self) -> None:
        """End the processes; a second call does nothing."""
        self._end()

    def __enter__(self) -> AsyncLocalizer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        raise TypeError("an AsyncLocalizer cannot be pickled or copied: make one in each process")

    def _check_usable(self) -> None:
        if os.getpid() != self._pid:
            raise CoViewError("this AsyncLocalizer belongs to the process that forked this one; make one here")
        if not self._end.alive:
            raise CoViewError("this AsyncLocalizer has been closed")


def _end(feed: EngineFeed[Mailbox], pid: int) -> None:
    if os.getpid() == pid:  # a forked process leaves its parent's children alone
        feed.close(_CLOSE_TIMEOUT)


class _Frame(NamedTuple):
    """A frame's odometry."""

    stamp: float
    T_odom_body: Pose
    travelled: float  # metres driven since the start
    turned: float  # radians turned since the start


class Mailbox:
    """The caller's frames on their way to the engines, and the newest fix on its way back, behind one lock.

    The engine feed handles it as it does a node's robot. It has no thread or process; its clock serves statistics only.
    """

    def __init__(self) -> None:
        self.counters, self.errors = Counters(), ErrorLog()
        self.calibration: Calibration | None = None
        self.earlier: Calibration | None = None  # sent with the next frame
        self.changed = threading.Condition()
        self._epoch = 0
        self._error: str | None = None  # not raised yet
        self._search_told = False  # whether the search engine's restart has reported the running search as failed
        self.begin(keep_calibration=False)

    # ---- called by AsyncLocalizer

    def begin(self, keep_calibration: bool) -> None:
        """Start a new epoch without a place."""
        with self.changed:
            self._epoch += 1
            self.hints = PlaceHints()
            if keep_calibration:
                self.queue.begin_epoch(self._epoch)
            else:
                self.queue: EngineQueue = EngineQueue(_NAME, self._epoch, self.counters, self.errors)
                self.calibration = self.earlier = None
                self._steps = StepCheck()
            self._newest: _Frame | None = None
            self._lost: KeyframeEvidence | None = None  # why the place was lost; None once a fix has a pose again
            self._forget_fix()

    def _forget_fix(self) -> None:
        self._fix: Fix | None = None
        self._fixed: _Frame | None = None  # the frame of that fix
        self._frames: dict[int, _Frame] = {}  # by stamp in nanoseconds, from the frame being processed on

    def add_frame(self, cloud: Reals, T_odom_body: Pose, stamp: float) -> None:
        """Check a frame and queue it for the engine; a jump of odometry starts another epoch. Errors as in ``step``."""
        points = validate_cloud(cloud)
        with self.changed:
            last = self._newest
            T = validate_odometry(T_odom_body, stamp, None if last is None else last.stamp)
            if self._steps.add(T, stamp):
                place = None if last is None else self.fix().T_map_body
                self.begin(keep_calibration=True)
                self._lost = KeyframeEvidence(stamp, State.LOST, JUMPED, cause=RejectionReason.ODOMETRY)
                if place is not None:
                    self.hints.offer(place, None)
                last = None
            driven = turned = 0.0
            if last is not None:
                step = inverse(last.T_odom_body) @ T
                driven, turned = last.travelled + float(np.linalg.norm(step[:3, 3])), last.turned + abs(yaw_of(step))
            self._newest = _Frame(float(stamp), T, driven, turned)
            message = CloudMessage(round(stamp * 1e9), points)
            self._frames[message.stamp_ns] = self._newest
            now = time.monotonic()
            self.queue.put_frame(PairedFrame(message, now, T, None, driven, turned), now)

    def raise_error(self) -> None:
        """Raise the first engine failure since the last call."""
        with self.changed:
            error, self._error = self._error, None
        if error is not None:
            raise CoViewError(error)

    def wait(self, timeout: float | None) -> bool:
        """Wait until nothing is left to do or an engine fails; False after ``timeout`` seconds."""
        with self.changed:
            return self.changed.wait_for(lambda: self.queue.idle or self._error is not None, timeout)

    @property
    def state(self) -> State:
        """The engine's state, unless it is out of date."""
        with self.changed:
            if self._fix is None or (self._lost is not None and not self._fix.state.has_place):
                return State.SEARCHING if self._lost is None else State.LOST
            outdated = self._fix.state is State.TRACKING and (self._unseen > _MAX_UNSEEN or self.queue.in_doubt)
            return State.DOUBTED if outdated else self._fix.state

    @property
    def searching(self) -> bool:
        """Whether a search is waiting or running."""
        with self.changed:
            return self.queue.searching

    @property
    def _unseen(self) -> float:
        """Seconds from the newest processed frame to the newest frame."""
        return 0.0 if self._newest is None or self._fixed is None else self._newest.stamp - self._fixed.stamp

    def fix(self) -> Fix:
        """Return the fix at the newest frame."""
        with self.changed:
            newest, fix, at, state = self._newest, self._fix, self._fixed, self.state
            lost, unseen, calibration = self._lost, self._unseen, self.calibration
        if newest is None:
            raise RuntimeError("no frame yet; call step first")
        if fix is None or at is None or (state is State.LOST and lost is not None):
            evidence = None if fix is None else fix.evidence  # newer than the loss: says why the place is not regained
            return Fix(newest.stamp, state, evidence=evidence or lost, calibration=calibration)
        if state is State.TRACKING:
            if newest is at:
                return replace(fix, stamp=newest.stamp)
            driven, turned = newest.travelled - at.travelled, newest.turned - at.turned
            return fix.carried(newest.stamp, newest.T_odom_body, driven, turned)
        if state is not fix.state:
            reason = f"no frame of the last {unseen:.1f} s has been worked on"
            if unseen <= _MAX_UNSEEN:
                reason = "a frame speaks against the place, and others are tried"
            return Fix(newest.stamp, state, evidence=KeyframeEvidence(at.stamp, state, reason), calibration=calibration)
        return replace(fix, stamp=newest.stamp)

    # ---- called by the engine feed

    def has_job(self, engine: str) -> bool:
        """Whether ``track`` has a frame or a search result to process, or ``search`` a keyframe."""
        if engine == "track":
            return self.queue.has_frame or self.queue.has_result
        return self.queue.search_demand is not None

    def take_job(self, engine: str) -> Job | None:
        """Hand out the newest frame, else a search result; for ``search`` the newest keyframe."""
        with self.changed:
            if engine == "search":
                self._search_told = False
                return self.queue.take_search_request()
            job = self.queue.take_frame(False, self.hints)
            if job is None:
                return self.queue.take_result()
            return job if self.earlier is None else replace(job, calibration=self.earlier)

    def handle_result(self, job: Job, result: Result, now: float) -> None:
        """Apply the result of a job."""
        with self.changed:
            if isinstance(job, FrameJob) and isinstance(result, FrameResult):
                if self.queue.frame_done(job, result, now) is not None:
                    self._apply(job, result.fix)
            elif isinstance(job, SearchJob) and isinstance(result, SearchResult):
                self.queue.search_done(job, result, now)
            self.changed.notify_all()

    def _apply(self, job: FrameJob, fix: Fix) -> None:
        self.hints.delivered(job.hint, job.guess)
        if job.calibration is self.earlier:
            self.earlier = None
        self._fix, self._fixed = fix, self._frames.get(job.stamp_ns)
        self._frames = {stamp: frame for stamp, frame in self._frames.items() if stamp >= job.stamp_ns}
        self.calibration = fix.calibration or self.calibration
        if fix.T_map_body is not None:
            self._lost = None
            self.hints.verified(fix.T_map_body, self.calibration)

    def note_doubt(self, job: Job) -> None:
        """Withhold poses until the result of a job comes: its frame contradicts the place."""
        with self.changed:
            self.queue.note_doubt(job)

    def handle_failure(self, job: Job, reason: str, rejected: bool = False) -> None:
        """Keep the failure for the caller; restart the search if the tracking engine has forgotten the robot."""
        with self.changed:
            if isinstance(job, FrameJob):
                if self.queue.frame_failed(job, reason, rejected):
                    self._fail(f"the tracking process failed at a frame: {last_line(reason)}", not rejected)
            elif isinstance(job, SearchJob):
                self.queue.search_failed(job, reason)
                if not self._search_told:
                    self._fail(f"a search failed: {last_line(reason)}", searches=False)
            self.changed.notify_all()

    def engine_restarted(self, engine: str = "track", why: str = "it died") -> None:
        """Keep the restart for the caller; restart the search too if it was the tracking engine."""
        with self.changed:
            self._fail(f"{why}; it is started again", searches=engine == "track")
            self._search_told = self._search_told or engine == "search"
            self.changed.notify_all()

    def _fail(self, error: str, searches: bool) -> None:
        """Keep an error; if the engine ``searches`` anew, start another epoch with the last place as a hint."""
        self._error = self._error or error  # the first since the last call
        if not searches:
            return
        had_place = self._lost is not None or self.state.has_place
        self._epoch += 1
        self.queue.begin_epoch(self._epoch)
        self.hints.begin_epoch()
        self._forget_fix()
        if had_place and self._newest is not None:
            self._lost = KeyframeEvidence(self._newest.stamp, State.LOST, error)
