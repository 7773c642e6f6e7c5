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
from bench.accuracy.paper import Modes, robust_zscore
from bench.forest.worlds import Drive, Place, code, drawn, in_odometry, on_disk, place, recorded, say, weights
from bench.harness.files import Clock, remembered
from bench.harness.rows import NOTHING, Row, failed, informs, number, table
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


FIRST_SEED = 20_000  # seeds from here on are neither for training nor for tuning
RADIUS = 30.0
"""Metres: virtual scans reach as far as the queries do, so that the descriptors compare like with like."""

_QUICK = 4  # queries of a world, and worlds

Answer = dict[str, Any]
RIGHT = 10.0  # metres from the truth within which a place is the right one
NEAR_METRES, NEAR_DEGREES = 2.0, 5.0
"""A pose before registration is a success within both; after it, one that is not is false ..."""
EXACT_METRES, EXACT_DEGREES = 0.3, 1.0
"""... and within these it is a success."""

WORDS = ("sparse", "medium", "dense", "flat", "hilly", "steep", "leaf-on", "leaf-off")
STEPS = {
    "descriptors": "Scan Context and co-view: describing, all stations and shifts",
    "network": "learned: bird view and ground network",
    "correlation": "learned: coarse correlation, the best places at 36 headings",
    "registration": "registration and verification of five places",
}
LEARNED = ("network", "correlation", "registration")
"""Steps of a search by learned features alone."""


def recall(answers: Sequence[Answer], method: str, best: int) -> float:
    """AR@best: the share of queries that a method puts right, with one of the ``best`` places that it named."""
    return float(np.mean([min(answer["off"][method][:best], default=RIGHT) < RIGHT for answer in answers]))


def recall_cell(answers: Sequence[Answer], method: str) -> str:
    """AR@1 and AR@5 in per cent."""
    return " / ".join(_percent(recall(answers, method, best)) for best in (1, 5))


def success(answers: Sequence[Answer], stage: str, metres: float, degrees: float) -> float:
    """Share of queries whose pose at a stage is within both; no pose is no success."""
    return float(np.mean([_within(answer[stage], metres, degrees) for answer in answers]))


def false(answer: Answer) -> bool:
    """Tell whether a wrong pose had the evidence for it: more probable than not of the places named."""
    return bool(answer["passes"]) and not _within(answer["after"], NEAR_METRES, NEAR_DEGREES)


def _within(errors: Sequence[float] | None, metres: float, degrees: float) -> bool:
    return errors is not None and errors[0] <= metres and errors[1] <= degrees


def groups(answers: Sequence[Answer]) -> Iterator[tuple[str, list[Answer]]]:
    """All answers, then those of each sensor, of forests by what they are like, of built places, of those on disk."""
    kinds: dict[str, Callable[[Answer], bool]] = {"all": lambda answer: True}
    for sensor in sorted({answer["sensor"] for answer in answers}):
        kinds[sensor] = partial(lambda answer, sensor: answer["sensor"] == sensor, sensor=sensor)
    kinds["forest"] = _is_forest
    kinds |= {f"forest, {word}": partial(_is_forest, word=word) for word in WORDS}
    kinds["built"] = lambda answer: not _is_forest(answer) and answer["kind"] != "on disk"
    kinds["on disk"] = lambda answer: answer["kind"] == "on disk"
    for name, belongs in kinds.items():
        if some := [answer for answer in answers if belongs(answer)]:
            yield name, some


def _is_forest(answer: Answer, word: str = "forest") -> bool:
    words = answer["kind"].split()
    return words[:1] == ["forest"] and word in words


def recall_table(answers: Sequence[Answer]) -> str:
    """AR@1 / AR@5 in per cent, by method; chance is that of one place drawn from all the map knows."""
    rows = []
    for name, some in groups(answers):
        shown = [recall_cell(some, method) for method in METHODS]
        rows.append([name, str(len(some)), f"{100 * np.mean([answer['chance'] for answer in some]):.1f}", *shown])
    return table(("AR@1 / AR@5, %", "n", "chance", *METHODS), rows)


