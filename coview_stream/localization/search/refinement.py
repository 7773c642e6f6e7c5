"""Candidates: the most probable place made exact, registered (eq. 13) and verified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_from, rot_z, tilt_of, transform, yaw_of
from coview_stream.localization.evidence.observation import Evidence, ObservedScan
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.register import register
from coview_stream.localization.registration.result import Prior, Registration
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.scoring import ScoredPlace

_WIDEST = 1.0  # metres: coarser scales are spared, as places are scored at the best pose near them; set by hand
_EVERY = 3  # of the scan's points is registered: the score is the same to 0.002 and the pose to a centimetre; by hand


@dataclass(frozen=True)
class Candidate:
    """A registered and verified hypothesis of ``T_map_odom``.

    Attributes:
        place: where it began.
        registration: what came of it.
        evidence: shares of the scan that fit the map there.
    """

    place: ScoredPlace
    registration: Registration
    evidence: Evidence

    @property
    def hypothesis(self) -> Hypothesis:
        """The hypothesis that named the place."""
        return self.place.hypothesis

    @property
    def T_map_odom(self) -> Pose:
        """(4, 4) map <- odometry."""
        return self.registration.T_map_source


def register_place(
    place: ScoredPlace, scan: ObservedScan, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps
) -> Candidate | None:
    """Register a scan at a place and verify it; None off the map, with too few pairs, or if the result leans."""
    settings = config.registration
    scales = tuple(scale for scale in settings.search if scale <= _WIDEST) or settings.search[-1:]
    start = place.hypothesis.T_map_odom
    target = local_maps.around(transform(start, scan.T_odom_body[None, :3, 3])[0])
    if target is None:
        return None
    level = pose_from(rot_z(yaw_of(start)), start[:3, 3])
    upright = Prior(level, gravity_information(settings.gravity_sigma))
    registration = register(scan.cloud.every(_EVERY), start, target, settings, scales, upright, scan.body)
    if registration is None or tilt_of(registration.T_map_source) > config.acceptance.max_tilt:
        return None
    return Candidate(place, registration, scan.evidence(base_map.field, registration.T_map_source))


def gravity_information(sigma: float) -> Floats:
    """Information (6, 6) over (rx, ry, rz, x, y, z) of "both frames are level to ``sigma`` radians"."""
    return np.diag([sigma**-2, sigma**-2, 0.0, 0.0, 0.0, 0.0])
