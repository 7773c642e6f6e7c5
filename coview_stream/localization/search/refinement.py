"""Hypotheses of ``T_map_odom`` made exact: registered coarse to fine (eq. 13), and verified."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_from, rot_z, tilt_of, transform, yaw_of
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import RegistrationCloud
from coview_stream.localization.registration.register import ScanInput, register_and_verify
from coview_stream.localization.registration.result import Prior, Registration
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.search.consensus import Hypothesis

_COARSE_SCALES = 2  # of the registration's scales that every hypothesis goes through; set by hand
_COARSE_EVERY = 3  # the coarse scales register every third point; set by hand
_COARSE_ITERATIONS = 8  # of each coarse scale; set by hand
_MIN_SHARE = 0.5  # of the best (or needed) score: with less than that a candidate stays coarse; set by hand


@dataclass(frozen=True)
class Candidate:
    """A registered and verified hypothesis of ``T_map_odom``.

    Attributes:
        hypothesis: where it began.
        registration: what came of it.
        evidence: shares of the scan that fit the map there.
    """

    hypothesis: Hypothesis
    registration: Registration
    evidence: Evidence

    @property
    def T_map_odom(self) -> Pose:
        """(4, 4) map <- odometry."""
        return self.registration.T_map_source


class Refinement:
    """Two rounds of registration: all hypotheses coarsely, then the promising ones finely."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps) -> None:
        self.base_map = base_map
        self.config = config
        self.local_maps = local_maps

    def coarse(self, hypotheses: list[Hypothesis], scan: ScanInput) -> list[Candidate]:
        """Register every hypothesis at the coarse scales; return those that have pairs enough, best first."""
        scales = self.config.registration.search[:_COARSE_SCALES]
        thinned = scan.cloud.every(_COARSE_EVERY)
        found = [self._candidate(each, scan, scales, thinned) for each in hypotheses]
        return _best_first([each for each in found if each is not None])

    def fine(self, candidates: list[Candidate], scan: ScanInput) -> list[Candidate]:
        """Return the candidates, best first; the promising ones, and the best one's rival, at the finest scales."""
        scales = self.config.registration.search
        scales = scales[_COARSE_SCALES:] or scales[-1:]
        best = candidates[0].evidence.score if candidates else 0.0
        enough = _MIN_SHARE * max(best, self.config.acceptance.score)
        refined: list[Candidate | None] = []
        for rank, candidate in enumerate(candidates):
            # the best and its rival are compared on equal terms; what is far below them stays as it is
            if best < enough or (rank > 1 and candidate.evidence.score < enough):
                refined.append(candidate)
                continue
            start = replace(candidate.hypothesis, T_map_odom=candidate.T_map_odom)
            refined.append(self._candidate(start, scan, scales))
        return _best_first([each for each in refined if each is not None])

    def _candidate(
        self,
        hypothesis: Hypothesis,
        scan: ScanInput,
        scales: tuple[float, ...],
        thinned: RegistrationCloud | None = None,
    ) -> Candidate | None:
        """Register and verify; None off the map, where too few points find a partner, or where the result leans."""
        start = hypothesis.T_map_odom
        target = self.local_maps.around(transform(start, scan.T_odom_body[None, :3, 3])[0])
        if target is None:
            return None
        settings = self.config.registration
        level = pose_from(rot_z(yaw_of(start)), start[:3, 3])
        upright = Prior(level, gravity_information(settings.gravity_sigma))
        iterations = None if thinned is None else _COARSE_ITERATIONS
        match = register_and_verify(self.base_map, scan, start, target, settings, scales, upright, thinned, iterations)
        if match.registration is None or tilt_of(match.T_map_odom) > self.config.acceptance.max_tilt:
            return None
        return Candidate(hypothesis, match.registration, match.evidence)


def _best_first(candidates: list[Candidate]) -> list[Candidate]:
    return sorted(candidates, key=lambda c: -c.evidence.score)


def gravity_information(sigma: float) -> Floats:
    """Information (6, 6) over (rx, ry, rz, x, y, z) of "both frames are level to ``sigma`` radians"."""
    return np.diag([sigma**-2, sigma**-2, 0.0, 0.0, 0.0, 0.0])
