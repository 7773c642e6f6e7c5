"""Every way of finding a place, asked the same query on the same map: where the robot is, and how long it took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest.canopy import Canopy, seen_from
from bench.forest.query import APART, Chain, distinct, errors, local, of_places, of_volume, query_of
from bench.forest.worlds import Drive
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.localization.search.consensus import Consensus, Hypothesis, robust_zscore
from coview_stream.localization.search.learned.matcher import QueryFeatures
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import SearchRequest

Floats = npt.NDArray[np.float64]

METHODS = ("scan context", "co-view", "both", "canopy", "global", "dense", "keypoints", "verified")
"""In the tables' order."""

BASELINES = ("scan context", "co-view", "both", "canopy")
"""Whose places are registered as well."""

Named = dict[str, list[Hypothesis]]


class Methods:
    """All methods on one map, which has been built with learned features."""

    def __init__(self, base_map: BaseMap) -> None:
        """Prepare everything that a first query would wait for.

        Raises:
            MapError: the map has no learned features, or some of other weights.
        """
        usual = LocalizerConfig(reloc="auto")
        self.config = usual
        self.base_map = base_map
        known = SearchIndex.of(base_map, replace(usual, reloc="learned"))
        retrieval = SearchIndex.of(base_map, replace(usual, reloc="coview")).retrieval
        if known.learned is None or retrieval is None:
            raise ValueError("the map has no learned features")
        self._learned, self._retrieval = known.learned, retrieval
        self._learned.prepare()
        self._retrieval.prepare()
        self._canopy = Canopy(base_map.points)
        self._chain = Chain(base_map, usual)

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
        named = {**self._by_descriptors(query, clock), "canopy": self._by_canopy(query, clock)}
        found = {name: _in_turn(hypotheses, query) for name, hypotheses in named.items()}
        answer: dict[str, Any] = {"sensor": drive.sensor, "travelled": drive.travelled, "chance": self.chance}
        more, metric = self._by_features(query, truth, clock)
        apart = {name: np.hypot(*(at - robot).T) for name, at in (found | more).items()}
        answer["off"] = {name: np.round(values, 2).tolist() for name, values in apart.items()}
        moving = self._chain.source(query)
        answer["chains"] = {name: self._chain.ask(named[name], moving, truth, query) for name in BASELINES}
        return answer | metric | {"ms": {name: round(1e3 * s, 1) for name, s in clock.seconds.items()}}

    def _by_descriptors(self, query: SearchRequest, clock: _Clock) -> Named:
        with clock("descriptors"):
            centre = _on_ground(query.scan, query)
            volumes = self._retrieval.distances(describe(query.scan, centre, self.base_map.descriptor_config))
            both = robust_zscore(volumes["scan_context"]) + robust_zscore(volumes["coview"])
        named = {"scan context": volumes["scan_context"], "co-view": volumes["coview"], "both": both}
        return {name: of_volume(volume, self.base_map.stations, centre) for name, volume in named.items()}

    def _by_canopy(self, query: SearchRequest, clock: _Clock) -> list[Hypothesis]:
        with clock("canopy"):
            xy, top = seen_from(query.surroundings, query.position)
            score, heading = self._canopy.search(xy, top)
        centre = _on_ground(query.surroundings, query)
        return of_places(self._canopy.places, score.ravel(), heading.ravel(), self.base_map.stations, centre)

    def _by_features(
        self, query: SearchRequest, truth: Pose, clock: _Clock
    ) -> tuple[dict[str, Floats], dict[str, Any]]:
        centre = _on_ground(query.surroundings, query)
        with clock("network"):
            view = self._learned.encode(query.surroundings, centre)
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
            sharpened = self._learned.refine(voted, view)
        with clock("registration"):
            candidates = self._chain.register(sharpened, self._chain.source(query), query)
        verified = [Hypothesis(c.T_map_odom, 0, 0, -c.evidence.score) for c in candidates]
        places = {
            "global": self._by_global_descriptor(view),
            "dense": distinct(self.base_map.stations[:, :2], -volume.min(axis=1)),
            "keypoints": _in_turn(sharpened, query),
            "verified": _in_turn(verified, query),
        }
        moved = not np.array_equal(sharpened[0].T_map_odom, voted[0].T_map_odom)
        metric: dict[str, Any] = {"dense": errors(voted[0].T_map_odom, truth, query)[:2], "moved": moved}
        return places, {**metric, **self._chain.metric(sharpened, candidates, truth, query)}

    def _by_global_descriptor(self, view: QueryFeatures) -> Floats:
        features = self._learned.features
        likeness = features.place.astype(np.float32) @ view.place
        return distinct(features.place_at, likeness)


def _on_ground(points: Points, query: SearchRequest) -> Floats:
    """Return the robot's position (3,), but on the ground that the points (N, 3) show below it; odometry frame."""
    x, y, _ = query.position
    return np.array([x, y, ground_below(points, query.position)])


def _in_turn(hypotheses: list[Hypothesis], query: SearchRequest) -> Floats:
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
