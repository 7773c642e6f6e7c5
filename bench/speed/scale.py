"""How the vote of a keyframe grows with the map: a thousand to a million stations, on one core.

A keyframe's descriptors are compared with all stations, and the places that ten keyframes agree on are named: the
search by descriptors as the product runs it, without registration. The map is a simulated town (or campus), and beside
it on the same grid synthetic stations: halves of two of its own, each turned, so that they look like stations and
repeat what stands near the drive. The keyframes are those of a drive through the scene. Each size has processes of its
own: one makes the map, one votes, one searches exhaustively, which adds up the z-scores of all stations at all turns
and keyframes and names as many places. Kept is what both name of what the exhaustive search names rightly (within 3 m
and 9 degrees).
"""

from __future__ import annotations

import os
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from bench.accuracy.stages import Seen, keyframes_of, right
from bench.harness.files import folder, isolated, peak_megabytes
from bench.harness.rows import Row, against, bounded, informs, reached
from bench.harness.worlds import WORLDS, opened, prepare, world_name
from bench.speed.search import last_core
from coview_stream import BaseMap
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import ConsensusConfig, RetrievalConfig
from coview_stream.descriptors.coview import describe
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.circle import Circle
from coview_stream.geometry.selection import argsmallest
from coview_stream.geometry.transforms import Pose, pose_from, rot_z
from coview_stream.localization.search.consensus import yaw_of_shift
from coview_stream.localization.search.global_search import coview_peaks
from coview_stream.localization.search.retrieval import Retrieval
from coview_stream.localization.search.station_consensus import StationConsensus
from coview_stream.localization.search.votes import robust_zscore

SIZES = (1_000, 10_000, 100_000, 1_000_000)
CHECKED = {10_000: 1, 100_000: 3, 1_000_000: 9}
"""Sizes that are searched exhaustively too, there every so many keyframes."""

MOST_SLOPE, LEAST_KEPT, MOST_MS, MOST_QUERY_MS = 1.0, 99.9, 30.0, 1000.0
"""The targets: growth from a hundred thousand to a million stations, per cent of right places, milliseconds of a vote
in a prior's circle and without one."""

RADIUS = 1000.0
"""Metres of the prior's circle; around the drive it holds 785,000 of the million stations."""

APART = 10
"""Factor by which stations are moved apart: every 20 m, as of 20 x 20 km."""

BOTH = (10_000, 100_000)
"""Sizes at which the campus is searched too."""

_LAST = {1_000_000: 30}  # keyframes of the drive that are searched exhaustively, where not all are
_BLOCK = 8192
_SHORTLIST = 20_000  # of the exhaustive search, among which distinct places are sought
_SEED = 1


def make(size: int, scene: str, out: Path) -> None:
    """Write stations, descriptors and index of a map of ``size`` stations."""
    site, _, _ = opened(WORLDS[scene])
    seen = drive(scene)
    middle = np.mean([_place(each) for each in seen], axis=0)
    own = np.argsort(np.linalg.norm(site.stations - middle, axis=1), kind="stable")[:size]
    known = [site.descriptors(name)[own] for name in site.descriptor_config.channels]
    _save_queries(site, seen, out)
    np.save(out / "stations.npy", widened(site.stations[own], size, site.config.block))
    shape = (size, *known[0].shape[1:])
    files = [np.lib.format.open_memmap(out / f"{k}.npy", "w+", np.float16, shape) for k in range(len(known))]
    for file, values in zip(files, known, strict=True):
        file[: len(own)] = values
    rng = np.random.default_rng(_SEED)
    for start in range(len(own), size, _BLOCK):
        stop = min(start + _BLOCK, size)
        one, other = rng.integers(len(own), size=(2, stop - start))
        turn, half = int(rng.integers(shape[2])), shape[2] // 2
        for file, values in zip(files, known, strict=True):  # the channels of a station belong together
            made = np.roll(values[one], turn, axis=2)
            made[:, :, :half] = values[other][:, :, :half]
            file[start:stop] = made
    descriptors: dict[Any, npt.NDArray[Any]] = dict(zip(site.descriptor_config.channels, files, strict=True))
    begin = time.perf_counter()
    index = StationIndex.of(descriptors)
    seconds = time.perf_counter() - begin
    (out / "index").mkdir()
    for name, values in index.arrays().items():
        np.save(out / "index" / f"{name}.npy", values)
    (out / "seconds").write_text(str(seconds))


