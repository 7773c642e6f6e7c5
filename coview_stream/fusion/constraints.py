"""Constraints of a joint adjustment: submaps registered to the base map, and to each other where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.errors import InputError
from coview_stream.fusion.submaps import Submap
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, along_body, boxminus, inverse
from coview_stream.localization.registration.covariance import registration_covariance, remove_prior
from coview_stream.localization.registration.local_map import LocalMap, LocalMaps
from coview_stream.localization.registration.register import register
from coview_stream.localization.registration.result import Prior
from coview_stream.localization.tracking.shared_error import SharedErrorModel

AGREE = 3.0
"""Sigmas per degree of freedom up to which two poses say the same; set by hand, as is what follows."""

_BELIEF = np.array([np.radians(3.0)] * 3 + [0.7] * 3)  # how far off the poses may be that registration starts from
_SCALES = (1.6, 0.8, 0.4)  # metres
_APART = 10.0  # metres between two keyframes that are registered to each other, at most
_LOOP = 30.0  # metres that a run has driven between two of its own, at least
_OTHERS = 2  # of each other run that one is registered to, at most
_ON_MAP, _ON_SUBMAP = 0.1, 0.3  # shares of the points that have to find a partner
_MATCH = 0.5  # metres: farther apart it is not the same surface
_FLAT = 0.5  # planarity of the surfaces of which distances are taken


@dataclass(frozen=True, eq=False)
class Constraint:
    """What one registration says.

    Attributes:
        source: index of the submap that was registered.
        target: index of the one that it was registered to; -1: the base map.
        T: (4, 4) pose of the source's body, relative to the target's body or to the map's origin.
        covariance: (6, 6) over (rx, ry, rz, x, y, z) of it, along the axes of the source's body.
    """

    source: int
    target: int
    T: Pose
    covariance: Floats


class Registrar:
    """Registers submaps, and tells how far their surfaces are apart."""

    def __init__(self, submaps: Sequence[Submap], maps: LocalMaps) -> None:
        """Take submaps, and the crops of the base map."""
        self.submaps = submaps
        self._maps = maps
        self._config = RegistrationConfig()

    def to_map(self, k: int) -> Constraint | None:
        """Register submap ``k`` to the base map from where ``locate`` had it; None where too little is alike.

        Where both agree the pose is the one of ``locate``, which knows the registrations of all frames before.
        """
        T_located = self.submaps[k].T_map_body
        target = self._maps.around(T_located[:3, 3])
        found = None if target is None else self._registered(k, -1, target, T_located, np.eye(4))
        if found is None or off_by(found, T_located) > AGREE:
            return found
        return replace(found, T=T_located)

    def to_submap(self, k: int, other: int) -> Constraint | None:
        """Register submap ``k`` to another from where ``locate`` had both; None where too little is alike."""
        target = self.submaps[other].target
        T_start = inverse(self.submaps[other].T_map_body) @ self.submaps[k].T_map_body
        back = self.submaps[other].T_submap_body
        return None if target is None else self._registered(k, other, target, back @ T_start, inverse(back))

    def _registered(self, k: int, other: int, target: LocalMap, T_start: Pose, T_answer: Pose) -> Constraint | None:
        scan, turn = self.submaps[k].source, self.submaps[k].T_submap_body
        if not len(scan.points):
            return None
        information, pivot, config = np.diag(_BELIEF**-2), np.zeros(3), self._config
        prior = Prior(T_start @ inverse(turn), information)
        found = register(scan, prior.T_map_source, target, config, _SCALES, prior, pivot)
        if found is None or found.pairs < (_ON_MAP if other < 0 else _ON_SUBMAP) * config.keep * len(scan.points):
            return None
        shared = SharedErrorModel(config)
        shared.learn(scan, found.T_map_source, target, pivot)
        try:
            own = remove_prior(found.T_map_source @ turn, found.information, T_start, information, config)
            covariance = registration_covariance(own.information, config) + shared.covariance
        except InputError:
            return None
        return Constraint(k, other, T_answer @ own.T_map_body, along_body(covariance, own.T_map_body))

    def apart_from_map(self, k: int, T_map_body: Pose) -> Floats:
        """Return distances (M,) of a submap's points to the base map's surfaces, within half a metre."""
        target = self._maps.around(T_map_body[:3, 3])
        return np.zeros(0) if target is None else self._apart(k, target, T_map_body)

    def apart(self, k: int, other: int, poses: Floats) -> Floats:
        """Return distances (M,) of a submap's points to another's surfaces, if bodies are at poses (S, 4, 4)."""
        target = self.submaps[other].target
        T = self.submaps[other].T_submap_body @ inverse(poses[other]) @ poses[k]
        return np.zeros(0) if target is None else self._apart(k, target, T)

    def _apart(self, k: int, target: LocalMap, T_target_body: Pose) -> Floats:
        T, points = T_target_body @ inverse(self.submaps[k].T_submap_body), self.submaps[k].source.points
        distance, partner = kernels.nearest(target.grid, points, _MATCH, T)
        near = np.flatnonzero(np.isfinite(distance))
        if not len(near):
            return np.zeros(0)
        normals, planarity = target.planes(partner[near])
        gap = points[near] @ T[:3, :3].T + T[:3, 3] - target.points[partner[near]]
        return np.asarray(np.abs(np.einsum("ij,ij->i", gap, normals))[planarity > _FLAT])


def off_by(constraint: Constraint, T: Pose) -> float:
    """Return by how many sigmas, per degree of freedom, a pose (4, 4) is off what a constraint says."""
    gap, R = boxminus(constraint.T, T), constraint.T[:3, :3]
    gap = np.concatenate([gap[:3] @ R, gap[3:] @ R])
    return float(np.sqrt(gap @ np.linalg.solve(constraint.covariance, gap) / 6.0))


def overlapping(submaps: Sequence[Submap]) -> list[tuple[int, int]]:
    """Return pairs of submaps that see the same place: nearest ones of other runs, and loops of the same run."""
    places = np.array([submap.T_map_body[:3, 3] for submap in submaps])
    runs = np.array([submap.run for submap in submaps])
    driven = np.array([submap.driven for submap in submaps])
    pairs: set[tuple[int, int]] = set()
    for k in range(len(submaps)):
        away: NDArray[np.float64] = np.linalg.norm(places - places[k], axis=1)
        for run in np.unique(runs):
            may = (runs == run) & (away <= _APART) & ((run != runs[k]) | (np.abs(driven - driven[k]) >= _LOOP))
            nearest = np.flatnonzero(may)[np.argsort(away[may], kind="stable")][:_OTHERS]
            pairs.update((max(k, int(other)), min(k, int(other))) for other in nearest)
    return sorted(pairs)
