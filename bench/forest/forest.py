"""Places named from one query in a forest: descriptors, learned features, and the product's search.

Worlds of the training simulator whose seeds were never trained on, and any worlds on disk (``--world``, in the layout
of ``coview-stream simulate``); each map is built with learned features. Answers stay in ``--work``, so an interrupted
benchmark resumes. AR@N is the share of queries with the right place (within 10 m) among the first N.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import coview_kernels as kernels
from bench.accuracy.choices import robust_zscore
from bench.forest.worlds import Drive, Place, code, drawn, in_odometry, on_disk, place, recorded, say, weights
from bench.harness.files import remembered
from bench.harness.rows import Row, failed, informs, number, table
from coview_stream import BaseMap
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
)
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import LocalMaps, prepare_scan, voxelized
from coview_stream.localization.search.consensus import Consensus, Hypothesis, yaw_of_shift
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.refinement import register_place
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.retrieval import exact_distances
from coview_stream.localization.search.scoring import PlaceScorer
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


def errors(T: Pose, truth: Pose, query: SearchRequest) -> tuple[float, float]:
    """Metres and degrees by which a ``T_map_odom`` puts the robot off."""
    pose, true = T @ query.T_odom_body, truth @ query.T_odom_body
    metres = float(np.linalg.norm(pose[:3, 3] - true[:3, 3]))
    return metres, float(np.degrees(rotation_angle(pose @ inverse(true))))


def best_places(xy: Reals, score: Reals) -> list[int]:
    """Return the indices of the best places (N, 2) by score (N,), 10 m or more apart, the highest score first."""
    at, left = np.asarray(xy, dtype=np.float64), np.array(score, dtype=np.float64)
    found: list[int] = []
    while len(found) < BEST and np.isfinite(left).any():
        k = int(np.argmax(left))
        found.append(k)
        left[np.hypot(*(at - at[k]).T) < APART] = -np.inf
    return found


def distinct(xy: Reals, score: Reals) -> Floats:
    """Return the best places (K, 2) themselves, see :func:`best_places`."""
    return np.asarray(xy, dtype=np.float64)[best_places(xy, score)].reshape(-1, 2)


def of_volume(volume: Floats32, stations: Floats32, centre: Floats) -> list[Hypothesis]:
    """Best stations (M, 3) of distances (M, S), each at its best shift; ``centre`` (3,) in the odometry frame."""
    found = []
    for k in best_places(stations[:, :2], -volume.min(axis=1)):
        shift = int(volume[k].argmin())
        yaw = float(yaw_of_shift(shift, volume.shape[1]))
        T = pose_from(rot_z(yaw), stations[k]) @ pose_from(np.eye(3), -centre)
        found.append(Hypothesis(T, k, shift, float(volume[k, shift])))
    return found


class Chain:
    """Evidence, registration, verification and decision of one keyframe, as in a search."""

    def __init__(self, base_map: BaseMap, config: LocalizerConfig) -> None:
        """Register with the search's own configuration."""
        self.config = config
        self._base_map, self._local_maps = base_map, LocalMaps(base_map, config.registration.source_range)

    def scan(self, query: SearchRequest) -> ObservedScan:
        """Return the part of a query that is registered."""
        points = prepare_scan(query.submap, query.position, self.config.registration)
        return ObservedScan.of(points, query.cloud, query.T_odom_body)

    def register(self, named: list[Hypothesis], scan: ObservedScan) -> tuple[Scored, list[Hypothesis]]:
        """Return the evidence of the places named, and the most probable of them registered, in that order."""
        scored = PlaceScorer(self._base_map).score(named, range(len(named)), 0, scan)
        found = [
            register_place(place, scan, self._base_map, self.config, self._local_maps)
            for place in scored.places[:_REGISTERED]
        ]
        return scored, [place for place in found if place is not None]


