"""Tracking: registrations of the newest frames and odometry between them, in one graph of poses."""

from __future__ import annotations

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.se3 import boxminus
from coview_stream.geometry.transforms import Points, Pose, inverse, transform
from coview_stream.localization.registration.covariance import (
    propagate,
    registration_covariance,
    swap_rotation_translation,
)
from coview_stream.localization.registration.local_map import LocalMap, LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan, voxelized
from coview_stream.localization.registration.result import Registration
from coview_stream.localization.tracking.displacement_check import DisplacementCheck
from coview_stream.localization.tracking.map_matching import MapMatch, MapMatcher, ScanInput
from coview_stream.localization.tracking.monitor import EvidenceBaseline, MatchVerdict, RejectionReason
from coview_stream.localization.tracking.motion import MAX_FRAMES, OdometryTracker, ScanBuffer
from coview_stream.localization.tracking.odometry_noise import Drift
from coview_stream.localization.tracking.pose_graph import Estimate, PoseGraph
from coview_stream.localization.tracking.shared_error import SharedErrorModel

_LEAST_SOURCE = 100  # points to register
_IDLE_DRIVE = 0.2  # metres: what standing still until the next look counts as
_START = np.diag([np.radians(0.3), np.radians(0.3), np.radians(1.5), 0.5, 0.5, 0.3]) ** 2
_SLIP = np.diag([np.radians(0.5), np.radians(0.5), np.radians(5.0), 1.0, 1.0, 0.3]) ** 2
"""What odometry may be off by where it contradicts the lidar: wheels that slip, a robot that is carried."""


