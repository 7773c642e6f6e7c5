"""Growth of a keyframe's vote with the map: a thousand to a million stations, on one core.

The search by descriptors as in the product, without registration: a keyframe is compared with all stations, and ten
keyframes agree on places. The map is a simulated town, and around it synthetic stations on the same grid: halves of two
of its own, each turned. One process makes the map of a size, others vote. ``bench city`` compares with an exhaustive
search.
"""

from __future__ import annotations

import math
import pickle
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from bench.accuracy.choices import KeyframeView, Site, right
from bench.harness.files import folder, isolated, peak_megabytes
from bench.harness.rows import Row, bounded, informs
from bench.harness.worlds import WORLDS, opened, prepare, world_name
from bench.speed.search import bind_to_one_core
from coview_stream import BaseMap
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import Channel, ConsensusConfig, KeyframeConfig
from coview_stream.descriptors.coview import describe, on_ground
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Circle
from coview_stream.localization.search.global_search import coview_peaks
from coview_stream.localization.search.retrieval import Retrieval, StationConsensus

SIZES = (1_000, 10_000, 100_000, 1_000_000)
MOST_SLOPE = 1.0  # target: growth from a hundred thousand to a million stations
MOST_MS, MOST_QUERY_MS = 30.0, 1000.0  # targets: of a vote in a prior's circle, and of one that compares a million
RADIUS = 1000.0  # metres of the prior's circle; around the drive it holds 785,000 of the million stations
APART = 10  # factor by which stations are moved apart: every 20 m, as of 20 x 20 km
_BLOCK = 8192
_SEED = 1

Keyframe = tuple[KeyframeView, Floats, dict[Channel, Floats32]]
"""A keyframe, its centre (3,) in the odometry frame on the ground, and its descriptors by channel."""


def make(size: int, out: Path) -> None:
    """Write stations, descriptors and index of a map of ``size`` stations, and the keyframes of the drive."""
    config = WORLDS["town"]
    site, _, _ = opened(config)
    keyframes = described(folder() / world_name(config), site)
    middle = np.mean([place_of(seen) for seen, *_ in keyframes], axis=0)
    own = np.argsort(np.linalg.norm(site.stations - middle, axis=1), kind="stable")[:size]
    known = [site.descriptors(name)[own] for name in site.descriptor_config.channels]
    (out / "queries.pkl").write_bytes(pickle.dumps((site.config.block, keyframes)))
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
    (out / "index").mkdir()
    for name, values in StationIndex.of(descriptors).arrays().items():
        np.save(out / "index" / f"{name}.npy", values)


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
    xy = (others[np.sort(nearest)] + 0.5) * block  # stations stand in the middle of blocks
    height = np.full(missing, np.median(stations[:, 2]))
    return np.concatenate([stations, np.column_stack([xy, height])]).astype(np.float32)


def voted(out: Path, radius: float | None = None, apart: int = 1) -> dict[str, Any]:
    """Return votes and memory; in a circle of ``radius`` metres, or with stations moved ``apart`` (no ranks then)."""
    bind_to_one_core()
    block, keyframes = pickle.loads((out / "queries.pkl").read_bytes())
    stations = np.load(out / "stations.npy")
    descriptors = {name: np.load(out / f"{k}.npy", mmap_mode="r") for k, name in enumerate(keyframes[0][2])}
    arrays = {path.stem: np.load(path, mmap_mode="r") for path in (out / "index").glob("*.npy")}
    index = StationIndex.from_arrays(arrays, descriptors)
    assert index is not None
    stations[:, :2] *= apart
    site: Any = SimpleNamespace(station_index=index, station_grid=StationGrid(stations, apart * block))
    retrieval, config = Retrieval(site), ConsensusConfig()
    area = None if radius is None else Circle(*(apart * place_of(keyframes[0][0])[:2]).tolist(), radius)
    kernels.warm_up()
    retrieval.compared(area).index.prepare()
    consensus = StationConsensus(retrieval, replace(config, peaks=coview_peaks(config.peaks, len(stations))))
    timed(consensus, keyframes[:1], area)  # the first vote copies the codes that it compares
    consensus.clear()
    return {
        **timed(consensus, keyframes, area), "megabytes": peak_megabytes(),
        "index_bytes": sum(values.nbytes for values in index.arrays().values()),
    }  # fmt: skip