_POSES = (
    "m", "deg", "2 m, 5 deg, %", "registered: m", "deg", "0.3 m, 1 deg, %", "2 m, 5 deg, %", "passes, false",
)  # fmt: skip
_GIVEN = ("search gives", "false")


def _poses(answers: Sequence[Answer]) -> list[str]:
    """Poses of the best hypothesis before registration, and of the best verified one after it, as ``_POSES`` heads."""
    return [
        *medians(answers, "before", (2, 1)), _percent(success(answers, "before", NEAR_METRES, NEAR_DEGREES)),
        *medians(answers, "after", (3, 2)), _percent(success(answers, "after", EXACT_METRES, EXACT_DEGREES)),
        _percent(success(answers, "after", NEAR_METRES, NEAR_DEGREES)),
        str(sum(false(answer) for answer in answers)),
    ]  # fmt: skip


def _given(answers: Sequence[Answer]) -> list[str]:
    """How many poses the product's search gave by this one keyframe, and how many of them were false."""
    given = [answer["found"][0] for answer in answers if answer["found"] is not None]
    return [str(len(given)), str(sum(metres > NEAR_METRES for metres in given))]


def medians(answers: Sequence[Answer], stage: str, digits: tuple[int, int]) -> list[str]:
    """Median errors, metres and degrees, of the poses that a stage gave."""
    poses = [answer[stage] for answer in answers if answer[stage] is not None]
    found = np.median(poses, axis=0).tolist() if poses else (None, None)
    return [number(value, places) for value, places in zip(found, digits, strict=True)]


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


def metric_table(answers: Sequence[Answer]) -> str:
    """Poses by learned features: of correlation, and after registration."""
    rows = [
        [name, str(len(some)), *_poses(some), *_given(some)]
        for name, some in groups(answers)
    ]  # fmt: skip
    head = ("", "n", f"correlation: {_POSES[0]}", *_POSES[1:], *_GIVEN)
    return table(head, rows)


def times_table(answers: Sequence[Answer]) -> str:
    """Medians over all queries, milliseconds; the first query of a map is left out."""
    warm = [answer for answer in answers if not answer.get("first")] or list(answers)
    rows = []
    for step, words in STEPS.items():
        values = [answer["ms"][step] for answer in warm if step in answer["ms"]]
        rows.append([words, f"{np.median(values):.0f}" if values else NOTHING])
    totals = [sum(answer["ms"][step] for step in LEARNED) for answer in warm]
    rows.append(["learned, from the query's points to verified poses", f"{np.median(totals):.0f}"])
    return table(("median of a query", "ms"), rows)


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--seeds", type=int, default=FIRST_SEED, metavar="FIRST", help=f"({FIRST_SEED})")
    parser.add_argument("--worlds", type=int, default=8, metavar="N", help="worlds of these seeds (8)")
    parser.add_argument("--queries", type=int, default=16, metavar="N", help="of each world (16)")
    parser.add_argument("--world", type=Path, nargs="+", default=[], metavar="DIR", help="worlds on disk as well")


def answers(name: str, opened: Callable[[], Place], about: dict[str, Any]) -> list[dict[str, Any]]:
    """Answers to all queries of a place (a function that opens it), now or when the same was asked before.

    ``about`` says what else they depend on: what lies in a folder, say.
    """
    spec = {"name": name, "weights": weights(), "code": code(), "radius": RADIUS, **about}

    def work() -> dict[str, Any]:
        begin, there = time.perf_counter(), opened()
        methods = Methods(BaseMap.build(there.base, radius=RADIUS, learned=True))
        told = {"world": there.name, "kind": there.kind}
        found = [{**told, "first": not k, **methods.ask(drive)} for k, drive in enumerate(there.drives)]
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
        share = 100 * success(found, "after", EXACT_METRES, EXACT_DEGREES)
        yield informs(f"{name}: within 0.3 m and 1 deg", share, "%", {"answers": found})


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Recall, accuracy and times, by kind of place."""
    answers = [answer for row in rows for answer in row.details.get("answers", ())]
    return {"recall": recall_table(answers), "metric": metric_table(answers), "times": times_table(answers)}