def widened(stations: Floats32, count: int, block: float) -> Floats32:
    """Return ``count`` stations (count, 3): these, and the others on the same grid around them, the nearest first."""
    missing = count - len(stations)
    cells = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
    low, high = cells.min(axis=0) - 1, cells.max(axis=0) + 1
    reach = int(np.ceil(np.sqrt(count / np.pi) + np.ptp(cells, axis=0).max()))
    middle = (low + high) // 2
    others = np.stack(np.meshgrid(*(np.arange(m - reach, m + reach) for m in middle)), axis=-1).reshape(-1, 2)
    others = others[((others < low) | (others > high)).any(axis=1)]
    nearest = np.argsort(np.linalg.norm(others - middle, axis=1), kind="stable")[:missing]
    xy = (others[np.sort(nearest)] + 0.5) * block  # its stations stand in the middle of blocks
    height = np.full(missing, np.median(stations[:, 2]))
    return np.concatenate([stations, np.column_stack([xy, height])]).astype(np.float32)


def drive(scene: str) -> list[Seen]:
    """Return the keyframes of a drive."""
    site, _, _ = opened(WORLDS[scene])
    return list(keyframes_of(folder() / world_name(WORLDS[scene]), site.origin, site.descriptor_config))


class Query(NamedTuple):
    """Keyframe with the zero of its descriptors (3,), and these by channel."""

    seen: Seen
    centre: Floats
    described: dict[Any, Floats32]


def _save_queries(site: BaseMap, seen: Sequence[Seen], out: Path) -> None:
    """Write the keyframes' positions, grounds, truths and descriptors: what votes need not read scans for."""
    centres = [np.array([*each.position[:2], each.ground]) for each in seen]
    described = [describe(each.scan, at, site.descriptor_config) for each, at in zip(seen, centres, strict=True)]
    np.savez(
        out / "queries.npz", channels=list(site.descriptor_config.channels), block=site.config.block,
        position=[each.position for each in seen], ground=[each.ground for each in seen],
        truth=[each.T_map_odom for each in seen],
        descriptors=[list(each.values()) for each in described],
    )  # fmt: skip


def _opened(out: Path) -> tuple[float, Floats32, dict[Any, npt.NDArray[Any]], list[Query]]:
    """Return the block in metres, the stations, their descriptors by channel, memory-mapped, and the keyframes."""
    kept = np.load(out / "queries.npz")
    names = kept["channels"].tolist()
    queries = []
    for position, ground, truth, described in zip(
        kept["position"], kept["ground"], kept["truth"], kept["descriptors"], strict=True
    ):
        seen = Seen(np.zeros((0, 3), dtype=np.float32), position, float(ground), truth)
        centre = np.array([*position[:2], ground])
        queries.append(Query(seen, centre, dict(zip(names, described, strict=True))))
    mapped = {name: np.load(out / f"{k}.npy", mmap_mode="r") for k, name in enumerate(names)}
    return float(kept["block"]), np.load(out / "stations.npy"), mapped, queries


