"""The engine: frames and odometry in, fixes out. No clock, no network, no threads."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Channel, LocalizerConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, orthonormal, pose_from, to_local, to_map_origin
from coview_stream.geometry.validation import validate_cloud, validate_odometry, validate_pose
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.result import Fix, KeyframeEvidence, State
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.keyframes import KeyframeBuffer, OdometryCheck
from coview_stream.localization.search.pose_hints import PoseHints
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.tracking.monitor import LossMonitor, MatchVerdict, RejectionReason
from coview_stream.localization.tracking.tracker import Tracker

_HURRIED = 3.0  # times as far apart are registrations in a hurry


@dataclass(frozen=True)
class _Frame:
    cloud: Points
    T_odom_body: Pose  # about the anchor
    stamp: float


class Localizer:
    """Tells where the robot is on a base map, or that it does not know (paper, Algorithm 1).

    Attributes:
        base_map: the map; may be shared by many localizers.
        config: how decisions are made.
        state: the newest fix's state.
    """

    def __init__(
        self,
        base_map: BaseMap,
        config: LocalizerConfig | None = None,
        local_maps: LocalMaps | None = None,
        knowledge: SearchIndex | None = None,
    ) -> None:
        """Localize on a map; those of one thread may share ``local_maps``, its cache of crops, and ``knowledge``.

        Raises:
            MapError, InputError, DependencyError: ``config.reloc`` is ``learned``, and that cannot be used here.
        """
        self.base_map = base_map
        self.config = config or LocalizerConfig()
        self._local_maps = local_maps or LocalMaps(base_map, self.config.registration.source_range)
        self._search = GlobalSearch(base_map, self.config, self._local_maps, knowledge)
        self._generation = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything but the map."""
        self.state = State.SEARCHING
        self._buffer = KeyframeBuffer(self.config.keyframe)
        self._search.reset()
        self._tracker = Tracker(self.base_map, self.config, self._local_maps)
        self._anchor: Floats | None = None
        self._evidence: KeyframeEvidence | None = None
        self._newest: _Frame | None = None
        self._suggestions = PoseHints()
        self._continuity = OdometryCheck()
        self._doubt = LossMonitor(self.config.acceptance, self.config.tracking)
        self._registered = 0.0  # stamp of the newest registration
        self._generation += 1

    @property
    def sources(self) -> tuple[str, ...]:
        """Who names places to look at: "coview", "learned" or both."""
        return self._search.names

    @property
    def last_query(self) -> dict[Channel, Descriptor]:
        """Descriptors (R, S) of the newest keyframe that searched, by channel; empty before the first."""
        return self._search.last_query

    def step(self, cloud: Points, T_odom_body: Pose, stamp: float) -> Fix:
        """Take in one frame and say where the robot is.

        Args:
            cloud: (N, 3) float32 body-frame points (x forward, z up), deskewed, metres; rows with NaN are dropped.
            T_odom_body: (4, 4) odometry pose of the frame, gravity aligned, metres.
            stamp: seconds.

        Returns:
            The fix; its pose is None unless the state is TRACKING.

        Raises:
            CloudError: the cloud has another shape or fewer than 10 finite points. RunError: the pose or stamp is not
                finite or not rigid. Neither changes the localizer: count the frame, skip it and go on.
        """
        query = self.take(cloud, T_odom_body, stamp)
        if query is not None:
            self.adopt(self._search.update(query))
        return self.fix()

    def take(
        self, cloud: Points, T_odom_body: Pose, stamp: float, hurry: bool = False
    ) -> SearchRequest | None:
        """First half of :meth:`step`, which never searches the map and so is quick.

        Args:
            cloud: as for :meth:`step`.
            T_odom_body: as for :meth:`step`.
            stamp: as for :meth:`step`.
            hurry: others wait: while tracking, put registrations off that can wait, to every third metre.

        Returns:
            What has to be searched for, if anything: hand it to a :class:`GlobalSearch`, on another thread or in
            another process if you like, and its verdict to :meth:`adopt`, between two frames. Meanwhile frames go on.

        Raises:
            CloudError, RunError: as for :meth:`step`.
        """
        cloud, T_odom_body = self._checked(cloud, T_odom_body, stamp)
        self._newest = _Frame(cloud, T_odom_body, stamp)
        if self.state is State.TRACKING:  # keyframes are for searching: a loss starts from nothing
            self._tracker.observe(cloud, T_odom_body, self._buffer.voxelize(cloud, T_odom_body))
            patience = _HURRIED if hurry else 1.0
            due = self._tracker.due(patience)
            still = stamp - self._registered >= patience * self.config.tracking.seconds
            doubted = self._doubt.active or self._tracker.alarmed(T_odom_body)
            if due or still or doubted:
                self._track(cloud, T_odom_body, stamp, idle=not due, alone=doubted)
            else:
                self._tracker.look_around(T_odom_body)
            return None
        suggested = self._suggested(T_odom_body)
        keyframe = self._buffer.add(cloud, T_odom_body, stamp)
        self._tracker.observe(cloud, T_odom_body, self._buffer.newest)
        if self._continuity.contradicts(self._buffer.newest, T_odom_body[:3, 3]):
            self._break_off(stamp)
            return None
        if keyframe is None:
            return None
        needs, travelled = self._search.needs, self._tracker.travelled
        return SearchRequest.of(self._buffer, keyframe, cloud, needs, travelled, self._generation, suggested)

    def _suggested(self, T_odom_body: Pose) -> tuple[Pose, ...]:
        return () if self._anchor is None else self._suggestions.about(self._anchor, T_odom_body)

    def adopt(self, verdict: SearchResult) -> None:
        """Second half of :meth:`step`: take note of a search, and start tracking when one place stands alone.

        A verdict from before a loss or a :meth:`reset` is ignored, and so is one that comes while tracking.
        """
        newest = self._newest
        if verdict.generation != self._generation or self.state is State.TRACKING or newest is None:
            return
        self._evidence = verdict.evidence
        if verdict.accepted is not None:
            self._tracker.start(verdict.accepted.registration, newest.T_odom_body, verdict.travelled)
            self._suggestions.clear()
            self.state = State.TRACKING
            self._doubt.clear()
            self._buffer.clear()
            # it may have driven on or been carried since
            self._note(self._tracker.update(newest.cloud, newest.T_odom_body), newest.stamp, verdict.evidence)
        elif self.state is not State.LOST:
            self.state = verdict.evidence.state

    def suggest(self, T_map_body: Pose) -> None:
        """Say that the robot may be here at the next frame, until a place is accepted or :meth:`reset`.

        It is never trusted: the search registers, verifies and judges it as whatever it finds itself. Ignored while
        the state is TRACKING.

        Args:
            T_map_body: (4, 4) in the frame of the map's sources, as :attr:`Fix.T_map_body`, metres.

        Raises:
            RunError: it is not a finite rigid transform, or no place on this planet.
        """
        local = validate_pose(T_map_body, self.base_map.origin)
        if self.state is not State.TRACKING:
            self._suggestions.robot_at(local)

    def suspect(self) -> None:
        """Give no pose until later frames alone have verified the place: the robot may have been carried meanwhile."""
        self._tracker.forget_points()
        if self.state is State.TRACKING:
            self._doubt.begin()

    def fix(self) -> Fix:
        """Say what is known after the newest frame, as :meth:`step` does; RuntimeError before the first."""
        if self._newest is None:
            raise RuntimeError("no frame yet; call take or step first")
        return self._fix(self._newest.T_odom_body, self._newest.stamp)

    def _track(self, cloud: Points, T_odom_body: Pose, stamp: float, idle: bool, alone: bool) -> None:
        """Correct the drift since the last registration, and verify again that the place is right.

        ``idle``: by its odometry the robot stands still. It may be carried, so what it saw before does not count.
        ``alone``: nor does it where there is a doubt.
        """
        self._note(self._tracker.update(cloud, T_odom_body, idle, alone), stamp)

    def _note(self, judgement: MatchVerdict, stamp: float, found: KeyframeEvidence | None = None) -> None:
        """Draw the consequences of a registration; one that confirms what the search has ``found`` adds nothing."""
        self._registered = stamp
        reason = self._doubt.note(judgement, stamp, self._tracker.travelled)
        if found is not None and judgement.verified:
            return
        if self._doubt.hopeless:
            self._lose()
        doubtful = self.state is State.TRACKING and self._doubt.active
        self._evidence = KeyframeEvidence(
            stamp, State.AMBIGUOUS if doubtful else self.state, reason, judgement.score, 0.0, judgement.evidence,
            cause=judgement.cause, innovation=judgement.innovation,
        )  # fmt: skip

    def _lose(self) -> None:
        """Search again from nothing: what lost the place may be an odometry that jumped or started anew.

        It may also be the sensor or the map, so where odometry says that the robot is now is worth a try.
        """
        if self._anchor is not None:
            self._suggestions.frames_were(self._tracker.T_map_odom, self._anchor)
        self.state, self._anchor = State.LOST, None
        self._buffer.clear()
        self._continuity.clear()
        self._tracker.forget()
        self._generation += 1

    def _break_off(self, stamp: float) -> None:
        """Search again from nothing, for the keyframes so far do not belong together with what is seen now."""
        self._buffer.clear()
        self._tracker.forget_points()
        self._generation += 1
        if self.state is State.AMBIGUOUS:
            self.state = State.SEARCHING
        reason = "searching anew: frames do not fit together where odometry puts them"
        self._evidence = KeyframeEvidence(stamp, self.state, reason, cause=RejectionReason.ODOMETRY)

    def _fix(self, T_odom_body: Pose, stamp: float) -> Fix:
        evidence = self._evidence
        if self.state is not State.TRACKING or self._anchor is None:
            return Fix(stamp, self.state, evidence=evidence)
        if self._doubt.active:  # a pose that the newest registration speaks against is none
            return Fix(stamp, State.AMBIGUOUS, evidence=evidence)
        T_map_local = orthonormal(self._tracker.T_map_odom)
        T_map_body = T_map_local @ T_odom_body
        confidence = max(0.0, evidence.score - evidence.rival) if evidence else 0.0
        return Fix(
            stamp,
            self.state,
            pose_from(T_map_body[:3, :3], T_map_body[:3, 3] + self.base_map.origin),
            to_map_origin(T_map_local, self._anchor, self.base_map.origin),
            self._tracker.reported_covariance(),
            confidence,
            evidence,
            self._tracker.drift,
        )

    def _checked(self, cloud: Points, T_odom_body: Pose, stamp: float) -> tuple[Points, Pose]:
        """Finite float32 points, and the pose relative to the first one so that float32 stays exact."""
        finite, T = validate_cloud(cloud), validate_odometry(T_odom_body, stamp)
        if self._anchor is None:
            self._anchor = T[:3, 3].copy()
        return finite, to_local(T, self._anchor)
