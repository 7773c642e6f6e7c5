"""How long a whole query takes on maps of 0.1 and 1 km2: one drawn forest's features and stations, laid side by side.

Correlation and votes work on the large map: the middle 128 m of a drawn stand, repeated. A place is registered at its
likeness in the original stand, since registration looks at its surroundings only. The limits are for two cores.
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest.forest import BEST, Chain, on_ground, query_of
from bench.forest.worlds import drawn, place
from bench.harness.rows import Row, bounded, listed
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.feature_map import TILE, FeatureMap
from coview_stream.geometry.arrays import Bools, Floats32, Ints
from coview_stream.geometry.transforms import pose_from, transform
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import SearchRequest

LIMITS = {10: 0.4, 32: 3.0}  # seconds allowed to a query, by tiles of 32 m along the edge: 0.10 and 1.05 km2
CUT = 4  # tiles along the edge of what is repeated
_SEED, _QUERIES, _REPEAT = 20_001, 4, 3


class Enlarged(BaseMap):
    """The middle of a map side by side, ``side`` tiles along the edge: features, stations (M, 3), lowest tile (2,)."""

    def __init__(self, original: BaseMap, side: int) -> None:
        self.__dict__.update(original.__dict__)
        features, edge = original.learned, float(TILE)
        assert features is not None
        tiles = features.index.tiles.astype(np.int64)
        self.low: Ints = np.floor(tiles.mean(axis=0) + 0.5).astype(np.int64) - CUT // 2
        low, high = self.low * edge, (self.low + side) * edge
        copies = np.stack(np.meshgrid(*[np.arange(-(-side // CUT))] * 2), axis=-1).reshape(-1, 2) * CUT * edge

        def repeated(at: Floats32, others: npt.NDArray[Any]) -> tuple[Floats32, npt.NDArray[Any]]:
            """Places and what belongs to them, of the middle, in all copies."""
            inner = _within(at, low, low + CUT * edge)
            there = (at[inner, :2] + copies[:, None]).reshape(-1, 2)
            kept = _within(there, low, high)
            return there[kept].astype(np.float32), np.tile(others[inner], (len(copies), 1))[kept]

        number_of = {tuple(tile): k for k, tile in enumerate(tiles.tolist())}
        places = np.stack(np.indices((side, side)).reshape(2, -1)[::-1], axis=1)
        which = [number_of[tuple(tile)] for tile in (places % CUT + self.low).tolist()]
        place_at, place = repeated(features.place_at, features.place)
        arrays = {
            "learned.local": features._local[which],
            "learned.sigma": features._sigma[which],
            "learned.tiles": (places + self.low).astype(np.int32),
            "learned.place": place,
            "learned.place_at": place_at,
        }
        stations = np.hstack(repeated(original.stations, original.stations[:, 2:])).astype(np.float32)
        learned = FeatureMap(arrays, {"weights": features.weights, "cell": 1.0})
        self.__dict__ |= {"learned": learned, "stations": stations}

    def home(self, hypothesis: Hypothesis, query: SearchRequest) -> Hypothesis:
        """Move a hypothesis to its likeness in the original."""
        at = transform(hypothesis.T_map_odom, query.position[None])[0, :2]
        edge = CUT * float(TILE)
        shift = np.floor((at - self.low * float(TILE)) / edge) * -edge
        return replace(hypothesis, T_map_odom=pose_from(np.eye(3), [*shift, 0.0]) @ hypothesis.T_map_odom)


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield the median seconds of a query for each size of the map."""
    config = LocalizerConfig(reloc="learned")
    there = drawn(place(), _SEED, _QUERIES)
    base_map = BaseMap.build(there.base, radius=30.0, learned=True)
    queries = [query_of(drive, config)[0] for drive in there.drives]
    chain = Chain(base_map, config)
    for side, limit in list(LIMITS.items())[: 1 if asked.quick else None]:
        large = Enlarged(base_map, side)
        assert large.learned is not None
        learned = SearchIndex.of(large, config).learned
        assert learned is not None
        learned.prepare()
        peaks = replace(config.consensus, peaks=BEST)
        consensus = Consensus(StationGrid(large.stations, base_map.config.block), peaks)
        spent: list[float] = []
        for query in [queries[0], *queries * _REPEAT]:
            consensus.clear()
            begin = time.perf_counter()
            view = learned.encode(query.surroundings, on_ground(query.surroundings, query))
            consensus.vote(learned.vote(view))
            named = [large.home(hypothesis, query) for hypothesis in consensus.hypotheses()]
            chain.register(named, chain.scan(query))
            spent.append(time.perf_counter() - begin)
        seconds = float(np.median(spent[1:]))  # the first one waits for memory and crops
        km2 = large.learned.tile_area / 1e6
        about = {"km2": km2, "stations": len(large.stations), "total": seconds, "limit": limit}
        yield replace(bounded(f"forest_scale/{km2:.2f} km2", seconds, "s", limit), details=about)


COLUMNS = (
    ("map, km2", "km2", 2), ("stations", "stations", 0), ("query, s", "total", 2), ("limit, s", "limit", 1),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per size of the map."""
    return {"": listed(COLUMNS, [row.details for row in rows])}


def _within(at: npt.NDArray[Any], low: npt.NDArray[Any], high: npt.NDArray[Any]) -> Bools:
    return np.asarray(((at[:, :2] >= low) & (at[:, :2] < high)).all(axis=1))
