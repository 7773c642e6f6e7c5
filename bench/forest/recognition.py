"""Place recognition on public sets: which submap of another traverse is of the same place.

``DIR`` is a set on disk: Wild-Places, CS-Wild-Places (a folder of submaps in metres, with their ground) or CS-Campus3D;
``bench/forest/places.py`` says how each lies there. Every query that has a right submap in a database is asked of it
by each method. AR@1, AR@5 and AR@1 % are the shares for which one of the first, the first five or the first per cent
of the database is right; MRR is the mean of one over the first right one's rank. All are averaged over the pairs of
traverses. In the MRR every rank counts; the sets' own scripts leave out the queries whose rank is beyond 25.

*scan context*, *co-view* and *both* are the product's descriptors at all shifts; *learned* is the global descriptor of
its networks, the aerial one for databases and the ground one for queries, which were trained on simulated worlds only.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import coview_kernels as kernels
from bench.forest.places import Site, Submap, read_sites
from bench.forest.worlds import say
from bench.harness.rows import Row, informs, number, table
from coview_stream.config import DescriptorConfig, LocalizerConfig
from coview_stream.descriptors.birds_eye_view import CELL, birds_eye_view
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.descriptors.network import ViewName, network
from coview_stream.geometry.arrays import Floats32, Ints
from coview_stream.geometry.transforms import Points
from coview_stream.localization.search.votes import robust_zscore

METHODS = ("scan context", "co-view", "both", "learned")
REACH = 30.0  # metres: submaps of Wild-Places and CS-Wild-Places have this radius
_METRES = 50.0  # half of the edge of CS-Campus3D's submaps, by the name of its lists
_IMAGE = 64.0  # metres along the edge of a network's image, as a search's
_VOXEL = 0.25  # metres: submaps that are denser say nothing more
_QUICK = 4  # queries of a traverse


def options(parser: ArgumentParser) -> None:
    """Add the set."""
    parser.add_argument("data", type=Path, metavar="DIR", help="a set on disk")
    parser.add_argument("--within", type=float, metavar="METRES", help="a submap this near is right (the set's own)")
    parser.add_argument("--metres", type=float, default=_METRES, help="half of a normalised submap's edge (50)")
    parser.add_argument("--most", type=int, default=0, metavar="N", help="queries of a traverse, spread (0: all)")


@dataclass(frozen=True)
class Described:
    """Descriptors of N submaps: two channels (N, R, S), and of the network (N, P), of unit norm."""

    scan_context: Floats32
    coview: Floats32
    learned: Floats32

    def part(self, chosen: Sequence[int]) -> Described:
        """Return those of some submaps."""
        return Described(*(each[list(chosen)] for each in (self.scan_context, self.coview, self.learned)))


def described(submaps: Sequence[Submap], view: ViewName, metres: float) -> Described:
    """Describe submaps as a map (``aerial``) or as queries (``ground``)."""
    config, encode = DescriptorConfig(radius=REACH), network(view)
    rows: list[tuple[Floats32, Floats32, Floats32]] = []
    for submap in submaps:
        points = _thinned(submap.cloud(metres))
        centre = np.zeros(3)
        centre[2] = ground_below(points, np.array([0.0, 0.0, points[:, 2].max() + 1.0]))
        channels = describe(points, centre, config)
        near = points[np.hypot(points[:, 0], points[:, 1]) < LocalizerConfig().learned.reach]
        size = round(_IMAGE / CELL)
        place = encode(birds_eye_view(near, centre[:2] - 0.5 * _IMAGE, (size, size))).place
        half = place.shape[1] // 2
        mean = place[:, half - 1 : half + 1, half - 1 : half + 1].mean(axis=(1, 2))
        rows.append((channels["scan_context"], channels["coview"], mean / (np.linalg.norm(mean) + np.float32(1e-9))))
    return Described(*(np.stack(each) for each in zip(*rows, strict=True)))


def _thinned(points: Points) -> Points:
    return kernels.transform_unique(points, np.eye(4), _VOXEL)[0]


def distances(database: Described, queries: Described) -> Iterator[dict[str, Floats32]]:
    """Yield by method the distance (N,) of each query to every submap of a database; smaller is nearer."""
    spectra = [kernels.column_spectra(each) for each in (database.scan_context, database.coview)]
    for k in range(len(queries.learned)):
        asked = queries.scan_context[k], queries.coview[k]
        first, second = (
            kernels.all_shift_distance(query, known, query.shape[-1])
            for query, known in zip(asked, spectra, strict=True)
        )
        both = robust_zscore(first) + robust_zscore(second)
        yield {
            "scan context": first.min(axis=1),
            "co-view": second.min(axis=1),
            "both": both.min(axis=1),
            "learned": 1.0 - database.learned @ queries.learned[k],
        }


def rank(distance: Floats32, right: Sequence[int]) -> int:
    """Rank of the first right submap by distances (N,), from 1; a tie counts against it."""
    other = np.ones(len(distance), dtype=bool)
    other[list(right)] = False
    return 1 + int((distance[other] <= distance[list(right)].min()).sum())


def recalls(ranks: Ints, size: int) -> dict[str, float]:
    """AR@1, AR@5, AR@1 % and MRR, per cent, of ranks (N,) in a database of that size."""
    limits = {"AR@1": 1, "AR@5": 5, "AR@1 %": max(round(size / 100), 1)}
    found = {name: 100.0 * float((ranks <= limit).mean()) for name, limit in limits.items()}
    return found | {"MRR": 100.0 * float((1.0 / ranks).mean())}


def asked_of(site: Site, pair: tuple[int, int], most: int) -> list[int]:
    """Return the queries of a pair of traverses that have a right submap there; at most so many, spread."""
    database, queries = pair
    return spread([k for k in site.traverses[queries].queries if site.right(database, queries, k)], most)


def spread(found: list[int], most: int) -> list[int]:
    """Return at most so many of some indices, evenly; all for 0."""
    if not most or len(found) <= most:
        return found
    return [found[k] for k in np.linspace(0, len(found) - 1, most).round().astype(int)]


def measured(site: Site, asked: Namespace) -> Iterator[dict[str, Any]]:
    """Yield the recalls of each pair of traverses, by method."""
    known: dict[int, Described] = {}
    for pair in site.pairs():
        database, queries = (site.traverses[k] for k in pair)
        chosen = asked_of(site, pair, _QUICK if asked.quick else asked.most)
        if not chosen:
            continue
        if pair[0] not in known:
            say(f"{site.name}: describing {len(database.submaps)} submaps of {database.name}")
            known = {pair[0]: described(database.submaps, "aerial", asked.metres)}  # pairs come by database
        there = known[pair[0]]
        here = described([queries.submaps[k] for k in chosen], "ground", asked.metres)
        ranks: dict[str, list[int]] = {name: [] for name in METHODS}
        for query, found in zip(chosen, distances(there, here), strict=True):
            right = site.right(*pair, query)
            for name in METHODS:
                ranks[name].append(rank(found[name], right))
        size = len(database.submaps)
        yield {
            "site": site.name, "database": database.name, "queries": queries.name, "size": size, "n": len(chosen),
            "methods": {name: recalls(np.array(each), size) for name, each in ranks.items()},
        }  # fmt: skip


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per pair of traverses, and per site's map."""
    for site in read_sites(asked.data, asked.within):
        for found in measured(site, asked):
            name = f"recognition/{site.name}, {found['queries']} in {found['database']}: AR@1"
            yield informs(name, max(each["AR@1"] for each in found["methods"].values()), "%", found)


def averages(found: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Average the recalls of pairs of traverses, by method."""
    kinds = ("AR@1", "AR@5", "AR@1 %", "MRR")
    return {m: {k: float(np.mean([each["methods"][m][k] for each in found])) for k in kinds} for m in METHODS}


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Averages by site and method."""
    pairs, lines = [row.details for row in rows], []
    for site in dict.fromkeys(pair["site"] for pair in pairs):
        own = [pair for pair in pairs if pair["site"] == site]
        counted = f"{len(own)} pairs, {sum(pair['n'] for pair in own)} queries"
        for method, values in averages(own).items():
            lines.append([site, counted, method, *(number(value, 1) for value in values.values())])
    return {"": table(("site", "", "method", "AR@1", "AR@5", "AR@1 %", "MRR"), lines)}
