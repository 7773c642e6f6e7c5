"""A drive becomes a query as in the product, and the places that a method names become poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import coview_kernels as kernels
from bench.forest.worlds import Drive, in_odometry
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats, Floats32, Reals
from coview_stream.geometry.transforms import Pose, inverse, pose_from, rot_z, rotation_angle, yaw_of
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan, voxelized
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.search.consensus import Hypothesis, yaw_of_shift
from coview_stream.localization.search.refinement import Candidate, register_place
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.scoring import PlaceScorer, Scored
from coview_stream.report.evaluation import driven

BEST, APART = 5, 10.0  # places that each method names, and metres between two of them
_SUBMAP = 8.0  # metres driven that are registered: four keyframes, as in the search
_REGISTERED = 3  # most probable places that are registered; a search registers the first alone


def query_of(drive: Drive, config: LocalizerConfig) -> tuple[SearchRequest, Pose]:
    """Return the query of the newest frame, and the true pose (4, 4) map <- odometry, of the map's source.

    The odometry's origin is put where the robot is now.
    """
    told, truth = in_odometry(drive)
    keyframe = config.keyframe
    parts = [
        voxelized(cloud, T, keyframe) if len(cloud) else np.empty((0, 3), dtype=np.float32)
        for cloud, T in zip(drive.clouds, told, strict=True)
    ]
    left = driven(told[::-1])[::-1]  # metres still to drive from each frame on
    recent = [part for part, metres in zip(parts, left, strict=True) if metres < _SUBMAP]
    submap, around = (
        kernels.transform_unique(np.concatenate(some), np.eye(4), keyframe.voxel)[0] for some in (recent, parts)
    )
    around = around[np.hypot(around[:, 0], around[:, 1]) < config.learned.reach]
    query = SearchRequest(
        stamp=0.0, T_odom_body=told[-1], scan=around, submap=submap, cloud=drive.clouds[-1],
        travelled=drive.travelled, surroundings=around,
    )  # fmt: skip
    return query, truth


def errors(T: Pose, truth: Pose, query: SearchRequest) -> tuple[float, float, float, float]:
    """How far a ``T_map_odom`` puts the robot off: metres in the plane, degrees of heading, metres, degrees."""
    found, true = T @ query.T_odom_body, truth @ query.T_odom_body
    apart, shift = found @ inverse(true), found[:3, 3] - true[:3, 3]
    metres = float(np.hypot(shift[0], shift[1])), float(np.linalg.norm(shift))
    return metres[0], abs(float(np.degrees(yaw_of(apart)))), metres[1], float(np.degrees(rotation_angle(apart)))


def best_places(xy: Reals, score: Reals, count: int = BEST) -> list[int]:
    """Which of the places (N, 2) are best, higher scores (N,) being better, 10 m or more apart, best first."""
    at, left = np.asarray(xy, dtype=np.float64), np.array(score, dtype=np.float64)
    found: list[int] = []
    while len(found) < count and np.isfinite(left).any():
        k = int(np.argmax(left))
        found.append(k)
        left[np.hypot(*(at - at[k]).T) < APART] = -np.inf
    return found


def distinct(xy: Reals, score: Reals, count: int = BEST) -> Floats:
    """Return the best places (K, 2) themselves, see :func:`best_places`."""
    return np.asarray(xy, dtype=np.float64)[best_places(xy, score, count)].reshape(-1, 2)


def of_volume(volume: Floats32, stations: Floats32, centre: Floats) -> list[Hypothesis]:
    """Best stations (M, 3) of distances (M, S), each at its best shift; ``centre`` (3,) in the odometry frame."""
    found = []
    for k in best_places(stations[:, :2], -volume.min(axis=1)):
        shift = int(volume[k].argmin())
        yaw = float(yaw_of_shift(shift, volume.shape[1]))
        found.append(Hypothesis(_pose(stations[k], yaw, centre), k, shift, float(volume[k, shift])))
    return found


def of_places(xy: Floats, score: Floats, heading: Floats, stations: Floats32, centre: Floats) -> list[Hypothesis]:
    """Hypotheses of the best places (N, 2) at their headings (N,), as high as the station next to each."""
    found = []
    for k in best_places(xy, score):
        nearest = int(np.hypot(*(stations[:, :2] - xy[k]).T).argmin())
        at = np.array([*xy[k], stations[nearest, 2]])
        found.append(Hypothesis(_pose(at, float(heading[k]), centre), nearest, 0, -float(score[k])))
    return found


def _pose(at: Reals, yaw: float, centre: Floats) -> Pose:
    return pose_from(rot_z(yaw), at) @ pose_from(np.eye(3), -centre)


class Chain:
    """Evidence, registration, verification and decision of one keyframe, as in a search."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig) -> None:
        """Register with the search's own method."""
        registration = replace(config.registration, method="trimmed-icp")
        self.config = replace(config, registration=registration)
        self._base_map, self._local_maps = base_map, LocalMaps(base_map, registration.source_range)

    def scan(self, query: SearchRequest) -> ScanInput:
        """Return what of a query is registered."""
        points = prepare_scan(query.submap, query.position, self.config.registration)
        return ScanInput(points, query.cloud, query.T_odom_body)

    def register(self, named: list[Hypothesis], scan: ScanInput) -> tuple[Scored, list[Candidate]]:
        """Return the evidence of the places named, and the most probable of them registered, in that order."""
        scored = PlaceScorer(self._base_map).score(named, range(len(named)), 0, scan)
        found = [
            register_place(place, scan, self._base_map, self.config, self._local_maps)
            for place in scored.places[:_REGISTERED]
        ]
        return scored, [each for each in found if each is not None]

    def metric(
        self, named: list[Hypothesis], judged: tuple[Scored, list[Candidate]], truth: Pose, query: SearchRequest
    ) -> dict[str, Any]:
        """Errors of the best hypothesis and the best candidate, and what would have been believed; plain values."""
        scored, candidates = judged
        return {
            "before": errors(named[0].T_map_odom, truth, query)[:2] if named else None,
            "after": errors(candidates[0].T_map_odom, truth, query)[2:] if candidates else None,
            "passes": bool(candidates) and scored.error < 0.5,
        }
