"""The localizer: frames and odometry in, fixes out. No clock, no network, no threads."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import replace
from typing import NoReturn

import coview_kernels as kernels
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.arrays import Reals
from coview_stream.geometry.transforms import Circle, Pose, inverse, orthonormal, pose_from
from coview_stream.geometry.validation import validate_pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.frame import FramePreparation, PreparedFrame
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.saved_state import SavedState
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.advice import AdvisedSearch
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.hints import PlaceGuess, require_ground, robot_position
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import LostPlace, SearchRequest
from coview_stream.localization.search_requests import NoSearch, SearchRequests
from coview_stream.localization.state import Event, State, next_state
from coview_stream.localization.tracking.map_matching import MapMatch
from coview_stream.localization.tracking.monitor import LossMonitor, RejectionReason, Ruling
from coview_stream.localization.tracking.tracker import Tracker
from coview_stream.localization.witness.first_motions import DOUBT
from coview_stream.localization.witness.witness import Witness

JUMPED = "searching anew: odometry jumped"
_DEFERRED = 3.0  # factor on the metres, radians and seconds between registrations where the caller is behind


class Localizer(SavedState):
    """Localization of one robot on a base map (paper, eqs 1-13, and a pose graph from the first fix on).

    Attributes:
        base_map: the map; may be shared by many localizers.
        config: settings of the decisions.
        state: present state of localization.
        search: the search; ``names`` are those of its recognizers, ``last_query`` the newest keyframe's descriptors.
    """

    def __init__(
        self,
        base_map: BaseMap | str | os.PathLike[str],
        config: LocalizerConfig | None = None,
        local_maps: LocalMaps | None = None,
        index: SearchIndex | None = None,
    ) -> None:
        """Localize on a map.

        Args:
            base_map: the map, or the path of its ``.coview`` file, which is loaded and checked.
            config: settings of the decisions; None takes the defaults.
            local_maps: cache of map crops; localizers of one thread may share it.
            index: data of the search's recognizers, which localizers of one map may share; None builds it.

        Raises:
            ConfigError, InputError: ``config`` or ``base_map`` has another type.
            MapError, InputError: the file cannot be loaded, or ``config.reloc`` is ``learned``, which cannot be used.
        """
        self.base_map, self.config = checked_arguments(base_map, config)
        self._local_maps = local_maps or LocalMaps(self.base_map, self.config.registration.source_range)
        self.search = AdvisedSearch(self.base_map, self.config, self._local_maps, index)
        self._restarts = itertools.count(1)
        self.reset()

    def reset(self, epoch: int = 0) -> None:
        """Forget everything but the map; ``epoch`` is the number of the next odometry frame."""
        self._frames = FramePreparation(self.config)
        self._tracker = Tracker(self.base_map, self.config, self._local_maps, self._frames.estimator)
        self.relocalize(epoch)

    def relocalize(self, epoch: int | None = None) -> None:
        """Forget the place and search the whole map: the next fixes have no pose until a place is accepted.

        The calibration of sensor and odometry and the site's ground offset stay. ``epoch`` is the number of the next
        odometry frame; None if odometry continues.
        """
        odometry = self._requests.epoch.odometry if epoch is None else epoch
        ground = self._tracker.ground.metres
        self._frames.restart()
        self.search.reset()
        self._requests: SearchRequests = SearchRequests(
            self.base_map, self.config, self.search.spec, self._frames, odometry, self._restarts
        )
        self._tracker = Tracker(self.base_map, self.config, self._local_maps, self._frames.estimator)
        self._tracker.ground.restore(ground)
        self.state = State.SEARCHING
        self._events: list[Event] = []  # since take_events
        self._monitor = LossMonitor(self.config.acceptance, self.config.tracking)
        self._witness = Witness(self.config.registration, self._frames.estimator)
        self._newest: PreparedFrame | None = None
        self._evidence: KeyframeEvidence | None = None
        self._confidence = 0.0  # of the search's acceptance
        self._wrong = 0.0  # probability that the place is wrong, by the newest registration
        self._registered_at = 0.0  # stamp of the newest registration
        self._cut_short = False  # an exception has ended the newest frame

    def __repr__(self) -> str:
        """Return the state, the stamp of the newest frame and the map, in one line."""
        newest = "no frame yet" if self._newest is None else f"frame of {self._newest.stamp:.3f} s"
        return f"Localizer({self.state}, {newest}, on {self.base_map!r})"

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a Localizer cannot be pickled or copied: make one in each process, Localizer(base_map); a BaseMap that "
            "was loaded from a file pickles as its path"
        )

    @property
    def calibration(self) -> Calibration:
        """The present calibration of sensor and odometry, and the site's ground offset."""
        ground, changed = self._tracker.ground.metres, self._tracker.change.metres
        return replace(self._frames.calibration, ground=ground, changed=changed)

    @property
    def sensor_fault(self) -> float:
        """Probability of a fault in clouds or odometry, by the newest comparison."""
        return 1.0 if self._frames.conventions.finding is not None else self._witness.faults.sensors

    def prepare(self) -> None:
        """Load data and compile kernels ahead of the first search and registrations; takes some seconds, once.

        Raises:
            InputError: the network of the learned features cannot be loaded.
        """
        kernels.warm_up(*GlobalSearch.KERNELS, "nearest")  # tracking needs "nearest" too
        self.search.prepare()

    # ---- one frame

    def step(self, cloud: Reals, T_odom_body: Pose, stamp: float) -> Fix:
        """Localize one more frame; docs/method.md describes the steps.

        Args:
            cloud: (N, 3) float32 or float64 body-frame points (x forward, z up), deskewed, metres, or (N, 4) with
                unused intensities; rows with NaN are dropped.
            T_odom_body: (4, 4) odometry pose of the frame, gravity aligned, metres.
            stamp: seconds.

        Returns:
            The fix; its pose is None unless the state is TRACKING.

        Raises:
            CloudError: the cloud has another shape, fewer than 10 finite points, or lies kilometres off. RunError: the
                pose is not rigid, or the stamp is not in seconds or not after the previous frame's. Neither changes the
                localizer: count the frame, skip it and go on. After any other exception, say of Ctrl-C, the next
                frame begins with :meth:`relocalize`, as this one is half in.
        """
        frame, request = self._predict(cloud, T_odom_body, stamp)  # T_map_body = T_map_odom T_odom_body
        if self.state.has_place:
            match = self._match_to_map(frame)  # eq. 13, from the prediction; None where none is due
            if match is not None:
                self._update(match)  # verify, correct the graph of poses, change the state
        elif request is not None:
            self.apply_search_result(self.search.update(request))  # eqs 1-13, over the whole map
        self._cut_short = False
        return self.fix()

    def add_frame(
        self, cloud: Reals, T_odom_body: Pose, stamp: float, defer: bool = False,
        on_doubt: Callable[[], None] = lambda: None,
    ) -> SearchRequest | None:  # fmt: skip
        """Process a frame as :meth:`step` does, with its first arguments and its errors, but without the search.

        Set ``defer`` if the caller is behind: while tracking, frames are then registered at three times the usual
        distance, turn and time, unless they look displaced or the place is in doubt. ``on_doubt`` is called if a
        registration contradicts the place, some tenths of a second before the cause is known.

        Returns:
            The search request, if any: pass it to a :class:`GlobalSearch` in any thread or process, and its result to
            :meth:`apply_search_result` between two frames. Frames continue meanwhile. ``AsyncLocalizer`` does all this.
        """
        frame, request = self._predict(cloud, T_odom_body, stamp)
        match = self._match_to_map(frame, defer, on_doubt) if self.state.has_place else None
        if match is not None:
            self._update(match)
        self._cut_short = False
        return request

    def apply_search_result(self, result: SearchResult) -> None:
        """Track the place that a search has accepted, or record why it accepted none.

        A result of an earlier epoch (from before a loss, a jump of odometry, another circle or a :meth:`reset`) is
        ignored, as are all results while a place is known.
        """
        newest = self._newest
        if result.epoch != self._requests.epoch or self.state.has_place or newest is None:
            return
        self._evidence = result.evidence
        if result.accepted is not None and self._frames.conventions.doubtful:
            self._handle(Event.PLACE_PROPOSED)
            self._evidence = replace(self._evidence, state=self.state, reason=DOUBT, cause=RejectionReason.CONVENTIONS)
            return
        registration = None if result.accepted is None else result.accepted.registration
        if registration is None:
            if result.T_map_cloud is not None and result.evidence.evidence is not None:  # a registered place leads
                probability = result.evidence.confidence or 0.0
                leader = self._frames.learn_place(result.T_map_cloud, result.T_odom_body, probability)
                if self._frames.anchor is not None:
                    self._requests.hints.place_leads(leader, self._frames.anchor)
            proposed = result.evidence.state is State.AMBIGUOUS
            self._handle(Event.PLACE_PROPOSED if proposed else Event.NO_PLACE)
            return
        self._handle(Event.PLACE_ACCEPTED)
        self._confidence = result.evidence.confidence or 0.0
        assert result.T_map_cloud is not None  # an accepted place leads
        T_map_odom = self._frames.learn_place(result.T_map_cloud, result.T_odom_body)
        registration = registration._replace(T_map_source=T_map_odom)
        self._tracker.start(registration, newest.T_odom_body, result.travelled, result.T_odom_body)
        self._monitor.begin(min(1.0 - self._confidence, self.config.acceptance.risk))
        self._requests.place_accepted()
        self._witness.faults.trusted()
        self._frames.forget_keyframe()
        # the robot may have driven on or been carried since the keyframe
        match = self._tracker.match_to_map(newest.cloud, newest.T_odom_body)
        self._update(replace(match, confirms_search=True))

    def fix(self) -> Fix:
        """Return the fix of the newest frame, as :meth:`step` does; RuntimeError before the first."""
        newest, evidence = self._newest, self._evidence
        if newest is None:
            raise RuntimeError("no frame yet; call add_frame or step first")
        calibration = self.calibration
        if self.state is not State.TRACKING or self._frames.anchor is None:
            return Fix(newest.stamp, self.state, evidence=evidence, calibration=calibration)
        T_odom_stamp = newest.T_odom_body @ self._frames.since_cloud(newest.stamp)
        T_map_local = orthonormal(self._tracker.T_map_odom) @ T_odom_stamp
        T_map_body = pose_from(T_map_local[:3, :3], T_map_local[:3, 3] + self.base_map.origin)
        return Fix(
            newest.stamp,
            self.state,
            T_map_body=T_map_body,
            T_map_odom=T_map_body @ inverse(newest.T_odom_raw),
            covariance=self._tracker.reported_covariance(),
            confidence=min(self._confidence, 1.0 - self._wrong),
            evidence=evidence,
            drift=self._tracker.odometry.drift,
            protection=self._tracker.protection_level(),
            calibration=calibration,
        )

    def take_events(self) -> tuple[Event, ...]:
        """Return the events that changed the state since the last call, in order; :meth:`relocalize` drops them."""
        events, self._events = tuple(self._events), []
        return events

    # ---- knowledge of the caller

    def hint_pose(self, T_map_body: Pose) -> None:
        """Hint that the robot may be here at the next frame: ``T_map_body`` (4, 4) as :attr:`Fix.T_map_body`.

        A hint holds until a place is accepted, :meth:`relocalize` or :meth:`reset`. The search judges it like a
        hypothesis that the votes rank last. Ignored while a place is known.

        Raises:
            RunError: it is not a finite rigid transform, or not on this planet.
        """
        local = validate_pose(T_map_body, self.base_map.origin)
        if not self.state.has_place:
            self._requests.hints.robot_at(local)

    def guess_place(self, guess: PlaceGuess, check: bool = True) -> None:
        """Let the search try a guess of the robot's place, from the next frame on.

        The search judges the poses of a guess like the descriptors' hypotheses. But ``guess.within`` limits the search
        to a circle, widened by the metres driven, until a place is accepted, another guess comes or the search restarts
        (:meth:`relocalize`). Ignored while a place is known. ``check`` refuses a guess where the map has no ground;
        unchecked, such a circle never leads to a pose.

        Raises:
            InputError: ``guess`` has another type, or the map has no ground there.
        """
        if check:
            require_ground(guess, self.base_map)
        if not self.state.has_place:
            self._requests.guess(guess)

    def hint_calibration(self, earlier: Calibration) -> None:
        """Start from an earlier calibration of this robot, with larger sigmas, and continue to estimate it.

        Ignored while a place is known, and where the present calibration is more certain.

        Raises:
            InputError: a value is not finite or not plausible for a robot.
        """
        earlier.require_plausible()
        if self.state.has_place:
            return
        self._frames.estimator.learn(earlier.doubted())
        if not self._tracker.ground.metres:
            self._tracker.ground.restore(earlier.ground)

    def require_verification(self) -> None:
        """Withhold poses until new frames alone have verified the place, as the robot may have been carried."""
        self._tracker.forget_scans()
        self._monitor.require_verification()
        self._handle(Event.VERIFICATION_REQUIRED)

    # ---- the steps

    def _predict(self, cloud: Reals, T_odom_body: Pose, stamp: float) -> tuple[PreparedFrame, SearchRequest | None]:
        """Check a frame and predict its pose by odometry; return it and the request of a search, if one is due."""
        points, T_odom_raw = self._frames.validate(cloud, T_odom_body, stamp)
        if self._cut_short:
            self.relocalize()
        self._cut_short = True
        if self._frames.steps.add(T_odom_raw, stamp):
            self._requests.odometry_jumped(None if self._newest is None else self._newest.T_odom_body)
            if self.state.has_place and self._newest is not None:  # the robot was moved, or is still here
                here = self._tracker.T_map_odom @ self._newest.T_odom_body
                self._handle(Event.PLACE_GIVEN_UP)
                self._requests.hints.forget_lost()
                self._requests.hints.robot_at(here)
            self._frames.begin_odometry()
            self._tracker.forget_odometry()
            self._witness.begin_odometry()
            self._evidence = KeyframeEvidence(stamp, self.state, JUMPED, cause=RejectionReason.ODOMETRY)
        searching = not self.state.has_place
        drift = self._tracker.odometry.drift.variances if searching else None
        frame = self._newest = self._frames.prepare(points, T_odom_raw, stamp, drift)
        self._tracker.add_scan(frame.scan)
        if (finding := self._frames.conventions.finding) is not None:  # nothing from this sender can be believed
            self._handle(Event.PLACE_GIVEN_UP)
            self._requests.begin_anew()  # a search may be running
            self._evidence = KeyframeEvidence(stamp, self.state, finding, cause=RejectionReason.CONVENTIONS)
            return frame, None
        self._witness.add(stamp, frame.cloud, frame.scan, frame.T_odom_raw)
        doubtful = self._frames.conventions.doubtful
        if not searching and not doubtful:
            return frame, None
        accused = self._witness.while_searching(self._tracker.odometry.drift, self._frames.conventions)
        if not searching:
            self.require_verification()
            reason, cause = DOUBT, RejectionReason.CONVENTIONS
            if accused is not None:
                reason, cause = accused.sentence, accused.cause
            self._evidence = KeyframeEvidence(stamp, self.state, reason, cause=cause)
            return frame, None
        if accused is not None:  # no place is searched by clouds that may be wrong
            self._requests.begin_anew()
            self._evidence = KeyframeEvidence(stamp, self.state, accused.sentence, cause=accused.cause)
            return frame, None
        if not self._frames.knows_moment(stamp):
            self._evidence = KeyframeEvidence(stamp, self.state, "odometry does not go back to this cloud's moment yet")
            return frame, None
        request = self._requests.add(frame, self._tracker.odometry.travelled)
        if request is None:
            return frame, None
        if not isinstance(request, NoSearch):
            return frame, replace(request, lost=self._lost_place(frame, request.area))
        if request.cause is RejectionReason.ODOMETRY:
            self._frames.estimator.forget_leader()
            self._frames.forget_keyframe()
            self._tracker.forget_scans()
            self._handle(Event.SCANS_CONTRADICT)
        self._evidence = KeyframeEvidence(stamp, self.state, request.reason, cause=request.cause)
        return frame, None

    def _lost_place(self, frame: PreparedFrame, area: Circle | None) -> LostPlace | None:
        """Return the last known place where odometry continues to a frame; None without one, or if outside ``area``."""
        assert self._frames.anchor is not None  # a frame has been prepared
        T_map_odom = self._requests.hints.lost(self._frames.anchor)
        if T_map_odom is None or not (area is None or area.holds(robot_position(T_map_odom, frame.T_odom_body)).all()):
            return None
        odds = self._monitor.odds(frame.stamp, self._tracker.odometry.travelled) + self._witness.faults.slipped
        return LostPlace(T_map_odom, self._tracker.lost_covariance(T_map_odom @ frame.T_odom_body), odds)

    def _match_to_map(
        self, frame: PreparedFrame, defer: bool = False, on_doubt: Callable[[], None] = lambda: None
    ) -> MapMatch | None:
        """Register the newest scans after a metre, a turn or a second, in doubt, or if displaced; None if not due."""
        if self._frames.conventions.doubtful:
            return None
        patience = _DEFERRED if defer else 1.0
        due = self._tracker.needs_registration(patience)
        waited = frame.stamp - self._registered_at >= patience * self.config.tracking.seconds
        newest_only = self.state is State.DOUBTED or self._tracker.looks_displaced(frame.T_odom_body)
        newest_only |= self._witness.between_registrations(self._tracker)
        if due or waited or newest_only:
            return self._tracker.match_to_map(
                frame.cloud, frame.T_odom_body, not due, newest_only, on_doubt, self._witness.faults.slipped
            )
        self._tracker.prefetch_map(frame.T_odom_body)
        return None

    def _update(self, match: MapMatch) -> Ruling:
        """Judge a registration, correct the pose if it is believed, and change the state; return the ruling.

        The next fix has the registration's evidence, unless it only confirms the search's.
        """
        assert self._newest is not None  # the match is of the newest frame
        belief = self._tracker.belief if self.state is State.TRACKING else None
        match = self._witness.while_tracking(match, belief, self._tracker)
        verdict, stamp = match.verdict, self._newest.stamp
        ruling = self._monitor.verify(verdict, stamp, self._tracker.odometry.travelled)
        self._wrong = ruling.wrong
        self._registered_at = stamp
        after = self.state if ruling.event is None else next_state(self.state, ruling.event)
        if not (match.confirms_search and ruling.believed):
            self._evidence = KeyframeEvidence(
                stamp, after, ruling.reason, verdict.score, 0.0, verdict.evidence,
                cause=verdict.cause, innovation=verdict.innovation, confidence=1.0 - ruling.wrong,
            )  # fmt: skip
        slips = self._witness.faults.odometry > 0.5
        self._tracker.update(match, self._newest.T_odom_body, ruling.believed, slips)
        if ruling.believed:
            self._witness.faults.trusted()
        if ruling.event is not None:
            self._handle(ruling.event)
        return ruling

    # ---- states

    def _handle(self, event: Event) -> None:
        """Change the state by an event (docs/tracking.md has the table)."""
        before, self.state = self.state, next_state(self.state, event)
        if self.state is before:
            return
        self._events.append(event)
        if self.state is State.LOST:
            # odometry may have jumped, or the sensor or the map is wrong: then odometry's path is worth a try
            self._requests.place_lost(self._tracker.T_map_odom)
            self._frames.forget_odometry()
            self._tracker.ground.restore(self._tracker.ground.metres)
            self._tracker.forget_odometry()
            self._witness.forget_scan()


def checked_arguments(
    base_map: BaseMap | str | os.PathLike[str], config: LocalizerConfig | None
) -> tuple[BaseMap, LocalizerConfig]:
    """Return the map, loaded if it is a path, and the settings or the defaults; errors as in :class:`Localizer`."""
    if not isinstance(config, LocalizerConfig | None):
        kind = type(config).__name__
        raise ConfigError(f"config is a {kind}; give a LocalizerConfig, such as LocalizerConfig(reloc='coview')")
    if isinstance(base_map, str | os.PathLike):
        base_map = BaseMap.load(base_map)
    if not isinstance(base_map, BaseMap):
        kind = type(base_map).__name__
        raise InputError(f"base_map is a {kind}; give a BaseMap or the path of a .coview file")
    return base_map, config or LocalizerConfig()