def described(world: Path, site: BaseMap) -> list[Keyframe]:
    """Return the keyframes of a world's drive, without their scans."""
    config, out = site.descriptor_config, list[Keyframe]()
    for seen in Site(world, math.inf).keyframes(KeyframeConfig().distance):
        scan = seen.scans[None]
        centre = on_ground(scan, seen.position)
        out.append((replace(seen, scans={}, submap=seen.submap[:0]), centre, describe(scan, centre, config)))
    return out


def timed(consensus: StationConsensus, keyframes: Sequence[Keyframe], area: Circle | None) -> dict[str, Any]:
    """Let keyframes vote: milliseconds of each vote with its places, and the rank of the right place, or None."""
    times, ranks = list[float](), list[int | None]()
    for seen, centre, descriptors in keyframes:
        begin = time.perf_counter()
        consensus.vote(centre, descriptors, area)
        places = consensus.hypotheses()
        times.append(1e3 * (time.perf_counter() - begin))
        ranks.append(next((k for k, place in enumerate(places) if right(place.T_map_odom, seen)), None))
    return {"ms": times, "ranks": ranks}


def place_of(seen: KeyframeView) -> Floats:
    """Place of a keyframe (3,) in the map."""
    return np.asarray((seen.T_map_odom @ np.append(seen.position, 1.0))[:3])


def rows(asked: Namespace) -> Iterator[Row]:
    """Time, memory and places of every size, then their growth."""
    results: dict[int, dict[str, Any]] = {}
    isolated(prepare, folder(), WORLDS["town"])  # a child starts with its parent's peak memory: keep that small
    for size in SIZES[:2] if asked.quick else SIZES:
        name = f"scale/{size} stations"
        with tempfile.TemporaryDirectory(dir=folder()) as scratch:
            isolated(make, size, Path(scratch))
            votes = results[size] = isolated(voted, Path(scratch))
            p50, p95 = np.percentile(votes["ms"], [50, 95])
            yield informs(f"{name}: vote and places, p50", p50, "ms", {"size": size} | votes)
            yield informs(f"{name}: vote and places, p95", p95, "ms")
            yield informs(f"{name}: right place named, of {len(votes['ranks'])}", _named(votes), "%")
            yield informs(f"{name}: memory of the process, peak", votes["megabytes"], "MB")
            yield informs(f"{name}: index per station", votes["index_bytes"] / size, "B")
            if size == SIZES[-1]:
                near = isolated(voted, Path(scratch), RADIUS)
                circle = f"{name}, in a circle of {RADIUS:g} m"
                yield bounded(f"{circle}: vote and places, p50", float(np.median(near["ms"])), "ms", MOST_MS)
                yield informs(f"{circle}: right place named, of {len(near['ranks'])}", _named(near), "%")
                whole, near = (isolated(voted, Path(scratch), radius, APART) for radius in (None, RADIUS))
                wide = f"{name} every {2 * APART} m"
                yield bounded(f"{wide}: vote and places, p50", float(np.median(whole["ms"])), "ms", MOST_QUERY_MS)
                yield informs(f"{wide}: memory of the process, peak", whole["megabytes"], "MB")
                yield bounded(f"{wide}, in a circle of {RADIUS:g} m: p50", float(np.median(near["ms"])), "ms", MOST_MS)
    if not asked.quick:
        few, many = (results[size] for size in SIZES[-2:])
        for name, key in (("time", "ms"), ("memory", "megabytes")):
            slope = float(np.log10(np.median(many[key]) / np.median(few[key])))
            yield bounded(f"scale/slope of the {name}, 100000 to 1000000 stations", slope, "", MOST_SLOPE)


def _named(votes: dict[str, Any]) -> float:
    return 100.0 * float(np.mean([rank is not None for rank in votes["ranks"]]))
