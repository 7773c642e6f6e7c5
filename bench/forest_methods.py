"""Every way of finding a place, asked the same query on the same map: where the robot is, and how long it took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest_canopy import Canopy, seen_from
from bench.forest_query import errors, local, query_of
from bench.forest_worlds import Drive
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.decision import Decision
from coview_stream.geometry import Pose, transform
from coview_stream.place.consensus import Consensus, Hypothesis, standardised
from coview_stream.place.descriptor import describe, ground_below
from coview_stream.place.learned.votes import LearnedMap, View
from coview_stream.place.retrieval import Retrieval
from coview_stream.pose.registration import LocalMaps
from coview_stream.pose.source import local_source
from coview_stream.query import Query
from coview_stream.refinement import Refinement

Floats = npt.NDArray[np.float64]

METHODS = ("scan context", "co-view", "both", "canopy", "global", "dense", "keypoints", "verified")
"""In the tables' order."""

BEST = 5
"""Places that each method names."""
APART = 10.0
"""Metres between two of them."""


def distinct(xy: npt.NDArray[np.floating], score: npt.NDArray[np.floating], count: int = BEST) -> Floats:
    """Return the best places (K, 2) of (N, 2), higher scores (N,) being better, 10 m or more apart, best first."""
    at, left = np.asarray(xy, dtype=np.float64), np.array(score, dtype=np.float64)
    found: list[Floats] = []
    while len(found) < count and np.isfinite(left).any():
        k = int(np.argmax(left))
        found.append(at[k])
        left[np.hypot(*(at - at[k]).T) < APART] = -np.inf
    return np.array(found).reshape(-1, 2)


class Methods:
    """All methods on one map, which has been built with learned features."""

    def __init__(self, base_map: BaseMap) -> None:
        """Prepare everything that a first query would wait for.

        Raises:
            MapError: the map has no learned features, or some of other weights.
        """
        usual = LocalizerConfig(reloc="learned")
        alone = replace(usual.acceptance, confirmations=1, proof=1e-9)
        self.config = usual
        self.base_map = base_map
        self._retrieval = Retrieval(base_map, usual.retrieval)
        self._retrieval.prepare()
        self._canopy = Canopy(base_map.points)
        features = base_map.learned
        if features is None:
            raise ValueError("the map has no learned features")
        self._learned = LearnedMap(features, base_map.stations, usual.learned)
        self._learned.prepare()
        self._refinement = Refinement(base_map, usual, LocalMaps(base_map, usual.registration.source_range))
        self._decision = Decision(replace(usual, acceptance=alone))

    @property
    def chance(self) -> float:
        """Share of the places that the map knows from which 10 m reach the right one, if one of them is drawn."""
        area = len(self.base_map.stations) * self.base_map.config.block**2
        return float(min(1.0, np.pi * APART**2 / area))

    def ask(self, drive: Drive) -> dict[str, Any]:
        """Ask all methods; distances (metres), errors, and milliseconds, all plain values."""
        query, truth = query_of(drive, self.config)
        truth = local(truth, self.base_map.origin)
        robot = (truth @ query.T_odom_body)[:2, 3]
        clock = _Clock()
        found = {**self._by_descriptors(query, clock), "canopy": self._by_canopy(query, clock)}
        answer: dict[str, Any] = {"sensor": drive.sensor, "travelled": drive.travelled, "chance": self.chance}
        more, metric = self._by_features(query, truth, clock)
        apart = {name: np.hypot(*(at - robot).T) for name, at in (found | more).items()}
        answer["off"] = {name: np.round(values, 2).tolist() for name, values in apart.items()}
        return answer | metric | {"ms": {name: round(1e3 * s, 1) for name, s in clock.seconds.items()}}

    def _by_descriptors(self, query: Query, clock: _Clock) -> dict[str, Floats]:
        stations = self.base_map.stations[:, :2]
        with clock("descriptors"):
            centre = query.position.copy()
            centre[2] = ground_below(query.scan, query.position)
            volumes = self._retrieval.distances(describe(query.scan, centre, self.base_map.descriptor_config))
            both = standardised(volumes["scan_context"]) + standardised(volumes["coview"])
        named = {"scan context": volumes["scan_context"], "co-view": volumes["coview"], "both": both}
        return {name: distinct(stations, -volume.min(axis=1)) for name, volume in named.items()}

    def _by_canopy(self, query: Query, clock: _Clock) -> Floats:
        with clock("canopy"):
            xy, top = seen_from(query.surroundings, query.position)
            score, _ = self._canopy.search(xy, top)
        return distinct(self._canopy.places, score.ravel())

    def _by_features(
        self, query: Query, truth: Pose, clock: _Clock
    ) -> tuple[dict[str, Floats], dict[str, Any]]:
        centre = query.position.copy()
        centre[2] = ground_below(query.surroundings, query.position)
        with clock("network"):
            view = self._learned.view(query.surroundings, centre)
        with clock("correlation"):
            volume = self._learned.distances(view)
            consensus = Consensus(
                self.base_map.stations,
                self.base_map.config.block,
                replace(self.config.consensus, mode="consensus", peaks=self.config.learned.peaks),
            )
            consensus.vote(centre, {"learned": volume})
            voted = [replace(each, learned=True) for each in consensus.hypotheses()]
        with clock("keypoints"):
            sharpened = self._learned.sharpened(voted, view)
        with clock("registration"):
            moving = local_source(query.submap, query.position, self.config.registration)
            candidates = self._refinement.refine(sharpened, moving, query)
        self._decision.clear()
        accepted = self._decision.judge(candidates, query, 1).accepted is not None
        verified = [Hypothesis(c.T_map_odom, 0, 0, -c.evidence.score) for c in candidates]
        places = {
            "global": self._by_global_descriptor(view),
            "dense": distinct(self.base_map.stations[:, :2], -volume.min(axis=1)),
            "keypoints": _in_turn(sharpened, query),
            "verified": _in_turn(verified, query),
        }
        metric: dict[str, Any] = {
            "dense": errors(voted[0].T_map_odom, truth, query)[:2],
            "before": errors(sharpened[0].T_map_odom, truth, query)[:2],
            "after": errors(verified[0].T_map_odom, truth, query)[2:] if verified else None,
            "score": candidates[0].evidence.score if candidates else 0.0,
            "passes": bool(candidates) and candidates[0].evidence.score >= self.config.acceptance.score,
            "accepted": accepted,
        }
        return places, metric

    def _by_global_descriptor(self, view: View) -> Floats:
        features = self._learned.features
        return distinct(features.place_at, features.place.astype(np.float32) @ view.place)


def _in_turn(hypotheses: list[Hypothesis], query: Query) -> Floats:
    """Places (K, 2) of hypotheses in their order, those left out that are near a better one."""
    at = [transform(each.T_map_odom, query.position[None])[0, :2] for each in hypotheses]
    return distinct(np.array(at).reshape(-1, 2), -np.arange(len(at), dtype=np.float64))


class _Clock:
    """Seconds by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin
