"""Hypotheses of ``T_map_odom`` made exact: registered coarse to fine, and verified."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_from, rot_z, tilt_of, transform, yaw_of
from coview_stream.localization.registration.local_map import LocalMaps, RegistrationCloud
from coview_stream.localization.registration.register import register
from coview_stream.localization.registration.result import Prior, Registration
from coview_stream.localization.registration.verification import Evidence, verify
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.request import SearchRequest

_COARSE_SCALES = 2  # of the registration's scales that every hypothesis goes through
_COARSE_EVERY = 3  # of the source's points, for the coarse scales only every third
_COARSE_ITERATIONS = 8
_HOPELESS = (
    0.5  # of the best (or needed) score: what has less than this share after them is not refined further
)


@dataclass(frozen=True)
class Candidate:
    """A registered and verified hypothesis of ``T_map_odom``."""

    hypothesis: Hypothesis
    registration: Registration
    evidence: Evidence

    @property
    def T_map_odom(self) -> Pose:
        """(4, 4) map <- odometry."""
        return self.registration.T_map_source


class Refinement:
    """Registers hypotheses against the map around them and verifies what comes out."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps) -> None:
        self.base_map = base_map
        self.config = config
        self.local_maps = local_maps

    def refine(
        self, hypotheses: list[Hypothesis], source: RegistrationCloud, query: SearchRequest
    ) -> list[Candidate]:
        """Return verified candidates, best first. All go through the coarse scales, the promising ones through all."""
        scales = self.config.registration.search
        rough = source.every(_COARSE_EVERY)
        coarse = [
            candidate
            for hypothesis in hypotheses
            if (candidate := self._candidate(hypothesis, rough, source, query, scales[:_COARSE_SCALES]))
        ]
        coarse.sort(key=lambda c: -c.evidence.score)
        enough = _HOPELESS * max(coarse[0].evidence.score if coarse else 0.0, self.config.acceptance.score)
        fine: list[Candidate] = []
        for rank, candidate in enumerate(coarse):
            # the best and its rival are compared on equal terms; what is far below them stays as it is
            if coarse[0].evidence.score < enough or (rank > 1 and candidate.evidence.score < enough):
                fine.append(candidate)
                continue
            again = replace(candidate.hypothesis, T_map_odom=candidate.T_map_odom)
            refined = self._candidate(again, source, source, query, scales[_COARSE_SCALES:] or scales[-1:])
            if refined is not None:
                fine.append(refined)
        return sorted(fine, key=lambda c: -c.evidence.score)

    def _candidate(
        self,
        hypothesis: Hypothesis,
        moving: RegistrationCloud,
        source: RegistrationCloud,
        query: SearchRequest,
        scales: tuple[float, ...],
    ) -> Candidate | None:
        """Register ``moving`` from the hypothesis and verify with ``source``; None if it finds no hold or tilts."""
        start = hypothesis.T_map_odom
        target = self.local_maps.around(transform(start, query.position[None])[0])
        if target is None:
            return None
        level = pose_from(rot_z(yaw_of(start)), start[:3, 3])
        upright = Prior(level, gravity_information(self.config.registration.gravity_sigma))
        iterations = None if moving is source else _COARSE_ITERATIONS
        found = register(
            moving, start, target, self.config.registration, scales, upright, query.position, iterations
        )
        if found is None or tilt_of(found.T_map_source) > self.config.acceptance.max_tilt:
            return None
        T = found.T_map_source
        surveyed = self.base_map.surveyed(transform(T, source.points)[:, :2])
        evidence = verify(source, T, query.seen, T @ query.T_odom_body, target, surveyed)
        return Candidate(hypothesis, found, evidence)


def gravity_information(sigma: float) -> Floats:
    """Information (6, 6) over (rx, ry, rz, x, y, z) of "both frames are level to ``sigma`` radians"."""
    return np.diag([sigma**-2, sigma**-2, 0.0, 0.0, 0.0, 0.0])
