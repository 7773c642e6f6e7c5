"""Constraints of a joint adjustment: submaps registered to the base map, and overlapping submaps to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

import coview_kernels as kernels
from coview_stream.basemap.tiles import scaled_normals
from coview_stream.clouds.filters import estimate_normals
from coview_stream.config import RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.errors import InputError
from coview_stream.fusion.localized_run import LocalizedRun
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, Pose, along_body, boxminus, inverse, pose_from, yaw_of
from coview_stream.localization.registration.clouds import LocalMap, LocalMaps, RegistrationCloud, prepare_scan
from coview_stream.localization.registration.register import register, registration_covariance, remove_prior
from coview_stream.localization.tracking.batch_graph import Constraint
from coview_stream.localization.tracking.shared_error import SharedErrorModel

STEP = 4.0  # metres driven between keyframes
_REACH = 2.0  # metres driven before and after a keyframe within which frames join its submap
_EVERY = 0.5  # metres driven between these frames
_VOXEL = 0.2  # metres
_NEAR, _FAR = 1.5, 50.0  # metres from the lidar
_NEIGHBOURS, _RADIUS = 20, 1.0  # for normals; metres

AGREE = 3.0
"""Greatest :func:`off_by` of two poses that agree; chosen by hand, like the next."""
_SIGMAS = np.array([np.radians(3.0)] * 3 + [0.7] * 3)  # radians and metres, prior on a registration's initial pose
_SCALES = (1.6, 0.8, 0.4)  # metres
_APART = 10.0  # largest distance between two registered keyframes, metres
_LOOP = 30.0  # least metres driven between two registered keyframes of one run
_OTHERS = 2  # keyframes per run to which a keyframe is registered, at most
_ON_MAP, _ON_SUBMAP = 0.1, 0.3  # least shares of the scan's kept points that find a partner
_MATCH = 0.5  # largest distance between points of one surface, metres
_FLAT = 0.5  # least planarity of a surface from which distances are measured


@dataclass(frozen=True, eq=False)
class Submap:
    """A keyframe and the points around it: origin at the body, axes of the map according to ``locate``'s pose."""

    run: int  # number of the run, from 0
    index: int  # of the keyframe among the run's frames with a pose
    driven: float  # metres along the run
    turned: float  # radians along the run, all turns counted positive
    T_map_body: Pose  # (4, 4) by locate, relative to the map's origin
    T_odom_body: Pose  # (4, 4)
    points: Points  # (N, 3) float32, metres

    @property
    def T_submap_body(self) -> Pose:
        """Pose (4, 4) of the body in the submap: its rotation in the map, without translation."""
        return pose_from(self.T_map_body[:3, :3], np.zeros(3))

    @cached_property
    def source(self) -> RegistrationCloud:
        """The points, prepared as a registration's source."""
        return prepare_scan(self.points, np.zeros(3), RegistrationConfig())

    @cached_property
    def target(self) -> LocalMap | None:
        """The points as a registration's target; None if there are too few."""
        if len(self.points) < MIN_PAIRS:
            return None
        normals, planarity = estimate_normals(self.points, _NEIGHBOURS, _RADIUS)
        return LocalMap(self.points, scaled_normals(normals, planarity))


def submaps_of(run: LocalizedRun, number: int, origin: Floats) -> list[Submap]:
    """Return the submaps of run ``number`` in order, on a map with ``origin`` (3,); no frame is read twice."""
    odometry = run.odometry
    driven, turned = path_of(odometry)
    wanted = np.zeros(len(run), dtype=bool)
    wanted[spaced(driven, _EVERY)] = True
    keys = spaced(driven, STEP)
    near: list[list[Points]] = [[] for _ in keys]
    for k, frame in enumerate(run.frames(lambda k: bool(wanted[k]))):
        if frame is None:
            continue
        far = np.linalg.norm(frame.points - frame.eye.astype(np.float32), axis=1)
        points = frame.points[(far >= _NEAR) & (far < _FAR)]
        for at in np.flatnonzero(np.abs(driven[keys] - driven[k]) <= _REACH):
            T = frame.T_map_body.copy()
            T[:3, 3] -= run.poses[keys[at], :3, 3] - origin
            near[at].append(kernels.transform_unique(points, T, _VOXEL)[0])
    submaps = []
    for key, parts in zip(keys, near, strict=True):
        cloud = np.concatenate([np.zeros((0, 3), dtype=np.float32), *parts])
        cloud = kernels.transform_unique(cloud, np.eye(4), _VOXEL)[0]
        T = run.poses[key].copy()
        T[:3, 3] -= origin
        submaps.append(Submap(number, int(key), float(driven[key]), float(turned[key]), T, odometry[key], cloud))
    return submaps