def voted(out: Path, radius: float | None = None, apart: int = 1) -> dict[str, Any]:
    """Milliseconds of every keyframe's vote, the ranks of the right places, and the memory that all took.

    With a ``radius``, within a circle of so many metres around the first keyframe's place. The stations are moved apart
    by a factor: what is right is not known then, but how long it takes is.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {last_core()})
    block, stations, descriptors, queries = _opened(out)
    kept = {path.stem: np.load(path, mmap_mode="r") for path in (out / "index").glob("*.npy")}
    index = StationIndex.from_arrays(kept, descriptors)
    if index is None:
        raise RuntimeError("the index is not one of these descriptors")
    stations[:, :2] *= apart
    site: Any = SimpleNamespace(station_index=index, station_grid=StationGrid(stations, apart * block))
    retrieval = Retrieval(site, RetrievalConfig())
    area = None if radius is None else Circle(*(apart * _place(queries[0].seen)[:2]).tolist(), radius)
    kernels.warm_up()
    retrieval.compared(area).index.prepare()
    consensus = StationConsensus(retrieval, _consensus(len(stations)))
    consensus.vote(queries[0].centre, queries[0].described, area)  # copies the codes that it compares
    consensus.clear()
    times, ranks = [], []
    for seen, centre, described in queries:
        begin = time.perf_counter()
        consensus.vote(centre, described, area)
        found = consensus.hypotheses()
        times.append(1e3 * (time.perf_counter() - begin))
        ranks.append(_rank([each.T_map_odom for each in found], seen))
    size = sum(values.nbytes for values in index.arrays().values())
    return {
        "ms": times, "ranks": ranks, "megabytes": peak_megabytes(), "index_bytes": size,
        "build_s": float((out / "seconds").read_text()),
    }  # fmt: skip


def _consensus(stations: int) -> ConsensusConfig:
    """Return the settings of a search of so many stations."""
    config = ConsensusConfig()
    return replace(config, peaks=coview_peaks(config.peaks, stations))


def _place(seen: Seen) -> Floats:
    """Return where a keyframe was taken (3,), in the map."""
    return np.asarray((seen.T_map_odom @ np.append(seen.position, 1.0))[:3])


def _rank(poses: Sequence[Pose], seen: Seen) -> int | None:
    """Rank of the first right pose, None without one."""
    return next((k for k, T in enumerate(poses) if right(T, seen)), None)


def exhaustive(out: Path, every: int, last: int | None) -> dict[str, Any]:
    """Ranks of the right places by adding up all z-scores; milliseconds of one keyframe's."""
    block, stations, descriptors, queries = _opened(out)
    cells, at = _cells(stations, block)
    config, ranks, times = _consensus(len(stations)), {}, []
    window: list[tuple[Floats, Floats32]] = []
    for number, (seen, centre, described) in enumerate(queries):
        if last is not None and number >= last:
            break
        begin = time.perf_counter()
        window = [*window[1 - config.window :], (centre, _scores(described, descriptors))]
        total = window[-1][1][:, :-1].copy()
        yaw = yaw_of_shift(np.arange(len(total)), len(total))
        if number % every:
            continue
        for older, scores in window[:-1]:
            step = older - centre
            turned = np.column_stack([np.cos(yaw) * step[0] - np.sin(yaw) * step[1],
                                      np.sin(yaw) * step[0] + np.cos(yaw) * step[1]])  # fmt: skip
            for n, (right_by, up_by) in enumerate(np.rint(turned / block).astype(int).tolist()):
                total[n] += scores[n].take(cells.take(at + up_by * cells.shape[1] + right_by, mode="clip"))
        best = argsmallest(total.ravel(), _SHORTLIST)
        shift, station = np.divmod(best, len(stations))
        chosen = _distinct(stations[station].astype(np.float64), yaw[shift], config)
        times.append(1e3 * (time.perf_counter() - begin))
        poses = [
            pose_from(rot_z(float(yaw[shift[k]])), stations[station[k]].astype(np.float64))
            @ pose_from(np.eye(3), -centre)
            for k in chosen
        ]
        ranks[number] = _rank(poses, seen)
    return {"ms": times, "ranks": ranks}


def _distinct(positions: Floats, yaw: Floats, config: ConsensusConfig) -> list[int]:
    """Choose the first of places (N, 3) with headings (N,) that differ from all chosen before."""
    free, chosen = np.ones(len(yaw), dtype=bool), list[int]()
    while len(chosen) < config.peaks and free.any():
        chosen.append(int(free.argmax()))
        near = np.linalg.norm(positions - positions[chosen[-1]], axis=1) < config.distinct_distance
        turn = np.abs((yaw - yaw[chosen[-1]] + np.pi) % (2 * np.pi) - np.pi)
        free &= ~(near & (turn < config.distinct_yaw))
    return chosen


def _scores(described: dict[Any, Floats32], descriptors: dict[Any, npt.NDArray[Any]]) -> Floats32:
    """Mean z-scores of the channels (S, M + 1), 0 for no station."""
    total: Floats32 | None = None
    for name, stored in descriptors.items():
        parts = []
        for start in range(0, len(stored), _BLOCK):
            spectra = kernels.column_spectra(stored[start : start + _BLOCK].astype(np.float32))
            parts.append(kernels.all_shift_distance(described[name], spectra, described[name].shape[-1]))
        score = robust_zscore(np.concatenate(parts))
        total = score if total is None else total + score
    assert total is not None
    mean = (total / np.float32(len(descriptors))).T
    return np.concatenate([mean, np.zeros((len(mean), 1), dtype=np.float32)], axis=1)


def _cells(stations: Floats32, block: float, margin: int = 60) -> tuple[Ints, Ints]:
    """Station of every cell of the grid with a margin, M for none, and the flat cell (M,) of every station."""
    index = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
    column, row = (index - index.min(axis=0) + margin).T
    cells = np.full((int(row.max()) + margin + 1, int(column.max()) + margin + 1), len(stations))
    cells[row, column] = np.arange(len(stations))
    return cells, row * cells.shape[1] + column


