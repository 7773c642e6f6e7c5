"""Matching to the map while tracking: a scan is registered from a belief about its pose, verified and judged."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import Prior
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig, RegistrationConfig
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.distributions import chi2_quantile, chi2_tail
from coview_stream.geometry.protection import ALERT_METRES
from coview_stream.geometry.transforms import Pose, inverse, tilt_of
from coview_stream.localization.evidence.observation import Evidence, ObservedScan
from coview_stream.localization.registration.clouds import LocalMap
from coview_stream.localization.registration.register import (
    gravity_information,
    register,
    registration_covariance,
    remove_prior,
)
from coview_stream.localization.tracking.monitor import PER_METRE, EvidenceBaseline, MatchVerdict, RejectionReason
from coview_stream.localization.tracking.place_evidence import Observation, PlaceEvidence
from coview_stream.localization.tracking.pose_graph import Estimate
from coview_stream.localization.tracking.shared_error import SharedErrorModel
from coview_stream.localization.tracking.slip import Dispute, matters, off_by

_RINGS = ((0.9, 6), (1.7, 10), (2.5, 14), (3.3, 18))  # metres, poses; each moves to the best within 0.4 m
_STRAIGHT, _TURNED = (0.0,), (-0.07, 0.0, 0.07)  # radians, turns of these poses
_WIDEST = 1.0  # metres; the poses are locally best, so coarser scales are left out
_EVERY = 3  # every third point is registered
_MAX_RIVALS = 2  # of a doubtful match
_SLIPS = -math.log(PER_METRE)  # log-odds against a slip by metres in a view of a metre


@dataclass(frozen=True)
class Rival:
    """A probable pose other than a registered one."""

    T_map_odom: Pose  # (4, 4) as registered there
    ratio: float  # log-likelihood ratio of the scan at this rival against chance around the registered pose


def find_rivals(
    place: PlaceEvidence,
    scan: ObservedScan,
    T_map_odom: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    count: int = 1,
) -> list[Rival]:
    """Register the most probable poses around a registered one; return those that do not converge to it, best first.

    After a slip, registration starts beside the right place, and a wall moved since the survey may hold it there. So
    the scan is compared with the map on rings of poses around, and up to ``count`` most probable ones are registered,
    too: a place has to explain the scan better than its best rival. A count above 1 also tries other headings.
    """
    here = scan.poses(T_map_odom[None])[0]
    poses, ratios = place.look_around(scan, T_map_odom, rings(here, _TURNED if count > 1 else _STRAIGHT))
    cloud, upright = scan.cloud.every(_EVERY), gravity_information(config.gravity_sigma)
    scales = tuple(scale for scale in config.search if scale <= _WIDEST) or config.search[-1:]
    tried, transforms = [here], [T_map_odom]
    for _ in range(count):
        ratios[np.linalg.norm(poses[:, :2] - tried[-1][:2], axis=1) < 0.5 * ALERT_METRES] = -np.inf
        best = int(ratios.argmax())
        if not np.isfinite(ratios[best]):
            break
        tried.append(poses[best])
        start = scan.transforms(poses[best][None])[0]
        other = register(cloud, start, target, config, scales, Prior(start, upright), scan.body)
        if other is not None and all(_beside(scan, other.T_map_source, T) for T in transforms):
            transforms.append(other.T_map_source)
    if len(transforms) == 1:
        return []
    ratio = place.ratios(scan, np.stack(transforms))
    return [Rival(transforms[k], float(ratio[k])) for k in np.argsort(-ratio, kind="stable") if k]


def _beside(scan: ObservedScan, T_map_odom: Pose, T_map_other: Pose) -> bool:
    """Return whether two poses of a scan are too far apart for both to be right; heights do not count."""
    along, other = T_map_odom @ scan.T_odom_body, T_map_other @ scan.T_odom_body
    along[2, 3] = other[2, 3]
    return matters(*off_by(along, other))


def rings(pose: Floats, turns: tuple[float, ...]) -> Floats:
    """Return poses (H, 4), x, y, z and heading, in rings around a pose (4,), each with all ``turns``."""
    radius = np.concatenate([np.full(count, metres) for metres, count in _RINGS])
    angle = np.concatenate([2.0 * np.pi * np.arange(count) / count for _, count in _RINGS])
    around = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros((len(radius), 2))])
    return np.asarray(pose + np.concatenate([around + np.array([0.0, 0.0, 0.0, turn]) for turn in turns]))


@dataclass(frozen=True)
class MapMatch:
    """Registration while tracking, with the verdict that decides its use."""

    verdict: MatchVerdict  # the decision and its reason
    T_map_body: Pose  # (4, 4) by the map alone, without the prior; the belief if registration failed
    covariance: Floats  # (6, 6) as in an Estimate, without the error that the next registration repeats
    innovation: float = 0.0  # squared Mahalanobis distance from the graph's prediction, by the errors of both
    scan: ObservedScan | None = None  # the registered scan; None if registration failed
    target: LocalMap | None = None  # the map around it; None likewise
    rivals: tuple[Rival, ...] = ()  # other poses metres away, most probable first, if searched for
    moves_place: bool = False  # it contradicts odometry and is believed instead
    confirms_search: bool = False  # first match at an accepted place, which adds no evidence to the search's

    @classmethod
    def without_registration(cls, verdict: MatchVerdict, belief: Estimate) -> MapMatch:
        """Return the match of a scan that could not be registered, with the belief unchanged."""
        return cls(verdict, belief.T_map_body, belief.covariance)


class MapMatcher:
    """Matcher that registers, verifies and judges scans on a base map.

    Attributes:
        place: evidence of the tracked place, against chance.
        dispute: evidence of the possible places while the scans contradict odometry.
        baseline: usual evidence, for reasons in words.
        shared: error of registrations here beyond the inverse Hessian.
    """

    def __init__(self, base_map: BaseMap, config: LocalizerConfig) -> None:
        self._base_map = base_map
        self._config = config
        self.place = PlaceEvidence(base_map)
        self.dispute = Dispute(self.place, config.tracking.distance)
        self.baseline = EvidenceBaseline()
        self.shared = SharedErrorModel(config.registration)

    def clear(self) -> None:
        """Forget the usual shares and errors of the previous place."""
        self.place.clear()
        self.baseline.usual = None
        self.shared.clear()

    def match(
        self,
        scan: ObservedScan,
        belief: Estimate,
        target: LocalMap,
        scales: tuple[float, ...],
        predicted: Estimate,
        rivals_wanted: int = 1,
    ) -> MapMatch:
        """Register a scan with ``belief`` as start and prior (eq. 13), verify and judge; a failure returns the belief.

        ``predicted`` is the graph's estimate, for the innovation; ``rivals_wanted`` limits the search for rivals.
        """
        settings = self._config.registration
        T_start = belief.T_map_body @ inverse(scan.T_odom_body)
        try:
            information = np.asarray(np.linalg.inv(belief.covariance))
        except np.linalg.LinAlgError:
            information = np.full((6, 6), np.nan)
        if not np.isfinite(information).all():
            return _failed(belief, "the covariance of the belief has no inverse")
        registration = register(scan.cloud, T_start, target, settings, scales, Prior(T_start, information), scan.body)
        T_map_odom = T_start if registration is None else registration.T_map_source
        observation, evidence = self.place.observe(scan, T_map_odom), scan.evidence(self._base_map.field, T_map_odom)
        rivals = find_rivals(self.place, scan, T_map_odom, target, settings, rivals_wanted) if rivals_wanted else []
        observation = replace(observation, rival=max([0.0, *(rival.ratio for rival in rivals)]))
        cause, reason = self._judge(observation, evidence)
        if registration is None:
            if cause is RejectionReason.VERIFIED:
                return _failed(belief, "too few points have a partner in the map", evidence, observation)
            return MapMatch.without_registration(MatchVerdict(cause, reason, evidence, None, observation), belief)
        tilt = tilt_of(T_map_odom)
        if tilt > self._config.acceptance.max_tilt:
            cause, reason = RejectionReason.TILT, f"leans {np.degrees(tilt):.0f} degrees against gravity"
        try:
            of_body = registration._replace(T_map_source=T_map_odom @ scan.T_odom_body)
            T_map_body, measured = remove_prior(of_body, Prior(belief.T_map_body, information), settings)
            if self.shared.unknown:  # until a verified registration replaces it
                fit = T_map_body @ inverse(scan.T_odom_body)
                self.shared.learn(scan.cloud, fit, target, scan.body, -np.inf)
            covariance = scan.cloud.doubted(registration_covariance(measured, settings)) + self.shared.own
            innovation = predicted.innovation(T_map_body, covariance + self.shared.covariance)
        except InputError as error:
            return _failed(belief, str(error), evidence, observation)
        verdict = MatchVerdict(cause, reason, evidence, innovation, observation)
        return MapMatch(verdict, T_map_body, covariance, innovation, scan, target, tuple(rivals))

    def match_widely(
        self, first: MapMatch, scan: ObservedScan, belief: Estimate, target: LocalMap, predicted: Estimate
    ) -> list[MapMatch]:
        """Match again, from a belief wide enough for a slip and from the best rival; compare them with ``first``.

        Returns ``first`` and one or two more.
        """
        scales = self._config.registration.search[1:]
        tries = [first, self.match(scan, belief, target, scales, predicted, _MAX_RIVALS)]
        rivals = sorted((rival for attempt in tries for rival in attempt.rivals), key=lambda rival: -rival.ratio)
        for rival in rivals:
            T_map_body = rival.T_map_odom @ scan.T_odom_body
            if all(matters(*off_by(attempt.T_map_body, T_map_body)) for attempt in tries):
                start = Estimate(T_map_body, belief.covariance)
                tries.append(self.match(scan, start, target, scales, predicted, 0))
                break
        return [self._against(attempt, tries) for attempt in tries]

    def against_odometry(
        self, match: MapMatch, scan: ObservedScan, tries: list[MapMatch], belief: Estimate, travelled: float,
        slipped: float,
    ) -> MapMatch:  # fmt: skip
        """Judge the best of ``tries``, which fits but contradicts ``belief``, odometry's pose.

        Within odometry's drift there is no contradiction. If the two poses are near enough for both to be right, the
        lidar is believed, without a pose until the next frame agrees; but not if their heights differ by more than the
        drift, as no wheel slips upwards. Else the place moves only if the evidence of the scans supports that.
        ``slipped`` are the odds, by the clouds alone, that odometry has slipped.
        """
        rule, T_map_predicted = self._config.acceptance, belief.T_map_body
        plausible = match.innovation <= rule.max_innovation
        metres, degrees = off_by(match.T_map_body, T_map_predicted)
        if plausible and not matters(metres, degrees):
            return match
        gap = match.T_map_body[:3, 3] - T_map_predicted[:3, 3]
        spread = (belief.covariance + match.covariance + self.shared.covariance)[3:, 3:]
        rare = chi2_tail(6, rule.max_innovation)  # probability below which nothing is plausible
        close = not matters(metres, degrees)
        if close and float(gap @ np.linalg.solve(spread, gap)) <= chi2_quantile(3, rare):
            return replace(match, moves_place=True)
        moves = close and bool(gap[2] ** 2 <= chi2_quantile(1, rare) * spread[2, 2])
        if not moves:
            places = [other.T_map_body for other in tries if other.scan is not None]
            places += [rival.T_map_odom @ scan.T_odom_body for other in tries for rival in other.rivals]
            right = self.dispute.settle(scan, T_map_predicted, places, travelled, rule.risk, slipped)
            if right is not None:
                verified = [other for other in tries if other.verdict.verified]
                match = min(verified, key=lambda other: off_by(right, other.T_map_body)[0], default=match)
                moves = not matters(*off_by(right, match.T_map_body))
                metres, degrees = off_by(match.T_map_body, T_map_predicted)
        reason = f"odometry is {metres:.2f} m and {degrees:.1f} degrees off the place that the scan fits"
        if not moves:
            reason += ", and the scan fits there hardly better than elsewhere: something may have been moved"
        verdict = replace(match.verdict, cause=RejectionReason.ODOMETRY, reason=reason)
        return replace(match, verdict=verdict, moves_place=moves)

    def _against(self, match: MapMatch, others: list[MapMatch]) -> MapMatch:
        """Compare a match with those of the same scan that ended elsewhere."""
        verdict = match.verdict
        observation, evidence = verdict.observation, verdict.evidence
        if observation is None or evidence is None or match.scan is None:
            return match
        elsewhere = [
            other.verdict.observation.ratio
            for other in others
            if other.scan is not None and other.verdict.observation is not None
            and matters(*off_by(other.T_map_body, match.T_map_body))
        ]  # fmt: skip
        observation = replace(observation, rival=max([observation.rival, *elsewhere]))
        verdict = replace(verdict, observation=observation)
        if verdict.verified:
            cause, reason = self._judge(observation, evidence)
            verdict = replace(verdict, cause=cause, reason=reason)
        return replace(match, verdict=verdict)

    def _judge(self, observation: Observation, evidence: Evidence) -> tuple[RejectionReason, str]:
        """Judge a scan at a pose; return a cause and a clause."""
        if observation.against_elsewhere > 0.0:
            return RejectionReason.VERIFIED, "verified"
        if observation.ratio > 0.0:
            return RejectionReason.FITNESS, "the scan fits as well some metres beside"
        return self.baseline.explain(evidence)


def best_of(tries: list[MapMatch], limit: float) -> MapMatch:
    """Return the most probable of some matches of one scan, of which the first begins at odometry's pose.

    The log-prior of a pose is -D / 2, with D its innovation against odometry, but not below that of a slip. If the best
    match does not fit, one that fits but contradicts odometry by more than ``limit`` is returned, for the dispute.
    """
    usable = [each for each in tries if each.scan is not None and each.verdict.cause is not RejectionReason.TILT]

    def probability(match: MapMatch) -> float:
        observation = match.verdict.observation
        return (0.0 if observation is None else observation.ratio) - min(0.5 * match.innovation, _SLIPS)

    best = max(usable or tries, key=probability)
    if best.verdict.verified:
        return best
    contrary = [each for each in usable if each.verdict.verified and each.innovation > limit]
    return max(contrary, key=probability, default=best)


def _failed(
    belief: Estimate, reason: str, evidence: Evidence | None = None, observation: Observation | None = None
) -> MapMatch:
    verdict = MatchVerdict(RejectionReason.FITNESS, f"registration failed: {reason}", evidence, None, observation)
    return MapMatch.without_registration(verdict, belief)
