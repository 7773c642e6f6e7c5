"""A drive becomes a query as in the product, and the places that a method names become poses.

What the ring buffer would hold, in the odometry's frame; then the product's own registration and verification.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

import coview_kernels as kernels
from bench.forest.worlds import Drive, in_odometry
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats, Floats32, Reals
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rot_z
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan, voxelized
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.search.acceptance import AcceptanceTest
from coview_stream.localization.search.consensus import Hypothesis, yaw_of_shift
from coview_stream.localization.search.refinement import Candidate, Refinement
from coview_stream.localization.search.request import SearchRequest

_SUBMAP = 8.0  # metres driven that are registered: four keyframes, as in the search


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
    steps = np.linalg.norm(np.diff(told[:, :3, 3], axis=0), axis=1)
    left = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])  # metres still to drive from each frame on
    recent = [part for part, metres in zip(parts, left, strict=True) if metres < _SUBMAP]
    around = _once(parts, keyframe.voxel)
    around = around[np.hypot(around[:, 0], around[:, 1]) < config.learned.reach]
    query = SearchRequest(
        stamp=0.0,
        T_odom_body=told[-1],
        scan=around,
        submap=_once(recent, keyframe.voxel),
        cloud=drive.clouds[-1],
        travelled=drive.travelled,
        surroundings=around,
    )
    return query, truth


def local(truth: Pose, origin: Floats) -> Pose:
    """Return a pose (4, 4) of the map's source relative to the map's ``origin`` (3,)."""
    moved: Pose = truth.copy()
    moved[:3, 3] -= origin
    return moved


def errors(T: Pose, truth: Pose, query: SearchRequest) -> tuple[float, float, float, float]:
    """How far a ``T_map_odom`` puts the robot off: metres in the plane, degrees of heading, metres, degrees."""
    apart = T @ query.T_odom_body @ inverse(truth @ query.T_odom_body)
    shift = (T @ query.T_odom_body)[:3, 3] - (truth @ query.T_odom_body)[:3, 3]
    heading = abs(float(np.degrees(np.arctan2(apart[1, 0], apart[0, 0]))))
    cosine = np.clip(0.5 * (np.trace(apart[:3, :3]) - 1.0), -1.0, 1.0)
    return (
        float(np.hypot(shift[0], shift[1])), heading, float(np.linalg.norm(shift)),
        float(np.degrees(np.arccos(cosine))),
    )  # fmt: skip


def _once(parts: list[Points], voxel: float) -> Points:
    points: Points = kernels.transform_unique(np.concatenate(parts), np.eye(4), voxel)[0]
    return points


BEST = 5  # places that each method names
APART = 10.0  # metres between two of them


def chosen(xy: Reals, score: Reals, count: int = BEST) -> list[int]:
    """Which of the places (N, 2) are best, higher scores (N,) being better, 10 m or more apart, best first."""
    at, left = np.asarray(xy, dtype=np.float64), np.array(score, dtype=np.float64)
    found: list[int] = []
    while len(found) < count and np.isfinite(left).any():
        k = int(np.argmax(left))
        found.append(k)
        left[np.hypot(*(at - at[k]).T) < APART] = -np.inf
    return found


def distinct(xy: Reals, score: Reals, count: int = BEST) -> Floats:
    """Return the best places (K, 2) themselves, see :func:`chosen`."""
    return np.asarray(xy, dtype=np.float64)[chosen(xy, score, count)].reshape(-1, 2)


def of_volume(volume: Floats32, stations: Floats32, centre: Floats) -> list[Hypothesis]:
    """Best stations (M, 3) of distances (M, S), each at its best shift; ``centre`` (3,) in the odometry frame."""
    found = []
    for k in chosen(stations[:, :2], -volume.min(axis=1)):
        shift = int(volume[k].argmin())
        yaw = float(yaw_of_shift(shift, volume.shape[1]))
        found.append(Hypothesis(_pose(stations[k], yaw, centre), k, shift, float(volume[k, shift])))
    return found


def of_places(xy: Floats, score: Floats, heading: Floats, stations: Floats32, centre: Floats) -> list[Hypothesis]:
    """Hypotheses of the best places (N, 2) at their headings (N,), as high as the station next to each."""
    found = []
    for k in chosen(xy, score):
        nearest = int(np.hypot(*(stations[:, :2] - xy[k]).T).argmin())
        at = np.array([*xy[k], stations[nearest, 2]])
        found.append(Hypothesis(_pose(at, float(heading[k]), centre), nearest, 0, -float(score[k])))
    return found


def _pose(at: Reals, yaw: float, centre: Floats) -> Pose:
    return pose_from(rot_z(yaw), at.astype(np.float64)) @ pose_from(np.eye(3), -centre)


class Chain:
    """Registration, verification and decision of one keyframe, as in a search."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig) -> None:
        """Register with the search's own method; the decision asks for one keyframe, not for three."""
        alone = replace(config.acceptance, confirmations=1, evidence_sum=1e-9)
        registration = replace(config.registration, method="trimmed-icp")
        self.config = replace(config, registration=registration)
        self._refinement = Refinement(base_map, self.config, LocalMaps(base_map, registration.source_range))
        self._acceptance = AcceptanceTest(replace(self.config, acceptance=alone))

    def scan(self, query: SearchRequest) -> ScanInput:
        """Return what of a query is registered."""
        points = prepare_scan(query.submap, query.position, self.config.registration)
        return ScanInput(points, query.cloud, query.T_odom_body)

    def register(self, named: list[Hypothesis], scan: ScanInput) -> list[Candidate]:
        """Return verified candidates, best first."""
        return self._refinement.fine(self._refinement.coarse(named, scan), scan)

    def metric(
        self, named: list[Hypothesis], candidates: list[Candidate], truth: Pose, query: SearchRequest
    ) -> dict[str, Any]:
        """Errors of the best hypothesis and the best candidate, and what would have been believed; plain values."""
        self._acceptance.clear()
        score = candidates[0].evidence.score if candidates else 0.0
        return {
            "before": errors(named[0].T_map_odom, truth, query)[:2] if named else None,
            "after": errors(candidates[0].T_map_odom, truth, query)[2:] if candidates else None,
            "score": score,
            "passes": bool(candidates) and score >= self.config.acceptance.score,
            "accepted": self._acceptance.decide(candidates, query, 1).accepted is not None,
        }

    def ask(self, named: list[Hypothesis], scan: ScanInput, truth: Pose, query: SearchRequest) -> dict[str, Any]:
        """Register what a method names: what :meth:`metric` says, and the milliseconds."""
        begin = time.perf_counter()
        candidates = self.register(named, scan)
        spent = round(1e3 * (time.perf_counter() - begin), 1)
        return self.metric(named, candidates, truth, query) | {"ms": spent}
