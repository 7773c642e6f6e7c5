"""From the places that a method names to poses, by the product's own registration and verification."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest.query import errors
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.decision import Decision
from coview_stream.geometry import Pose, pose_from, rot_z
from coview_stream.place.consensus import Hypothesis, yaw_of_shift
from coview_stream.pose.registration import LocalMaps, Source
from coview_stream.pose.source import local_source
from coview_stream.query import Query
from coview_stream.refinement import Candidate, Refinement

Floats = npt.NDArray[np.float64]

BEST = 5
"""Places that each method names."""
APART = 10.0
"""Metres between two of them."""


def chosen(xy: npt.NDArray[np.floating], score: npt.NDArray[np.floating], count: int = BEST) -> list[int]:
    """Which of the places (N, 2) are best, higher scores (N,) being better, 10 m or more apart, best first."""
    at, left = np.asarray(xy, dtype=np.float64), np.array(score, dtype=np.float64)
    found: list[int] = []
    while len(found) < count and np.isfinite(left).any():
        k = int(np.argmax(left))
        found.append(k)
        left[np.hypot(*(at - at[k]).T) < APART] = -np.inf
    return found


def distinct(xy: npt.NDArray[np.floating], score: npt.NDArray[np.floating], count: int = BEST) -> Floats:
    """Return the best places (K, 2) themselves, see :func:`chosen`."""
    return np.asarray(xy, dtype=np.float64)[chosen(xy, score, count)].reshape(-1, 2)


def of_volume(
    volume: npt.NDArray[np.float32], stations: npt.NDArray[np.float32], centre: Floats
) -> list[Hypothesis]:
    """Best stations (M, 3) of distances (M, S), each at its best shift; ``centre`` (3,) in the odometry frame."""
    found = []
    for k in chosen(stations[:, :2], -volume.min(axis=1)):
        shift = int(volume[k].argmin())
        yaw = float(yaw_of_shift(shift, volume.shape[1]))
        found.append(Hypothesis(_pose(stations[k], yaw, centre), k, shift, float(volume[k, shift])))
    return found


def of_places(
    xy: Floats, score: Floats, heading: Floats, stations: npt.NDArray[np.float32], centre: Floats
) -> list[Hypothesis]:
    """Hypotheses of the best places (N, 2) at their headings (N,), as high as the station next to each."""
    found = []
    for k in chosen(xy, score):
        nearest = int(np.hypot(*(stations[:, :2] - xy[k]).T).argmin())
        at = np.array([*xy[k], stations[nearest, 2]])
        found.append(Hypothesis(_pose(at, float(heading[k]), centre), nearest, 0, -float(score[k])))
    return found


def _pose(at: npt.NDArray[np.floating], yaw: float, centre: Floats) -> Pose:
    return pose_from(rot_z(yaw), at.astype(np.float64)) @ pose_from(np.eye(3), -centre)


class Chain:
    """Registration, verification and decision of one keyframe, as in a search."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig) -> None:
        """Register with the search's own method; the decision asks for one keyframe, not for three."""
        alone = replace(config.acceptance, confirmations=1, proof=1e-9)
        registration = replace(config.registration, method="trimmed-icp")
        self.config = replace(config, registration=registration)
        self._refinement = Refinement(base_map, self.config, LocalMaps(base_map, registration.source_range))
        self._decision = Decision(replace(self.config, acceptance=alone))

    def source(self, query: Query) -> Source:
        """Return what of a query is registered."""
        return local_source(query.submap, query.position, self.config.registration)

    def register(self, named: list[Hypothesis], moving: Source, query: Query) -> list[Candidate]:
        """Return verified candidates, best first."""
        return self._refinement.refine(named, moving, query)

    def metric(
        self, named: list[Hypothesis], candidates: list[Candidate], truth: Pose, query: Query
    ) -> dict[str, Any]:
        """Errors of the best hypothesis and the best candidate, and what would have been believed; plain values."""
        self._decision.clear()
        score = candidates[0].evidence.score if candidates else 0.0
        return {
            "before": errors(named[0].T_map_odom, truth, query)[:2] if named else None,
            "after": errors(candidates[0].T_map_odom, truth, query)[2:] if candidates else None,
            "score": score,
            "passes": bool(candidates) and score >= self.config.acceptance.score,
            "accepted": self._decision.judge(candidates, query, 1).accepted is not None,
        }

    def ask(self, named: list[Hypothesis], moving: Source, truth: Pose, query: Query) -> dict[str, Any]:
        """Register what a method names: what :meth:`metric` says, and the milliseconds."""
        begin = time.perf_counter()
        candidates = self.register(named, moving, query)
        spent = round(1e3 * (time.perf_counter() - begin), 1)
        return self.metric(named, candidates, truth, query) | {"ms": spent}
