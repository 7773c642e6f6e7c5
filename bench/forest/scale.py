"""How long a whole query takes on maps of 0.1 and 1 km2: one drawn forest's features and stations, laid side by side.

The middle 128 m of a drawn stand are repeated until the map is as large as it should be. All that depends on a map's
size (correlation, reading the stations, votes, keypoints of the map) works on the large map; registration looks at the
surroundings of five places, which are the same on any map, so each place is registered where its likeness in the
original stand is. The copies are alike: where five fit equally well, none is given up after the coarse scales, and a
query takes longer than where one place is right. The limits are for two cores; BLAS takes the threads of
OPENBLAS_NUM_THREADS, the kernels those of COVIEW_THREADS, transforms and the network one.
"""

from __future__ import annotations

import os
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest.query import Chain, query_of
from bench.forest.worlds import drawn, noted, place
from bench.harness.rows import Row, bounded
from bench.harness.tables import number, table
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.coview import ground_below
from coview_stream.descriptors.feature_map import TILE, FeatureMap
from coview_stream.geometry.arrays import Bools, Floats32, Ints
from coview_stream.geometry.transforms import pose_from, transform
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import SearchRequest

SIDES = (10, 32)  # tiles of 32 m along the edge: 0.10 and 1.05 km2
LIMITS = {10: 0.4, 32: 3.0}  # seconds a query that issue 6 allows
CUT = 4  # tiles along the edge of what is repeated
_SEED, _QUERIES, _REPEAT = 20_001, 4, 3
_PARTS = ("view", "correlation", "consensus", "keypoint refinement", "registration")


def repeated(tiles: Ints, low: Ints, side: int, cut: int = CUT) -> tuple[Ints, Ints]:
    """Lay the tiles (T, 2) within ``cut`` of ``low`` (2,) side by side, ``side`` along the edge.

    Returns:
        (N,) which tile stands at each place, and (N, 2) the places, from ``low`` on.

    Raises:
        ValueError: the map has nothing in one of them.
    """
    number = {tuple(tile): k for k, tile in enumerate(tiles.tolist())}
    row, column = np.indices((side, side)).reshape(2, -1)
    places = np.stack([column, row], axis=1)
    originals = (places % cut + low).tolist()
    if missing := [tile for tile in map(tuple, originals) if tile not in number]:
        raise ValueError(f"the map has nothing in tile {missing[0]}")
    return np.array([number[tuple(tile)] for tile in originals]), places + low


