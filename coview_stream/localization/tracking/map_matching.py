"""One attempt to register a scan from a belief about its pose: what was found, and what is to be thought of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, tilt_of, transform
from coview_stream.localization.registration.covariance import registration_covariance, remove_prior
from coview_stream.localization.registration.local_map import LocalMap, RegistrationCloud
from coview_stream.localization.registration.register import register
from coview_stream.localization.registration.result import Prior
from coview_stream.localization.registration.verification import Evidence, RangeImage, verify
from coview_stream.localization.tracking.monitor import EvidenceBaseline, MatchVerdict, RejectionReason
from coview_stream.localization.tracking.pose_graph import Estimate, PoseGraph


@dataclass(frozen=True)
class ScanInput:
    """What is registered: the newest frames' points (odometry frame), the newest frame (body), its odometry (4, 4)."""

    source: RegistrationCloud
    cloud: Points
    T_odom_body: Pose

    @cached_property
    def seen(self) -> RangeImage:
        """The newest frame by direction."""
        return RangeImage.of(self.cloud)


@dataclass(frozen=True)
class MapMatch:
    """A registration and its judgement.

    Attributes:
        judgement: whether it is believed, were it not for odometry.
        T_map_body: (4, 4) as the map alone has it.
        covariance: (6, 6) of that, over (rx, ry, rz, x, y, z) along the map's axes.
        innovation: squared Mahalanobis distance from where the graph predicts the pose.
    """

    judgement: MatchVerdict
    T_map_body: Pose
    covariance: Floats
    innovation: float


@dataclass(frozen=True)
class MapMatcher:
    """Registers, verifies and judges scans on a base map.

    Attributes:
        base_map: knows where it has been surveyed.
        config: of registration and acceptance.
    """

    base_map: BaseMap
    config: LocalizerConfig

    def attempt(
        self,
        scan: ScanInput,
        belief: Estimate,
        target: LocalMap,
        scales: tuple[float, ...],
        habit: EvidenceBaseline,
        graph: PoseGraph,
    ) -> MapMatch:
        """Register, verify and judge; where the numbers leave nothing to hold on to, the belief stays.

        Args:
            scan: what to register.
            belief: pose and covariance that it starts from, and that take part in it as a prior.
            target: the map around it.
            scales: largest correspondence distance of each scale, metres.
            habit: what evidence has been like.
            graph: predicts the pose.
        """
        settings, acceptance = self.config.registration, self.config.acceptance
        T_start = belief.T_map_body @ inverse(scan.T_odom_body)
        information = _inverted(belief.covariance)
        if information is None:
            return _unheld(belief, "what is believed so far has a covariance without an inverse")
        prior = Prior(T_start, information)
        found = register(scan.source, T_start, target, settings, scales, prior, scan.T_odom_body[:3, 3])
        T = T_start if found is None else found.T_map_source
        surveyed = self.base_map.surveyed(transform(T, scan.source.points)[:, :2])
        evidence = verify(scan.source, T, scan.seen, T @ scan.T_odom_body, target, surveyed)
        cause, reason = habit.judge(evidence, acceptance)
        if found is None:
            if cause is RejectionReason.VERIFIED:
                return _unheld(belief, "too few points have a partner in the map", evidence)
            return MapMatch(MatchVerdict(cause, reason, evidence), belief.T_map_body, belief.covariance, 0.0)
        if tilt_of(T) > acceptance.max_tilt:
            cause, reason = (
                RejectionReason.TILT,
                f"leans {np.degrees(tilt_of(T)):.0f} degrees against gravity",
            )
        try:
            alone = remove_prior(
                T @ scan.T_odom_body, found.information, belief.T_map_body, information, settings
            )
            covariance = registration_covariance(alone.information, settings)
            innovation = graph.innovation(alone.T_map_body, covariance)
        except InputError as error:
            return _unheld(belief, str(error), evidence)
        judgement = MatchVerdict(cause, reason, evidence, innovation)
        return MapMatch(judgement, alone.T_map_body, covariance, innovation)


def _unheld(belief: Estimate, reason: str, evidence: Evidence | None = None) -> MapMatch:
    judgement = MatchVerdict(RejectionReason.FITNESS, f"no hold: {reason}", evidence)
    return MapMatch(judgement, belief.T_map_body, belief.covariance, 0.0)


def _inverted(covariance: Floats) -> Floats | None:
    try:
        inverted = np.asarray(np.linalg.inv(covariance))
    except np.linalg.LinAlgError:
        return None
    return inverted if np.isfinite(inverted).all() else None
