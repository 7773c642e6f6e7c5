"""Votes of keyframes on a site: all stations compared, squares, squares in a circle of a prior, and in a wrong one."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import coview_kernels as kernels
from bench.accuracy.stages import Seen, keyframes_of, right
from bench.harness.rows import Row, against, bounded, informs, judged, reached
from bench.speed.search import last_core
from coview_stream import BaseMap, Localizer
from coview_stream.clouds import read_tum
from coview_stream.config import ConsensusConfig, RetrievalConfig
from coview_stream.descriptors.coview import describe
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.circle import Circle
from coview_stream.localization.search.global_search import coview_peaks
from coview_stream.localization.search.place_guess import PlaceGuess
from coview_stream.localization.search.retrieval import Retrieval
from coview_stream.localization.search.search_stations import SearchStations
from coview_stream.localization.search.station_consensus import StationConsensus
from coview_stream.recordings.open_run import open_run

RADIUS, ELSEWHERE = 1000.0, (50.0, 240.0)
"""Metres of the prior's circle, and of those in another town: the smallest that there is, and a town's."""

VOTE_MS, LEAST_KEPT = 30.0, 99.0
"""The targets: milliseconds of a vote within the circle on one core, per cent of right places that squares keep."""

_FRAMES = 60
_Keyframe = tuple[Seen, Floats, dict[Any, Floats32]]


class _AllCompared(Retrieval):
    """Retrieval that compares every station, however many they are."""

    def compared(self, area: Circle | None = None) -> SearchStations:
        return SearchStations(self.stations.station_index, self.stations.station_grid)


def voted(site: Path, worlds: Sequence[Path]) -> dict[str, Any]:
    """Milliseconds of votes on one core, and the ranks of the right places, by what is compared."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {last_core()})
    base_map = BaseMap.load(site)
    config = ConsensusConfig()
    config = replace(config, peaks=coview_peaks(config.peaks, len(base_map)))
    middle = 0.5 * (base_map.stations.min(axis=0) + base_map.stations.max(axis=0))
    circle = Circle(float(middle[0]), float(middle[1]), RADIUS)
    drives = [_keyframes(world, base_map) for world in worlds]
    kernels.warm_up()
    out: dict[str, Any] = {"in_circle": int(circle.holds(base_map.stations).sum()), "stations": len(base_map)}
    for name, kind, area in (("all", _AllCompared, None), ("squares", Retrieval, None), ("circle", Retrieval, circle)):
        consensus = StationConsensus(kind(base_map, RetrievalConfig()), config)
        out[name] = _votes(consensus, [drive for drive in drives if area is None or _lies_in(area, drive)], area)
    return out


def _keyframes(world: Path, base_map: BaseMap) -> list[_Keyframe]:
    found = []
    for seen in keyframes_of(world, base_map.origin, base_map.descriptor_config):
        centre = np.array([*seen.position[:2], seen.ground])
        found.append((seen, centre, describe(seen.scan, centre, base_map.descriptor_config)))
    return found


def _lies_in(area: Circle, drive: Sequence[_Keyframe]) -> bool:
    places = np.array([(seen.T_map_odom @ np.append(seen.position, 1.0))[:2] for seen, _, _ in drive])
    return bool(area.holds(places).all())


def _votes(consensus: StationConsensus, drives: Sequence[Sequence[_Keyframe]], area: Circle | None) -> dict[str, Any]:
    times, ranks = list[float](), list[int | None]()
    for drive in drives:
        consensus.clear()
        for seen, centre, described in drive:
            begin = time.perf_counter()
            consensus.vote(centre, described, area)
            found = consensus.hypotheses()
            times.append(1e3 * (time.perf_counter() - begin))
            ranks.append(next((k for k, each in enumerate(found) if right(each.T_map_odom, seen)), None))
    return {"ms": times, "ranks": ranks}


def elsewhere(site: Path, worlds: Sequence[Path], radius: float) -> dict[str, float]:
    """Search for each robot in a circle around where another one starts; tell how many came to a pose."""
    base_map = BaseMap.load(site)
    localizer = Localizer(base_map)
    starts = [read_tum(world / "truth.tum")[1][0][:2, 3] for world in worlds]
    posed = frames = 0
    for number, world in enumerate(worlds):
        localizer.reset()
        x, y = starts[(number + len(worlds) // 2 + 1) % len(worlds)].tolist()
        localizer.guess_place(PlaceGuess(x, y, within=radius))
        poses = 0
        for frame, _ in zip(open_run(world / "run"), range(_FRAMES), strict=False):
            poses += localizer.step(frame.points, frame.T_odom_body, frame.stamp).T_map_body is not None
            frames += 1
        posed += poses > 0
    return {"posed": posed, "robots": len(worlds), "frames": frames, "radius": radius}


def rows(title: str, found: dict[str, Any]) -> Iterator[Row]:
    """Yield times and places of :func:`voted`."""
    every, squares, circle = (found[name] for name in ("all", "squares", "circle"))
    ours, all_ms, near = (float(np.median(each["ms"])) for each in (squares, every, circle))
    yield against(f"{title}: a vote and its places, beside all stations compared", ours, all_ms, "ms", None)
    name = f"{title}: a vote and its places in a circle of {RADIUS:g} m, {found['in_circle']} stations"
    yield bounded(name, near, "ms", VOTE_MS)
    good = [k for k, rank in enumerate(every["ranks"]) if rank is not None]
    kept = 100.0 * float(np.mean([squares["ranks"][k] is not None for k in good]))
    yield reached(f"{title}: right places kept, of {len(good)} that all stations name", kept, "%", LEAST_KEPT)
    for most in (1, 10, 50):
        shares = [
            100.0 * float(np.mean([r is not None and r < most for r in each["ranks"]])) for each in (squares, every)
        ]
        yield Row(f"{title}: right place among the first {most}, beside all stations compared", *shares, "%")
    named = [rank is not None for rank in circle["ranks"]]
    yield informs(f"{title}: right place named in the circle, of {len(named)}", 100.0 * float(np.mean(named)), "%")


def wrong_circle_row(title: str, found: dict[str, float]) -> Row:
    """Return the row of :func:`elsewhere`."""
    said = f"{found['posed']} of {found['robots']}"
    name = f"{title}: robots posed in a circle of {found['radius']:g} m that they are not in, {found['frames']} frames"
    return judged(name, said, "none", found["posed"] == 0)