def enlarged(base_map: BaseMap, side: int) -> tuple[FeatureMap, Floats32, Ints]:
    """Features and stations (M, 3) of the repeated middle of a map, and its lowest tile (2,)."""
    features = base_map.learned
    assert features is not None
    tiles = features.index.tiles.astype(np.int64)
    low = np.floor(tiles.mean(axis=0) + 0.5).astype(np.int64) - CUT // 2
    which, places = repeated(tiles, low, side)
    edge = float(TILE)
    copies = np.stack(np.meshgrid(*[np.arange(-(-side // CUT))] * 2), axis=-1).reshape(-1, 2) * CUT * edge
    arrays: dict[str, npt.NDArray[Any]] = {
        "learned.local": features._local[which],
        "learned.sigma": features._sigma[which],
        "learned.tiles": places.astype(np.int32),
    }
    high = (low + side) * edge
    inner = _within(features.place_at, low * edge, (low + CUT) * edge)
    at = (features.place_at[inner] + copies[:, None]).reshape(-1, 2)
    kept = _within(at, low * edge, high)
    arrays["learned.place"] = np.tile(features.place[inner], (len(copies), 1))[kept]
    arrays["learned.place_at"] = at[kept].astype(np.float32)
    own = base_map.stations[_within(base_map.stations, low * edge, (low + CUT) * edge)]
    stations = np.tile(own, (len(copies), 1))
    stations[:, :2] = (own[:, :2] + copies[:, None]).reshape(-1, 2)
    stations = stations[_within(stations, low * edge, high)]
    large = FeatureMap(arrays, {"weights": features.weights, "cell": 1.0})
    return large, stations.astype(np.float32), low


def _within(at: npt.NDArray[Any], low: npt.NDArray[Any], high: npt.NDArray[Any]) -> Bools:
    return np.asarray(((at[:, :2] >= low) & (at[:, :2] < high)).all(axis=1))


def home(hypothesis: Hypothesis, query: SearchRequest, low: Ints) -> Hypothesis:
    """Move a hypothesis to its likeness in the original."""
    at = transform(hypothesis.T_map_odom, query.position[None])[0, :2]
    edge = CUT * float(TILE)
    shift = np.floor((at - low * float(TILE)) / edge) * -edge
    return replace(hypothesis, T_map_odom=pose_from(np.eye(3), np.array([*shift, 0.0])) @ hypothesis.T_map_odom)


def rows(asked: Namespace) -> Iterator[Row]:
    """Seconds of each part of a query, medians over a few, for each size of the map."""
    config = LocalizerConfig(reloc="learned")
    there = drawn(place(), _SEED, _QUERIES)
    base_map = BaseMap.build(there.base, radius=30.0, learned=True)
    queries = [query_of(drive, config)[0] for drive in there.drives]
    chain = Chain(base_map, config)
    for side in SIDES[:1] if asked.quick else SIDES:
        features, stations, low = enlarged(base_map, side)
        begin = time.perf_counter()
        whole = _LargeMap(base_map, features, stations)
        learned = SearchIndex.of(whole, config).learned
        assert learned is not None
        learned.prepare()
        peaks = replace(config.consensus, mode="consensus", peaks=config.learned.peaks)
        consensus = Consensus(stations, base_map.config.block, peaks)
        prepared = time.perf_counter() - begin
        spent: list[list[float]] = []
        for query in [queries[0], *queries * _REPEAT]:
            consensus.clear()
            ticks = [time.perf_counter()]
            centre = np.array([*query.position[:2], ground_below(query.surroundings, query.position)])
            view = learned.encode(query.surroundings, centre)
            ticks.append(time.perf_counter())
            volume = learned.distances(view)
            ticks.append(time.perf_counter())
            consensus.vote(centre, {"learned": volume})
            named = consensus.hypotheses()
            ticks.append(time.perf_counter())
            named = learned.refine(named, view)
            ticks.append(time.perf_counter())
            chain.register([home(each, query, low) for each in named], chain.scan(query))
            ticks.append(time.perf_counter())
            spent.append(np.diff(ticks).tolist())
        medians = np.median(np.array(spent[1:]), axis=0).tolist()  # the first one waits for memory and crops
        total = float(np.median(np.array(spent[1:]).sum(axis=1)))
        parts = dict(zip(_PARTS, medians, strict=True)) | {"prepare": prepared, "total": total, "limit": LIMITS[side]}
        about = {"km2": features.tile_area / 1e6, "stations": len(stations), "threads": _threads(), **parts}
        yield replace(bounded(f"forest_scale/{about['km2']:.2f} km2", total, "s", LIMITS[side]), details=about)


class _LargeMap(BaseMap):
    """A map with other features and stations than the original's."""

    def __init__(self, original: BaseMap, features: FeatureMap, stations: Floats32) -> None:
        self.__dict__.update(original.__dict__)
        self.__dict__ |= {"learned": features, "stations": stations}


def _threads() -> str:
    names = ("OPENBLAS_NUM_THREADS", "COVIEW_THREADS")
    return ", ".join(f"{name}={os.environ.get(name, 'unset')}" for name in names)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per size of the map, seconds."""
    head = ("map, km2", "stations", "prepared once, s", *(f"{part}, s" for part in _PARTS), "query, s", "limit, s")
    sizes = [row.details for row in rows]
    shown = [
        [
            number(size["km2"], 2), str(size["stations"]), number(size["prepare"], 2),
            *(number(size[part], 3) for part in _PARTS), number(size["total"], 2), number(size["limit"], 1),
        ]
        for size in sizes
    ]  # fmt: skip
    text = f"{table(head, shown)}\n\n{sizes[0]['threads']}; {os.cpu_count()} cores."
    return {"": noted(text, "forest_scale")}