METHODS = ("scan context", "co-view", "both", "search")  # in the tables' order


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

    def ask(self, drive: Drive) -> dict[str, Any]:
        """Ask all methods; distances of the named places in metres, and errors, all plain values."""
        query, truth = query_of(drive, self.config)
        truth = to_local(truth, self.base_map.origin)
        places = {name: _in_turn(hypotheses, query) for name, hypotheses in self._by_hand(query).items()}
        metric = self._by_features(query, truth)
        # the product's search by learned features: its most probable place, and the errors of a pose that it gives
        self._search.reset()
        result = self._search.update(query)
        leader = result.leader
        places["search"] = np.empty((0, 2)) if leader is None else (leader @ query.T_odom_body)[None, :2, 3]
        found = None if leader is None or result.accepted is None else errors(leader, truth, query)
        robot = (truth @ query.T_odom_body)[:2, 3]
        apart = {name: np.round(np.hypot(*(at - robot).T), 2).tolist() for name, at in places.items()}
        return {"off": apart, **metric, "found": found}

    def _by_hand(self, query: SearchRequest) -> dict[str, list[Hypothesis]]:
        """Name places by descriptors."""
        centre = on_ground(query.scan, query)
        described = describe(query.scan, centre, self.base_map.descriptor_config)
        volumes = {name: exact_distances(self.base_map.descriptors(name), one) for name, one in described.items()}
        both = robust_zscore(volumes["scan_context"]) + robust_zscore(volumes["coview"])
        by_volume = {"scan context": volumes["scan_context"], "co-view": volumes["coview"], "both": both}
        return {name: of_volume(volume, self.base_map.stations, centre) for name, volume in by_volume.items()}

    def _by_features(self, query: SearchRequest, truth: Pose) -> dict[str, Any]:
        """Return the error of the best place by learned features, and whether it would be believed."""
        view = self._learned.encode(query.surroundings, on_ground(query.surroundings, query))
        consensus = Consensus(self.base_map.station_grid, replace(self.config.consensus, peaks=BEST))
        consensus.vote(self._learned.vote(view))
        voted = [replace(place, learned=True) for place in consensus.hypotheses()]
        scored, candidates = self._chain.register(voted, self._chain.scan(query))
        after = errors(candidates[0].T_map_odom, truth, query) if candidates else None
        return {"after": after, "passes": bool(candidates) and scored.error < 0.5}


def on_ground(points: Points, query: SearchRequest) -> Floats:
    """Return the robot's position (3,), but on the ground that the points (N, 3) show below it; odometry frame."""
    x, y, _ = query.position
    return np.array([x, y, ground_below(points, query.position)])


def _in_turn(hypotheses: list[Hypothesis], query: SearchRequest) -> Floats:
    """Places (K, 2) of hypotheses in their order, those left out that are near a better one."""
    at = [transform(each.T_map_odom, query.position[None])[0, :2] for each in hypotheses]
    return distinct(np.array(at).reshape(-1, 2), -np.arange(len(at), dtype=np.float64))


FIRST_SEED = 20_000  # seeds from here on are neither for training nor for tuning
RADIUS = 30.0  # metres: virtual scans reach as far as the queries do
_QUICK = 2  # queries of a world, and worlds

Answer = dict[str, Any]
RIGHT = 10.0  # metres from the truth within which a place is the right one
NEAR, EXACT = (2.0, 5.0), (0.3, 1.0)  # metres and degrees: a pose beyond the first is false, within the second exact

_FOREST, _ON_DISK = "forest", ["on", "disk"]  # words of the kind of a place
WORDS = ("sparse", "medium", "dense")


def recall(answers: Sequence[Answer], method: str, best: int) -> float:
    """AR@best: the share of queries that a method puts right, with one of the ``best`` places that it named."""
    return float(np.mean([min(answer["off"][method][:best], default=RIGHT) < RIGHT for answer in answers]))


def success(answers: Sequence[Answer], metres: float, degrees: float) -> float:
    """Share of queries whose registered pose is within both; no pose is no success."""
    return float(np.mean([_within(answer["after"], metres, degrees) for answer in answers]))


def false(answer: Answer) -> bool:
    """Tell whether a wrong pose had the evidence for it: more probable than not of the places named."""
    return bool(answer["passes"]) and not _within(answer["after"], *NEAR)


def _within(errors: Sequence[float] | None, metres: float, degrees: float) -> bool:
    return errors is not None and errors[0] <= metres and errors[1] <= degrees


def groups(answers: Sequence[Answer]) -> dict[str, list[Answer]]:
    """All answers, then those of forests, also by density, of built places, and of worlds on disk."""
    out: dict[str, list[Answer]] = {}
    for answer in answers:
        words = answer["kind"].split()
        forest = [_FOREST, *(f"forest, {word}" for word in WORDS if word in words)]
        kinds = forest if _FOREST in words else ["on disk"] if words == _ON_DISK else ["built"]
        for name in ("all", *kinds):
            out.setdefault(name, []).append(answer)
    order = ("all", _FOREST, *(f"forest, {word}" for word in WORDS), "built", "on disk")
    return {name: out[name] for name in order if name in out}