class Tracker:
    """Belief over the robot's pose: a graph of keyframes, one per registration, and odometry since the newest.

    Attributes:
        T_map_odom: (4, 4) map <- odometry, by the newest keyframe.
    """

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps) -> None:
        self.base_map = base_map
        self.config = config
        self.local_maps = local_maps
        self.T_map_odom: Pose = np.eye(4)
        self._graph = PoseGraph(config.graph)
        self._odometer = OdometryTracker(config.tracking)
        self._habit = EvidenceBaseline()
        self._glance = DisplacementCheck()
        self._recent = ScanBuffer(config.tracking)
        self._unseen = 0  # frames since the last update
        self._shared = SharedErrorModel(config.registration)

    @property
    def travelled(self) -> float:
        """Metres that odometry has driven."""
        return self._odometer.travelled

    # ---- frames

    def observe(self, cloud: Points, T_odom_body: Pose, thin: Points | None = None) -> None:
        """Remember a frame's points (body frame) and how far odometry has driven.

        ``thin`` is what :func:`coview_stream.localization.registration.prepare_scan.voxelized` makes of it, if that is known already.
        """
        self._odometer.move(T_odom_body)
        points = voxelized(cloud, T_odom_body, self.config.keyframe) if thin is None else thin
        self._recent.add(points, self.travelled)
        self._unseen += 1

    def forget(self) -> None:
        """Drop the remembered frames: what made the robot lose its place may be an odometry that jumped."""
        self.forget_points()
        self._odometer.break_off()

    def forget_points(self) -> None:
        """Drop the points that the next registration would use beside the next frame's."""
        self._recent.clear()

    def look_around(self, T_odom_body: Pose) -> None:
        """Crop the map here already, on a frame that registers nothing: a new crop takes as long as a registration."""
        if (target := self._target(T_odom_body)) is not None:
            target.prepare(self.config.registration.method)

    # ---- when to register

    def due(self, patience: float = 1.0) -> bool:
        """Whether the robot has driven or turned far enough for another registration; ``patience`` times as far."""
        driven, turned = self._odometer.since_keyframe()
        settings = self.config.tracking
        if driven >= patience * settings.distance or turned >= patience * settings.turn:
            return True
        if driven < patience * settings.min_distance:
            return False
        grown = self.drift.variances(driven, turned)
        yaw, position = patience * settings.max_yaw_sigma, patience * settings.max_position_sigma
        return bool(grown[2] > yaw**2 or grown[3] > position**2)

    def alarmed(self, T_odom_body: Pose) -> bool:
        """Whether the newest frame lies on the map so much less than the ones before that it should be registered."""
        target, points = self._target(T_odom_body), self._recent.newest
        if target is None or points is None:
            return False
        return self._glance.alarming(points, T_odom_body[:3, 3], self.T_map_odom, target)

    # ---- the belief

    def start(self, registration: Registration, T_odom_body: Pose, travelled: float) -> None:
        """Begin with an accepted fix, found where odometry had driven ``travelled`` metres, at the newest frame.

        It may not have converged yet: its own covariance is not believed.
        """
        self._habit.clear()
        self._glance.clear()
        self._shared.clear()
        own = registration_covariance(registration.information, self.config.registration)
        drifted = self.drift.covariance(self.travelled - travelled, 0.0)
        self._restart(registration.T_map_source @ T_odom_body, own + drifted + _START, T_odom_body)

    def update(
        self, cloud: Points, T_odom_body: Pose, idle: bool = False, alone: bool = False
    ) -> MatchVerdict:
        """Register the newest frames from the predicted pose, judge, and correct the belief if that went well.

        Args:
            cloud: (N, 3) the newest frame, body frame, which has been observed.
            T_odom_body: (4, 4) its odometry.
            idle: by its odometry the robot stands still: use only frames since the last update, and believe the
                odometry a little less; standing and looking again and again must not add up to certainty.
            alone: use the newest frame alone: something is wrong with it, or with what came before.
        """
        graph = self._moved(T_odom_body, idle)
        most = 1 if alone else max(1, self._unseen) if idle else MAX_FRAMES
        self._recent.keep(most)
        self._unseen = 0
        target = self._target(T_odom_body)
        if target is None:
            return MatchVerdict(RejectionReason.OFF_MAP, "the map is empty here")
        newest = self._recent.newest
        source = prepare_scan(self._recent.window(), T_odom_body[:3, 3], self.config.registration)
        # older frames' points fill up a sparse newest one, but cannot stand in for one that sees nothing
        seen = 0 if newest is None else min(len(source.points), len(newest))
        if newest is None or seen < _LEAST_SOURCE:
            return self._rejected(MatchVerdict(RejectionReason.BLIND, f"only {seen} points to register"))
        scan = ScanInput(source, cloud, T_odom_body)
        belief = graph.estimate
        tried = self._attempt(scan, belief, target, self.config.registration.track)
        limit = self.config.acceptance.max_innovation
        if alone or not tried.judgement.verified or tried.innovation > limit:
            doubted = Estimate(belief.T_map_body, belief.covariance + _SLIP)
            again = self._attempt(scan, doubted, target, self.config.registration.search[1:])
            tried = max(tried, again, key=_rank)
        if not tried.judgement.verified:
            return self._rejected(tried.judgement)
        if tried.innovation > limit:
            return self._slipped(tried, belief, T_odom_body)
        graph.correct(tried.T_map_body, tried.covariance)
        self._believe(T_odom_body)
        self._learn(tried)
        self._shared.learn(source, self.T_map_odom, target, T_odom_body[:3, 3])
        self._glance.learn(newest, T_odom_body[:3, 3], self.T_map_odom, target)
        return tried.judgement

    def predicted_covariance(self) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) after the metres driven since the newest keyframe."""
        last = self._odometer.pose
        if not len(self._graph) or last is None:
            return np.asarray(_START.copy())
        belief = self._graph.estimate
        here = self.T_map_odom @ last
        carried = propagate(belief.covariance, here[:3, 3] - belief.T_map_body[:3, 3])
        return np.asarray(carried + self.drift.covariance(*self._odometer.since_keyframe()))

    def reported_covariance(self) -> Floats:
        """Covariance (6, 6) over (x, y, z, roll, pitch, yaw), what all registrations share included, map axes."""
        return swap_rotation_translation(self.predicted_covariance() + self._shared.covariance)

    @property
    def drift(self) -> Drift:
        """How fast odometry seems to drift."""
        return self._odometer.drift

    # ---- inside

    def _target(self, T_odom_body: Pose) -> LocalMap | None:
        return self.local_maps.around(transform(self.T_map_odom, T_odom_body[None, :3, 3])[0])

    def _restart(self, T_map_body: Pose, covariance: Floats, T_odom_body: Pose) -> None:
        """Begin a new graph: nothing that was believed before counts."""
        self._graph.start(T_map_body, covariance)
        self._odometer.unlearn()
        self._odometer.mark(T_odom_body)
        self._believe(T_odom_body)

    def _moved(self, T_odom_body: Pose, idle: bool) -> PoseGraph:
        """Add a keyframe where odometry leads."""
        driven, turned = self._odometer.since_keyframe()
        spread = self.drift.covariance(driven + _IDLE_DRIVE * idle, turned)
        self._graph.move(self._odometer.motion(T_odom_body), spread)
        self._odometer.mark(T_odom_body)
        return self._graph

    def _attempt(
        self, scan: ScanInput, belief: Estimate, target: LocalMap, scales: tuple[float, ...]
    ) -> MapMatch:
        registrar = MapMatcher(self.base_map, self.config)
        return registrar.attempt(scan, belief, target, scales, self._habit, self._graph)

    def _believe(self, T_odom_body: Pose) -> None:
        self.T_map_odom = self._graph.estimate.T_map_body @ inverse(T_odom_body)

    def _learn(self, tried: MapMatch) -> None:
        """Take note of what a registration says of odometry, and of what evidence is like here."""
        assert tried.judgement.evidence is not None  # it was verified
        self._habit.learn(tried.judgement.evidence)
        self._odometer.learn(tried.T_map_body, tried.covariance)

    def _rejected(self, judgement: MatchVerdict) -> MatchVerdict:
        """Believe nothing of it: bad frames among the newest must not spoil the next registration too."""
        self._recent.clear()
        return judgement

    def _slipped(self, tried: MapMatch, belief: Estimate, T_odom_body: Pose) -> MatchVerdict:
        """Go on where the lidar says, for the next frame to confirm: odometry says otherwise."""
        gap = boxminus(tried.T_map_body, belief.T_map_body)
        metres, degrees = float(np.linalg.norm(gap[3:])), np.degrees(float(np.linalg.norm(gap[:3])))
        self._restart(tried.T_map_body, tried.covariance + self._shared.covariance, T_odom_body)
        self._recent.clear()
        reason = f"odometry is {metres:.2f} m and {degrees:.1f} degrees off what the lidar sees"
        return MatchVerdict(RejectionReason.ODOMETRY, reason, tried.judgement.evidence, tried.innovation)


def _rank(tried: MapMatch) -> tuple[bool, float]:
    return tried.judgement.verified, tried.judgement.score