def rows(asked: Namespace) -> Iterator[Row]:
    """Time, memory and kept places of every size, then how they grow."""
    found: dict[int, dict[str, Any]] = {}
    for scene in WORLDS:
        isolated(prepare, folder(), WORLDS[scene])  # a child starts with its parent's peak memory: let that be small
    for size in SIZES[:2] if asked.quick else SIZES:
        for scene in WORLDS if size in BOTH else ["town"]:
            with tempfile.TemporaryDirectory(dir=folder()) as scratch:
                isolated(make, size, scene, Path(scratch))
                votes = isolated(voted, Path(scratch))
                if scene == "town":
                    found[size] = votes
                    yield from _figures(size, votes)
                    if size == SIZES[-1]:
                        yield from _prior(size, isolated(voted, Path(scratch), RADIUS))
                        yield from _apart(size, *(isolated(voted, Path(scratch), r, APART) for r in (None, RADIUS)))
                if size in CHECKED:
                    whole = isolated(exhaustive, Path(scratch), CHECKED[size], _LAST.get(size))
                    yield from _beside(f"scale/{size} stations, {scene}", votes, whole)
    if not asked.quick:
        few, many = (found[size] for size in SIZES[-2:])
        decades = np.log10(SIZES[-1] / SIZES[-2])
        growth = np.log10(np.median(many["ms"]) / np.median(few["ms"])) / decades
        yield bounded("scale/slope of the time, 100000 to 1000000 stations", float(growth), "", MOST_SLOPE)
        growth = np.log10(many["megabytes"] / few["megabytes"]) / decades
        yield bounded("scale/slope of the memory, 100000 to 1000000 stations", float(growth), "", MOST_SLOPE)
        for name, values in (
            ("time", [np.median(each["ms"]) for each in found.values()]),
            ("memory", [each["megabytes"] for each in found.values()]),
        ):
            slope = np.polyfit(np.log10(list(found)), np.log10(values), 1)[0]
            yield informs(f"scale/slope of the {name}, 1000 to 1000000 stations, fitted", float(slope), "")


def _figures(size: int, votes: dict[str, Any]) -> Iterator[Row]:
    name = f"scale/{size} stations"
    p50, p95 = np.percentile(votes["ms"], [50, 95])
    yield informs(f"{name}: vote and places, p50", p50, "ms", {"size": size} | votes)
    yield informs(f"{name}: vote and places, p95", p95, "ms")
    yield informs(f"{name}: memory of the process, peak", votes["megabytes"], "MB")
    yield informs(f"{name}: index per station", votes["index_bytes"] / size, "B")
    yield informs(f"{name}: making the index", votes["build_s"], "s")


def _prior(size: int, votes: dict[str, Any]) -> Iterator[Row]:
    """Rows of the votes within a circle."""
    name = f"scale/{size} stations, in a circle of {RADIUS:g} m"
    yield bounded(f"{name}: vote and places, p50", float(np.median(votes["ms"])), "ms", MOST_MS)
    named = [rank is not None for rank in votes["ranks"]]
    yield informs(f"{name}: right place named, of {len(named)}", 100 * float(np.mean(named)), "%")


def _apart(size: int, whole: dict[str, Any], near: dict[str, Any]) -> Iterator[Row]:
    """Rows of the votes on stations far apart, of which each is compared: of the map, and within a circle."""
    name = f"scale/{size} stations every {2 * APART} m"
    yield bounded(f"{name}: vote and places, p50", float(np.median(whole["ms"])), "ms", MOST_QUERY_MS)
    yield informs(f"{name}: memory of the process, peak", whole["megabytes"], "MB")
    yield bounded(f"{name}, in a circle of {RADIUS:g} m: p50", float(np.median(near["ms"])), "ms", MOST_MS)


def _beside(name: str, votes: dict[str, Any], whole: dict[str, Any]) -> Iterator[Row]:
    """Rows of the time, and of the places that the exhaustive search names rightly."""
    ours, ranks = votes["ranks"], whole["ranks"]
    good = [number for number, rank in ranks.items() if rank is not None]
    kept = 100 * float(np.mean([ours[number] is not None for number in good])) if good else np.nan
    yield against(f"{name}: beside the sum", float(np.median(votes["ms"])), float(np.median(whole["ms"])), "ms", None)
    yield reached(f"{name}: right places kept, of {len(good)}", kept, "%", LEAST_KEPT)
    first, before = (100 * float(np.mean([named[k] == 0 for k in ranks])) for named in (ours, ranks))
    yield Row(f"{name}: right place first, beside the sum", first, before, "%")
