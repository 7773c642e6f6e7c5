"""Submaps: what a run saw within a few metres of a keyframe, put together by the poses that ``locate`` found.

Not by odometry: over a few metres it smears more than these poses do, by what they have learned of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

import coview_kernels as kernels
from coview_stream.basemap.tiles import scaled_normals
from coview_stream.clouds.filters import estimate_normals
from coview_stream.config import RegistrationConfig
from coview_stream.fusion.localized_run import LocalizedRun
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, yaw_of
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud, prepare_scan
from coview_stream.localization.registration.result import MIN_PAIRS

# set by hand
STEP = 4.0  # metres driven from keyframe to keyframe
_REACH = 2.0  # metres driven before and after it of which the frames are taken
_EVERY = 0.5  # metres from one of these frames to the next
_VOXEL = 0.2  # metres
_NEAR, _FAR = 1.5, 50.0  # metres from the lidar
_NEIGHBOURS, _RADIUS = 20, 1.0  # of normals


@dataclass(frozen=True, eq=False)
class Submap:
    """One keyframe and what was seen around it.

    Its frame has its origin in the body, and the map's axes as ``locate`` had them.

    Attributes:
        run: number of the run, from 0.
        index: of the keyframe among the run's frames that have a pose.
        driven: metres along the run.
        turned: radians, likewise, all turns counted positive.
        T_map_body: (4, 4) as ``locate`` had it, relative to the map's origin.
        T_odom_body: (4, 4).
        points: (N, 3) float32, its frame, metres.
    """

    run: int
    index: int
    driven: float
    turned: float
    T_map_body: Pose
    T_odom_body: Pose
    points: Points

    @property
    def T_submap_body(self) -> Pose:
        """The turn (4, 4) from the body's axes to the submap's."""
        return pose_from(self.T_map_body[:3, :3], np.zeros(3))

    @cached_property
    def source(self) -> RegistrationCloud:
        """The points as they are registered to others."""
        return prepare_scan(self.points, np.zeros(3), RegistrationConfig())

    @cached_property
    def target(self) -> LocalMap | None:
        """The points as others are registered to them; None where they are too few."""
        if len(self.points) < MIN_PAIRS:
            return None
        normals, planarity = estimate_normals(self.points, _NEIGHBOURS, _RADIUS)
        return LocalMap(self.points, scaled_normals(normals, planarity))


def submaps_of(run: LocalizedRun, number: int, origin: Floats) -> list[Submap]:
    """Return the submaps of a run, in order; every frame is read once at most.

    Args:
        run: where it was localized.
        number: its own, from 0.
        origin: (3,) of the map.
    """
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
    out = []
    for key, parts in zip(keys, near, strict=True):
        cloud = np.concatenate(parts) if parts else np.zeros((0, 3), dtype=np.float32)
        cloud = kernels.transform_unique(cloud, np.eye(4), _VOXEL)[0]
        T = run.poses[key].copy()
        T[:3, 3] -= origin
        out.append(Submap(number, int(key), float(driven[key]), float(turned[key]), T, odometry[key], cloud))
    return out


def path_of(poses: Floats) -> tuple[Floats, Floats]:
    """Return metres driven (K,) and radians turned (K,) up to each of some poses (K, 4, 4)."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [abs(yaw_of(inverse(a) @ b)) for a, b in pairwise(poses)]
    return np.append(0.0, np.cumsum(steps)), np.append(0.0, np.cumsum(np.asarray(turns, dtype=np.float64)))


def spaced(driven: Floats, step: float) -> Ints:
    """Return indices of the first of (K,) metres driven, of those ``step`` and more after the one before, and the last.

    The last is left out where it is within half a step of the one before.
    """
    chosen = [0]
    for k in range(1, len(driven)):
        if driven[k] - driven[chosen[-1]] >= step:
            chosen.append(k)
    if driven[-1] - driven[chosen[-1]] > 0.5 * step:
        chosen.append(len(driven) - 1)
    return np.asarray(chosen, dtype=np.int64)