def path_of(poses: Floats) -> tuple[Floats, Floats]:
    """Return metres driven (K,) and radians turned (K,) up to each of the poses (K, 4, 4)."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [abs(yaw_of(inverse(a) @ b)) for a, b in pairwise(poses)]
    return np.append(0.0, np.cumsum(steps)), np.append(0.0, np.cumsum(np.asarray(turns, dtype=np.float64)))


def spaced(driven: Floats, step: float) -> Ints:
    """Choose indices into metres driven (K,): 0, others ``step`` or more apart, the last if over half a step away."""
    chosen = [0]
    for k in range(1, len(driven)):
        if driven[k] - driven[chosen[-1]] >= step:
            chosen.append(k)
    if driven[-1] - driven[chosen[-1]] > 0.5 * step:
        chosen.append(len(driven) - 1)
    return np.asarray(chosen, dtype=np.int64)


class Registrar:
    """Registration of submaps, and distances between their surfaces."""

    def __init__(self, submaps: Sequence[Submap], maps: LocalMaps) -> None:
        """Register submaps to crops of the base map and to each other."""
        self.submaps = submaps
        self._maps = maps
        self._config = RegistrationConfig()

    def to_map(self, k: int) -> Constraint | None:
        """Register submap ``k`` to the base map from the pose of ``locate``; None if that fails or too few points pair.

        If the result agrees with the pose of ``locate``, that pose is taken: it includes all earlier registrations.
        """
        T_located = self.submaps[k].T_map_body
        target = self._maps.around(T_located[:3, 3])
        constraint = None if target is None else self._registered(k, -1, target, T_located, np.eye(4))
        if constraint is None or off_by(constraint, T_located) > AGREE:
            return constraint
        return replace(constraint, T=T_located)

    def to_submap(self, k: int, other: int) -> Constraint | None:
        """Register submap ``k`` to another from the poses of ``locate``; None if that fails or too few points pair."""
        target = self.submaps[other].target
        T_start = inverse(self.submaps[other].T_map_body) @ self.submaps[k].T_map_body
        back = self.submaps[other].T_submap_body
        return None if target is None else self._registered(k, other, target, back @ T_start, inverse(back))

    def _registered(self, k: int, other: int, target: LocalMap, T_start: Pose, T_answer: Pose) -> Constraint | None:
        scan, turn = self.submaps[k].source, self.submaps[k].T_submap_body
        if not len(scan.points):
            return None
        information, pivot, config = np.diag(_SIGMAS**-2), np.zeros(3), self._config
        prior = kernels.Prior(T_start @ inverse(turn), information)
        match = register(scan, prior.T_map_source, target, config, _SCALES, prior, pivot)
        if match is None or match.pairs < (_ON_MAP if other < 0 else _ON_SUBMAP) * config.keep * len(scan.points):
            return None
        shared = SharedErrorModel(config)
        shared.learn(scan, match.T_map_source, target, pivot, 0.0)
        try:
            of_body = match._replace(T_map_source=match.T_map_source @ turn)
            T, measured = remove_prior(of_body, kernels.Prior(T_start, information), config)
            covariance = registration_covariance(measured, config) + shared.covariance
        except InputError:
            return None
        return Constraint(k, other, T_answer @ T, along_body(covariance, T))

    def apart_from_map(self, k: int, T_map_body: Pose) -> Floats:
        """Return distances (M,) of a submap's points to the base map's surfaces, within half a metre."""
        target = self._maps.around(T_map_body[:3, 3])
        return np.zeros(0) if target is None else self._apart(k, target, T_map_body)

    def apart(self, k: int, other: int, poses: Floats) -> Floats:
        """Return distances (M,) of a submap's points to another's surfaces, with the bodies at poses (S, 4, 4)."""
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
    """Return the distance of a pose (4, 4) from a constraint: root mean square of the six errors in sigmas."""
    gap, R = boxminus(constraint.T, T), constraint.T[:3, :3]
    gap = np.concatenate([gap[:3] @ R, gap[3:] @ R])
    return float(np.sqrt(gap @ np.linalg.solve(constraint.covariance, gap) / 6.0))


def overlapping(submaps: Sequence[Submap]) -> list[tuple[int, int]]:
    """Return pairs of submaps at the same place: nearest submaps of other runs, and loops of the same run."""
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