def recall_table(answers: Sequence[Answer]) -> str:
    """AR@1 / AR@5 in per cent, by method."""
    lines = []
    for name, some in groups(answers).items():
        pairs = [[f"{100 * recall(some, method, best):.0f}" for best in (1, 5)] for method in METHODS]
        lines.append([name, str(len(some)), *map(" / ".join, pairs)])
    return table(("AR@1 / AR@5, %", "n", *METHODS), lines)


def metric_table(answers: Sequence[Answer]) -> str:
    """Poses by learned features after registration, and those that the search gives by this one keyframe."""
    lines = []
    for name, some in groups(answers).items():
        poses = [answer["after"] for answer in some if answer["after"] is not None]
        metres, degrees = np.median(poses, axis=0).tolist() if poses else (None, None)
        given = [answer["found"][0] for answer in some if answer["found"] is not None]
        lines.append([
            name, str(len(some)), number(metres, 3), number(degrees, 2),
            *(f"{100 * success(some, *limits):.0f}" for limits in (EXACT, NEAR)), str(sum(map(false, some))),
            str(len(given)), str(sum(error > NEAR[0] for error in given)),
        ])  # fmt: skip
    near, exact = (f"{metres:g} m, {degrees:g} deg, %" for metres, degrees in (NEAR, EXACT))
    return table(("", "n", "registered: m", "deg", exact, near, "passes, false", "search gives", "false"), lines)


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--seeds", type=int, default=FIRST_SEED, metavar="FIRST", help=f"({FIRST_SEED})")
    parser.add_argument("--worlds", type=int, default=8, metavar="N", help="worlds of these seeds (8)")
    parser.add_argument("--queries", type=int, default=16, metavar="N", help="of each world (16)")
    parser.add_argument("--world", type=Path, nargs="+", default=[], metavar="DIR", help="worlds on disk as well")


def answers(name: str, opened: Callable[[], Place], about: dict[str, Any]) -> list[Answer]:
    """Return the answers to all queries of the place that ``opened`` returns; ``about`` is what else they depend on."""
    spec = {"name": name, "weights": weights(), "code": code(), "radius": RADIUS, **about}

    def work() -> dict[str, Any]:
        begin, there = time.perf_counter(), opened()
        methods = Methods(BaseMap.build(there.base, radius=RADIUS, learned=True))
        found = [{"kind": there.kind, **methods.ask(drive)} for drive in there.drives]
        say(f"{name}: {there.kind}, {len(found)} queries, {time.perf_counter() - begin:.0f} s")
        return {"answers": found}

    return list(remembered(place() / "answers" / f"{name}.json", spec, work)["answers"])


def rows(asked: Namespace) -> Iterator[Row]:
    """Ask all methods in all worlds; a row per world, with every answer."""
    if asked.quick:
        asked.worlds, asked.queries = min(asked.worlds, _QUICK), min(asked.queries, _QUICK)
    jobs: list[tuple[str, Callable[[], Place], dict[str, Any]]] = [
        (f"drawn-{seed}-{asked.queries}", partial(drawn, place(), seed, asked.queries), {})
        for seed in range(asked.seeds, asked.seeds + asked.worlds)
    ]
    for path in asked.world:
        # the name of a folder alone is not unique
        key = f"disk-{path.resolve().parent.name}-{path.name}-{asked.queries}"
        jobs.append((key, partial(recorded, path, asked.queries), on_disk(path)))
    for job in jobs:
        name = f"forest/{job[0]}"
        try:
            found = answers(*job)
        except Exception as error:  # the other worlds are still worth having; the exit code tells
            yield failed(name, f"{type(error).__name__}: {error}")
            continue
        share = 100 * success(found, *EXACT)
        yield informs(f"{name}: within 0.3 m and 1 deg", share, "%", {"answers": found})


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Recall and accuracy, by kind of place."""
    answers = [answer for row in rows for answer in row.details.get("answers", ())]
    return {"recall": recall_table(answers), "metric": metric_table(answers)}
