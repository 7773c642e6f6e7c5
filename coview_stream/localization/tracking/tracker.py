"""Tracking: registrations of the newest scans and odometry between them, in one pose graph."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from coview_kernels import Registration
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ProtectionLevel, protection_level
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, transform, yaw_of
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator, tilt_variance
from coview_stream.localization.calibration.ground_change import GroundChange
from coview_stream.localization.calibration.ground_offset import GroundOffset
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import LocalMap, LocalMaps, prepare_scan
from coview_stream.localization.registration.register import (
    propagate,
    registration_covariance,
    swap_rotation_translation,
)
from coview_stream.localization.tracking.map_matching import MapMatch, MapMatcher, best_of
from coview_stream.localization.tracking.monitor import MatchVerdict, RejectionReason
from coview_stream.localization.tracking.motion import MAX_FRAMES, OdometryTracker, ScanBuffer
from coview_stream.localization.tracking.pose_graph import Estimate, PoseGraph
from coview_stream.localization.tracking.slip import DisplacementCheck

_MIN_POINTS = 100  # to register
_MIN_DISTANCE = 0.3  # metres; no uncertainty requires an earlier registration
_LEAST_DISTANCE = 0.05  # metres; of registrations this near to each other or nearer, six count as one
_MAX_SIGMA = 0.03  # metres of odometry's drift in x or y that require a registration
_MAX_YAW_SIGMA = math.radians(0.2)  # likewise for its heading
_STANDING_DRIVE = 0.2  # metres of driving that a standstill between registrations counts as
_START = np.diag([np.radians(0.3), np.radians(0.3), np.radians(1.5), 0.5, 0.5, 0.3]) ** 2
"""Covariance added to that of an accepted place, whose registration may not have converged; rotations first."""
_SLIP = np.diag([np.radians(0.5), np.radians(0.5), np.radians(5.0), 1.0, 1.0, 0.3]) ** 2
"""Covariance added where odometry contradicts the lidar, as wheels may slip or the robot be carried."""

_RISEN = np.diag([np.radians(1.0), np.radians(1.0), 0.0, 0.0, 0.0, 0.3]) ** 2
"""Covariance added where only structure shows the height, and only odometry the attitude."""


class Tracker:
    """Belief over the robot's pose: a graph of keyframes, one per registration, and odometry since the newest.

    Attributes:
        T_map_odom: (4, 4) map <- odometry, by the newest keyframe.
        ground: offset of the site's ground against the survey's.
        change: ground that was dug or filled since the survey.
        risen: metres by which the newest registration has raised the robot, as its ground is not the survey's.
        odometry: metres driven, and drift.
    """

    def __init__(
        self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps, calibration: CalibrationEstimator
    ) -> None:
        """Track on a map; ``calibration`` corrects the odometry, and learns from each registration."""
        self.config = config
        self.local_maps = local_maps
        self.T_map_odom: Pose = np.eye(4)
        self.ground = GroundOffset()
        self.change = GroundChange(base_map.field)
        self.risen = 0.0
        self._graph = PoseGraph()  # of cloud poses in the sensor's axes, independent of the calibration
        self._calibration = calibration
        self.odometry = OdometryTracker(config.tracking, calibration)
        self._matcher = MapMatcher(base_map, config)
        self._displacement = DisplacementCheck()
        self._scans = ScanBuffer(config.tracking, calibration)
        self._unregistered = 0  # frames since the newest registration
        self._learned_at = -math.inf  # metres driven when the place was last learned
        self._disputed = False  # the last match contradicted odometry
        self._held: LocalMap | None = None  # newest crop, so that robots with a shared cache do not drop each other's
        self._doubt = 1.0  # ratio of the usual evidence to the newest believed one

    def add_scan(self, scan: RawScan) -> None:
        """Add a frame: its points, one per voxel, and its odometry."""
        self.odometry.add_pose(scan.T_odom_body, scan.moment)
        self._scans.add(scan, self.odometry.travelled)
        self._unregistered += 1

    def forget_odometry(self) -> None:
        """Drop the scans and the newest odometry, which may have jumped."""
        self.forget_scans()
        self.odometry.forget_pose()

    def forget_scans(self) -> None:
        """Drop all points; the next registration uses only later frames."""
        self._scans.keep_newest(0)

    def prefetch_map(self, T_odom_body: Pose) -> None:
        """Crop the map at a frame without a registration, as a new crop takes as long as a registration."""
        if (target := self._target(T_odom_body)) is not None:
            target.prepare()

    def needs_registration(self, patience: float = 1.0) -> bool:
        """Whether the robot has driven or turned ``patience`` times as far as a registration needs."""
        driven, turned = self.odometry.since_keyframe()
        settings = self.config.tracking
        if driven >= patience * settings.distance or turned >= patience * settings.turn:
            return True
        if driven < patience * _MIN_DISTANCE:
            return False
        variances = self.odometry.drift.variances(driven, turned)
        return bool(variances[2] > (patience * _MAX_YAW_SIGMA) ** 2 or variances[3] > (patience * _MAX_SIGMA) ** 2)

    def looks_displaced(self, T_odom_body: Pose) -> bool:
        """Whether the newest frame fits the map so much less than usual that it needs a registration."""
        target, points = self._target(T_odom_body), self._scans.newest
        if target is None or points is None:
            return False
        return self._displacement.is_displaced(points, T_odom_body[:3, 3], self.T_map_odom, target)

    def start(
        self, registration: Registration, T_odom_body: Pose, travelled: float, T_odom_found: Pose | None = None
    ) -> None:
        """Start at an accepted place, with a wide covariance.

        ``registration``, metres ``travelled`` and ``T_odom_found`` (4, 4) are of the accepted keyframe, ``T_odom_body``
        (4, 4) is of the newest frame; without ``T_odom_found`` the newest frame is the keyframe.
        """
        self._matcher.clear()
        self.ground.clear()
        self.change.clear()
        self.odometry.forget_registration()
        self._doubt, self._disputed, self._learned_at = 1.0, False, -math.inf
        self._displacement.usual = None
        registered = registration_covariance(registration.information, self.config.registration)
        T_odom_keyframe = T_odom_body if T_odom_found is None else T_odom_found
        step = registration.T_map_source[:3, :3] @ (T_odom_body[:3, 3] - T_odom_keyframe[:3, 3])
        drifted = self.odometry.drift.covariance(
            self.odometry.travelled - travelled, abs(yaw_of(inverse(T_odom_keyframe) @ T_odom_body))
        )
        drifted += self._calibration.calibration.motion_covariance(step)
        covariance = propagate(registered + _START, step) + drifted
        self._restart(self._of_cloud(registration.T_map_source @ T_odom_body), covariance, T_odom_body)

    def match_to_map(
        self, cloud: Points, T_odom_body: Pose, standing_still: bool = False, newest_only: bool = False,
        on_doubt: Callable[[], None] = lambda: None, slipped: float = 1.0,
    ) -> MapMatch:  # fmt: skip
        """Register the newest scans from the predicted pose (eq. 13), verify and judge.

        ``cloud`` (N, 3) is the newest frame, already added, in the sensor's axes, ``T_odom_body`` (4, 4) its odometry.
        ``standing_still`` uses only frames since the last registration, and trusts odometry slightly less, as repeated
        views of a standing robot must not add up to certainty. ``newest_only`` uses only the newest frame, if the
        frames are in doubt. ``on_doubt`` is called if the place is contradicted, some tenths of a second before the
        search around is done. ``slipped`` are the odds, by the clouds alone, that odometry has slipped.
        """
        self._matcher.shared.repeats = max(1.0, _MIN_DISTANCE / max(self.odometry.since_keyframe()[0], _LEAST_DISTANCE))
        belief = self._predict(T_odom_body, standing_still)
        self._scans.keep_newest(1 if newest_only else max(1, self._unregistered) if standing_still else MAX_FRAMES)
        self._unregistered = 0
        target = self._target(T_odom_body)
        if target is None:
            verdict = MatchVerdict(RejectionReason.OFF_MAP, "the map is empty here")
            return MapMatch.without_registration(verdict, belief)
        points = prepare_scan(self._scans.window(), T_odom_body[:3, 3], self.config.registration)
        points = self.ground.lower(points)
        T_map_odom = belief.T_map_body @ inverse(T_odom_body)
        points = self.change.without_changed(points, T_map_odom, T_odom_body[:3, 3], target)
        newest = self._scans.newest
        # older frames may complement a sparse newest frame, but not replace a blind one
        count = 0 if newest is None else min(len(points.points), len(newest))
        if count < _MIN_POINTS:
            verdict = MatchVerdict(RejectionReason.BLIND, f"only {count} points to register")
            return MapMatch.without_registration(verdict, belief)
        scan = ObservedScan.of(points, self._calibration.calibration.level(cloud), T_odom_body)
        match = self._matcher.match(scan, belief, target, self.config.registration.track, belief)
        limit, tries = self.config.acceptance.max_innovation, [match]
        contradicted = not match.verdict.verified or match.innovation > limit
        if contradicted:
            on_doubt()
        if newest_only or contradicted:
            wider = Estimate(belief.T_map_body, belief.covariance + _SLIP)
            tries = self._matcher.match_widely(match, scan, wider, target, belief)
            match = best_of(tries, limit)
        if match.verdict.verified and (match.innovation > limit or self._disputed):
            return self._matcher.against_odometry(match, scan, tries, belief, self.odometry.travelled, slipped)
        return match

    def update(self, match: MapMatch, T_odom_body: Pose, believed: bool, slips: bool = False) -> None:
        """Correct the belief by a registration at the newest frame, if ``believed``.

        While odometry ``slips`` or is out of scale, nothing is learned from its motion.
        """
        verdict, T_map_cloud = match.verdict, self._of_cloud(match.T_map_body)  # before the calibration learns
        if verdict.verified or verdict.cause is RejectionReason.ODOMETRY:
            self._disputed = not (verdict.verified or match.moves_place)
        if match.moves_place:
            # odometry has slipped, or drifts as usual: continue at the lidar's pose
            self.odometry.learn_once_confirmed(T_map_cloud, match.covariance)
            self._restart(T_map_cloud, match.covariance + self._matcher.shared.covariance, T_odom_body)
        elif believed:
            self._matcher.dispute.clear()
            self._graph.correct(T_map_cloud, match.covariance)
            self._set_belief(T_odom_body)
            self.risen = self._learn(match, T_odom_body[:3, 3], slips)
            self._set_belief(T_odom_body)
            if self.risen:  # a lean measured on changed ground is wrong
                here = self.belief
                self._calibration.forget_tilt()
                self.odometry.forget_registration()
                T_map_body = pose_from(np.eye(3), [0.0, 0.0, self.risen]) @ here.T_map_body
                self._restart(self._of_cloud(T_map_body), here.covariance + _RISEN, T_odom_body)
            return
        self._scans.keep_newest(0)  # bad frames must not spoil the next registration, too

    def predicted_covariance(self) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) after the metres driven since the newest keyframe."""
        last = self.odometry.pose
        if not len(self._graph) or last is None:
            return np.asarray(_START.copy())
        return self._covariance_at(self.T_map_odom @ last) + self._calibration.calibration.extrapolation

    def lost_covariance(self, T_map_body: Pose) -> Floats:
        """Covariance (6, 6), likewise, of the pose (4, 4) to which odometry has led since the place was lost."""
        driven, turned = self.odometry.since_keyframe()
        sideways = self.odometry.drift.variances(driven, turned)[2] * driven**2 / 3.0  # the heading drifts on the way
        return self._covariance_at(T_map_body) + np.diag([0.0, 0.0, 0.0, sideways, sideways, 0.0])

    def _covariance_at(self, T_map_body: Pose) -> Floats:
        belief = self.belief
        carried = propagate(belief.covariance, T_map_body[:3, 3] - belief.T_map_body[:3, 3])
        return np.asarray(carried + self.odometry.drift.covariance(*self.odometry.since_keyframe()))

    def reported_covariance(self, mount_and_clock: bool = True) -> Floats:
        """Covariance (6, 6) over (x, y, z, roll, pitch, yaw), map axes, of the body at the stamp.

        It is the sum of the covariances of the cloud's pose by the graph and of odometry since, of the error that
        registrations repeat, the tilt's jitter, the ground's height and, if ``mount_and_clock``, of mount and clock.
        """
        total = self.predicted_covariance() + self._matcher.shared.covariance + self.odometry.tremble
        total[5, 5] += self.change.others.variance + self.change.alone + self.ground.sigma**2
        if mount_and_clock:
            R = (self.T_map_odom if self.odometry.pose is None else self.T_map_odom @ self.odometry.pose)[:3, :3]
            total += self._calibration.calibration.pose_covariance(R, self.odometry.rates)
        return swap_rotation_translation(total)

    def protection_level(self) -> ProtectionLevel:
        """Error exceeded in at most one pose of a thousand, metres and degrees; wider on less evidence than usual."""
        others = self._calibration.calibration.heights(self.change.others)
        return protection_level(self.reported_covariance(), self._doubt, others=others)

    def _target(self, T_odom_body: Pose) -> LocalMap | None:
        self._held = self.local_maps.around(transform(self.T_map_odom, T_odom_body[None, :3, 3])[0])
        return self._held

    def _restart(self, T_map_cloud: Pose, covariance: Floats, T_odom_body: Pose) -> None:
        self._matcher.dispute.clear()
        self._graph.start(T_map_cloud, covariance)
        self.odometry.set_keyframe(T_odom_body)
        self._set_belief(T_odom_body)

    def _predict(self, T_odom_body: Pose, standing_still: bool) -> Estimate:
        """Add a keyframe by odometry; return its pose and covariance."""
        driven, turned = self.odometry.since_keyframe()
        spread = self.odometry.drift.covariance(driven + _STANDING_DRIVE * standing_still, turned)
        motion = self.odometry.motion(T_odom_body)
        calibration = self._calibration.calibration
        R = self.belief.T_map_body[:3, :3]
        change = self.odometry.change()
        change[:2] = R[:2, :2] @ change[:2]
        spread += calibration.motion_covariance(R @ motion[:3, 3], yaw_of(motion), change)
        spread += 2.0 * calibration.extrapolation
        level = calibration.T_body_cloud
        self._graph.move(inverse(level) @ motion @ level, spread)
        self.odometry.set_keyframe(T_odom_body)
        return self.belief

    @property
    def belief(self) -> Estimate:
        """Return the newest keyframe's body pose by the present calibration."""
        of_cloud = self._graph.estimate
        level = inverse(self._calibration.calibration.T_body_cloud)
        return Estimate(of_cloud.T_map_body @ level, of_cloud.covariance)

    def _of_cloud(self, T_map_body: Pose) -> Pose:
        """Return the pose (4, 4) of the cloud in the sensor's axes."""
        return T_map_body @ self._calibration.calibration.T_body_cloud

    def _set_belief(self, T_odom_body: Pose) -> None:
        self.T_map_odom = self.belief.T_map_body @ inverse(T_odom_body)

    def _learn(self, match: MapMatch, position: Floats, slips: bool) -> float:
        """Learn from a verified registration: odometry's drift, the usual evidence here, and systematic errors.

        Return metres by which the robot has to rise, as the ground is not the survey's.
        """
        verdict, scan, target, newest = match.verdict, match.scan, match.target, self._scans.newest
        evidence, observation = verdict.evidence, verdict.observation
        if evidence is None or observation is None or scan is None or target is None or newest is None:
            raise ValueError("nothing can be learned from a match without a registration")
        self._doubt, rise = self._matcher.baseline.fallen(evidence), 0.0
        self._matcher.baseline.learn(evidence)
        if self.odometry.travelled - self._learned_at >= self.config.tracking.distance:  # once per view
            driven = min(self.odometry.travelled - self._learned_at, 100.0)
            self._learned_at = self.odometry.travelled
            self._matcher.place.learn(observation)
            self.ground.learn(scan.cloud, self.T_map_odom, target)
            fit = match.T_map_body @ inverse(scan.T_odom_body)  # without the prior, whose pull looks like disagreement
            self._matcher.shared.learn(scan.cloud, fit, target, position, self.odometry.travelled)
            climb = self.odometry.drift.variances(driven, 0.0)[5] + tilt_variance(match.covariance) * driven**2
            rise = self.change.learn(self.T_map_odom, position, target, driven, float(climb))
        self._displacement.learn(newest, position, self.T_map_odom, target)
        self.odometry.learn(self._of_cloud(match.T_map_body), match.covariance, slips)
        return rise
