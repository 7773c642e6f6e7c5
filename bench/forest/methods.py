"""Every way of finding a place, asked the same query on the same map: where the robot is, and how long it took."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import coview_kernels as kernels
from bench.accuracy.paper import Modes, robust_zscore
from bench.forest.worlds import Drive, in_odometry
from bench.harness.files import Clock
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats, Floats32, Reals
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    inverse,
    pose_from,
    rot_z,
    rotation_angle,
    to_local,
    transform,
    yaw_of,
)
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan, voxelized
from coview_stream.localization.search.consensus import Consensus, Hypothesis, yaw_of_shift
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.refinement import register_place
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


def _pose(at: Reals, yaw: float, centre: Floats) -> Pose:
    return pose_from(rot_z(yaw), at) @ pose_from(np.eye(3), -centre)


class Chain:
    """Evidence, registration, verification and decision of one keyframe, as in a search."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig) -> None:
        """Register with the search's own method."""
        registration = replace(config.registration, method="trimmed-icp")
        self.config = replace(config, registration=registration)
        self._base_map, self._local_maps = base_map, LocalMaps(base_map, registration.source_range)

    def scan(self, query: SearchRequest) -> ObservedScan:
        """Return what of a query is registered."""
        points = prepare_scan(query.submap, query.position, self.config.registration)
        return ObservedScan.of(points, query.cloud, query.T_odom_body)

    def register(self, named: list[Hypothesis], scan: ObservedScan) -> tuple[Scored, list[Hypothesis]]:
        """Return the evidence of the places named, and the most probable of them registered, in that order."""
        scored = PlaceScorer(self._base_map).score(named, range(len(named)), 0, scan)
        found = [
            register_place(place, scan, self._base_map, self.config, self._local_maps)
            for place in scored.places[:_REGISTERED]
        ]
        return scored, [each for each in found if each is not None]

    def metric(
        self, named: list[Hypothesis], judged: tuple[Scored, list[Hypothesis]], truth: Pose, query: SearchRequest
    ) -> dict[str, Any]:
        """Errors of the best hypothesis and the best candidate, and what would have been believed; plain values."""
        scored, candidates = judged
        return {
            "before": errors(named[0].T_map_odom, truth, query)[:2] if named else None,
            "after": errors(candidates[0].T_map_odom, truth, query)[2:] if candidates else None,
            "passes": bool(candidates) and scored.error < 0.5,
        }


METHODS = ("scan context", "co-view", "both", "global", "dense", "verified", "search")
"""In the tables' order."""


class Methods:
    """All methods on one map, which has been built with learned features."""

    def __init__(self, base_map: BaseMap) -> None:
        """Prepare everything that a first query would wait for; ``MapError`` without features of these weights."""
        self.config, self.base_map = LocalizerConfig(reloc="auto"), base_map
        learned = SearchIndex.of(base_map, replace(self.config, reloc="learned")).learned
        assert learned is not None
        self._learned = learned
        self._learned.prepare()
        self._chain = Chain(base_map, self.config)
        maps = LocalMaps(base_map, self.config.registration.source_range)
        self._search = GlobalSearch(base_map, replace(self.config, reloc="learned"), maps)
        area = len(base_map.stations) * base_map.config.block**2
        # share of the places that the map knows from which 10 m reach the right one, if one of them is drawn
        self._chance = float(min(1.0, np.pi * APART**2 / area))

    def ask(self, drive: Drive) -> dict[str, Any]:
        """Ask all methods; distances (metres), errors, and milliseconds, all plain values."""
        query, truth = query_of(drive, self.config)
        truth = to_local(truth, self.base_map.origin)
        robot = (truth @ query.T_odom_body)[:2, 3]
        clock = Clock()
        named = self._by_hand(query, clock)
        places = {name: _in_turn(hypotheses, query) for name, hypotheses in named.items()}
        metric = self._by_features(query, truth, clock, places)
        places["search"], found = self._searched(query, truth)
        apart = {name: np.hypot(*(at - robot).T) for name, at in places.items()}
        return {
            "sensor": drive.sensor,
            "chance": self._chance,
            "off": {name: np.round(values, 2).tolist() for name, values in apart.items()},
            **metric,
            "found": found,
            "ms": _milliseconds(clock),
        }

    def _by_hand(self, query: SearchRequest, clock: Clock) -> dict[str, list[Hypothesis]]:
        """Name places by descriptors."""
        with clock("descriptors"):
            centre = on_ground(query.scan, query)
            volumes = Modes().distances(self.base_map, describe(query.scan, centre, self.base_map.descriptor_config))
            both = robust_zscore(volumes["scan_context"]) + robust_zscore(volumes["coview"])
        by_volume = {"scan context": volumes["scan_context"], "co-view": volumes["coview"], "both": both}
        return {name: of_volume(volume, self.base_map.stations, centre) for name, volume in by_volume.items()}

    def _by_features(
        self, query: SearchRequest, truth: Pose, clock: Clock, places: dict[str, Floats]
    ) -> dict[str, Any]:
        """Add the places by learned features; return the errors of their poses."""
        centre, stations = on_ground(query.surroundings, query), self.base_map.stations
        with clock("network"):
            view = self._learned.encode(query.surroundings, centre)
        with clock("correlation"):
            vote = self._learned.vote(view)
            peaks = replace(self.config.consensus, peaks=BEST)
            consensus = Consensus(self.base_map.station_grid, peaks)
            consensus.vote(vote)
            voted = [replace(each, learned=True) for each in consensus.hypotheses()]
        with clock("registration"):
            judged = self._chain.register(voted, self._chain.scan(query))
        features = self._learned.features
        places["global"] = distinct(features.place_at, features.place.astype(np.float32) @ view.place)
        named, shifts = vote.candidates()
        places["dense"] = distinct(stations[named, :2], -vote.at(named, shifts))
        places["verified"] = _in_turn(judged[1], query)
        return self._chain.metric(voted, judged, truth, query)

    def _searched(self, query: SearchRequest, truth: Pose) -> tuple[Floats, tuple[float, float] | None]:
        """Return the place (1, 2) that the product's search by learned features has for the most probable.

        With it the errors of its pose there, metres and degrees, if it is given, by this one keyframe.
        """
        self._search.reset()
        result = self._search.update(query)
        if result.leader is None:
            return np.empty((0, 2)), None
        found = None if result.accepted is None else errors(result.leader, truth, query)[2:]
        return (result.leader @ query.T_odom_body)[None, :2, 3], found


def _milliseconds(clock: Clock) -> dict[str, float]:
    return {name: round(1e3 * seconds, 1) for name, seconds in clock.seconds.items()}


def on_ground(points: Points, query: SearchRequest) -> Floats:
    """Return the robot's position (3,), but on the ground that the points (N, 3) show below it; odometry frame."""
    x, y, _ = query.position
    return np.array([x, y, ground_below(points, query.position)])


def _in_turn(hypotheses: list[Hypothesis], query: SearchRequest) -> Floats:
    """Places (K, 2) of hypotheses in their order, those left out that are near a better one."""
    at = [transform(each.T_map_odom, query.position[None])[0, :2] for each in hypotheses]
    return distinct(np.array(at).reshape(-1, 2), -np.arange(len(at), dtype=np.float64))
