"""Place recognition on public sets: which submap of another traverse is of the same place.

``DIR`` is a set on disk, not part of the repository; its licence is its own:

=============== ====================================================================================================
Wild-Places     ``SITE/SEQUENCE/poses_aligned.csv`` and ``Clouds_downsampled/STAMP.pcd``; sites Karawatha and Venman
CS-Wild-Places  ``SITE/SEQUENCE/poses.csv`` and ``clouds/STAMP.pcd``; ``ground`` or ``aerial`` in each sequence's name
CS-Campus3D     ``umd_evaluation_database.pickle``, ``umd_evaluation_query.pickle``; clouds of float64 triples
=============== ====================================================================================================

Poses are rows of ``timestamp,x,y,z,qx,qy,qz,qw``, site <- submap, metres. Pickles are read as plain containers and
arrays; nothing in them is run. Every query with a right submap in a database is asked of it by each method. AR@1, AR@5
and AR@1 % are the shares with a right one among the first, the first five or the first per cent of the database; MRR is
the mean inverse rank of the first right one (every rank counts; the sets' own scripts leave out ranks beyond 25). All
are averaged over the pairs of traverses. *scan context*, *co-view* and *both* are the product's descriptors at all
shifts; *learned* is the global descriptor of its networks, the aerial one for databases and the ground one for queries.
"""

from __future__ import annotations

import csv
import pickle
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

import coview_kernels as kernels
from bench.accuracy.paper import robust_zscore
from bench.forest.worlds import say
from bench.harness.rows import Row, informs, number, table
from coview_stream.clouds import read_cloud
from coview_stream.config import DescriptorConfig, LocalizerConfig
from coview_stream.descriptors.birds_eye_view import CELL, birds_eye_view
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.descriptors.network import ViewName, network
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, quat_to_matrix, rot_z, transform, yaw_of

WITHIN = {"wild-places": 5.0, "cs-wild-places": 30.0}
"""Metres in the plane within which a submap is the right one, as the sets' own scripts have them by default."""

_CSV = ("poses_aligned_fixed.csv", "poses_aligned.csv", "poses_fixed.csv", "poses.csv")
_CLOUDS = ("clouds", "Clouds_downsampled", "Clouds")
_COLUMNS = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
_CAMPUS = ("umd_evaluation_database.pickle", "umd_evaluation_query.pickle")

# where queries lie, as published with the sets: corners x y, metres, in the frame of the set's own poses
_REGIONS: dict[str, dict[str, list[list[tuple[float, float]]]]] = {
    "wild-places": {
        "Venman": [
            [(-468, -82), (-468, 44), (-314, 44), (-305, 12), (-192, 44), (-192, -82)],
            [(-78, -171), (-78, -215), (-305, -215), (-305, -171)],
            [(-62, 70), (95, 70), (142, 0), (140, -142), (-62, -142)],
        ],
        "Karawatha": [
            [(-150, 8), (300, 8), (300, -210), (-150, -210)],
            [(-215, 618), (-74, 618), (-74, 423), (-215, 423)],
            [(-513, 300), (-513, 37), (-321, 37), (-321, 300)],
        ],
    },
    "cs-wild-places": {
        "Karawatha": [
            [(507018.6, 6942659.38), (507468.6, 6942659.67), (507468.75, 6942441.67), (507018.75, 6942441.38)],
            [(506953.2, 6943269.33), (507094.2, 6943269.43), (507094.33, 6943074.43), (506953.33, 6943074.33)],
            [(506655.41, 6942951.14), (506655.59, 6942688.14), (506847.59, 6942688.26), (506847.41, 6942951.26)],
        ],
        "Venman": [
            [
                *((519331.85, 6943652.2), (519331.19, 6943778.2), (519485.19, 6943779.01)),
                *((519494.36, 6943747.06), (519607.19, 6943779.65), (519607.85, 6943653.65)),
            ],
            [(519722.31, 6943565.25), (519722.54, 6943521.25), (519495.55, 6943520.06), (519495.32, 6943564.06)],
            [
                *((519737.05, 6943806.33), (519894.05, 6943807.16), (519941.41, 6943737.41)),
                *((519940.16, 6943595.4), (519738.16, 6943594.34)),
            ],
        ],
    },
}
# ground submaps that are left out for the drift of their poses
_LEFT_OUT = {
    "Karawatha": [
        *((507460.0, 6942602.0), (507930.0, 6942602.0), (507930.0, 6941940.0)),
        *((506990.0, 6941940.0), (506990.0, 6942340.0), (507460.0, 6942340.0)),
    ]
}


@dataclass(frozen=True)
class Submap:
    """One submap."""

    file: Path
    xy: Floats  # (2,) metres
    pose: Pose | None = None  # (4, 4) site <- submap; None where only the position is known

    def cloud(self, metres: float) -> Points:
        """Return its points (N, 3) upright, but at an unknown heading, metres from its middle.

        Clouds that were scaled to -1 to 1 are scaled back by ``metres``, half of a submap's edge. Raises InputError
        for a cloud that is missing or damaged.
        """
        raw = self._raw()
        scale = metres if len(raw) and np.abs(raw).max() <= 1.0 + 1e-6 else 1.0
        points: Points = (raw * scale).astype(np.float32)
        return points if self.pose is None else transform(inverse(self.upright) @ self.pose, points)

    @property
    def upright(self) -> Pose:
        """(4, 4) site <- submap, turned upright; only for a submap with a pose."""
        assert self.pose is not None
        return pose_from(rot_z(yaw_of(self.pose)), self.pose[:3, 3])

    def _raw(self) -> Floats:
        if not self.file.is_file():
            raise InputError(f"{self.file}: this cloud is named in the set but not there; unpack all of the set")
        if self.file.suffix != ".bin":
            return read_cloud(self.file).map_points()
        numbers = np.fromfile(self.file, dtype="<f8")
        if not len(numbers) or len(numbers) % 3 or not np.isfinite(numbers).all():
            raise InputError(f"{self.file}: {len(numbers)} float64 numbers are no x y z; get the file again")
        return numbers.reshape(-1, 3)


@dataclass(frozen=True)
class Traverse:
    """Submaps of one flight or walk."""

    name: str  # of its folder
    submaps: list[Submap]
    queries: list[int]  # indices into the submaps
    searched: bool = True  # its submaps are a database
    right: dict[int, dict[int, list[int]]] = field(default_factory=dict)  # CS-Campus3D: database, query, right submaps


@dataclass(frozen=True)
class Site:
    """Traverses of one place, and the metres within which a submap is the right one."""

    name: str
    traverses: list[Traverse]
    within: float

    def pairs(self) -> list[tuple[int, int]]:
        """(database, queries) by index: every other traverse that is searched, with each that has queries."""
        searched = [k for k, each in enumerate(self.traverses) if each.searched]
        asked = [k for k, each in enumerate(self.traverses) if each.queries]
        return [(k, j) for k in searched for j in asked if j != k]

    def right(self, database: int, queries: int, query: int) -> list[int]:
        """Return the indices of the right submaps of a database for a query, given by its index."""
        there, here = self.traverses[database], self.traverses[queries]
        if here.right:
            return here.right.get(database, {}).get(query, [])
        apart = np.array([each.xy for each in there.submaps]).reshape(-1, 2) - here.submaps[query].xy
        return [int(k) for k in np.flatnonzero(np.hypot(*apart.T) <= self.within)]


def read_sites(root: Path, within: float | None = None) -> list[Site]:
    """Read a set of any of the three layouts; ``within`` metres is right instead of the set's own.

    Raises:
        InputError: no layout that is known, or a file of it is missing or damaged; the message names it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such directory; name the folder that holds a set's sites")
    if any((root / name).exists() for name in _CAMPUS):
        return [_campus(root)]
    sites = [path for path in sorted(root.iterdir()) if path.is_dir() and _traverses(path)]
    if not sites:
        raise InputError(
            f"{root}: no set that is known; it needs {_CAMPUS[0]}, or SITE/SEQUENCE/{_CSV[1]} beside {_CLOUDS[1]}/, or "
            f"SITE/SEQUENCE/{_CSV[-1]} beside {_CLOUDS[0]}/"
        )
    return [_site(path, within) for path in sites]


def _traverses(site: Path) -> list[Path]:
    """Folders of a site that hold clouds or poses."""
    names = (*_CSV, *_CLOUDS)
    return [path for path in sorted(site.iterdir()) if path.is_dir() and any((path / name).exists() for name in names)]


def _site(path: Path, within: float | None) -> Site:
    folders = _traverses(path)
    crossed = any("aerial" in each.name for each in folders)
    layout = "cs-wild-places" if crossed else "wild-places"
    found = [_traverse(each, layout, path.name) for each in folders]
    return Site(path.name, found, WITHIN[layout] if within is None else within)


def _traverse(folder: Path, layout: str, site: str) -> Traverse:
    """Read one traverse; all of its submaps are queries at a site without published regions."""
    listed = next((folder / name for name in _CSV if (folder / name).is_file()), None)
    if listed is None:
        raise InputError(f"{folder}: no {' or '.join(_CSV[1::2])}; unpack the set's poses as well")
    clouds = next((folder / name for name in _CLOUDS if (folder / name).is_dir()), None)
    if clouds is None:
        raise InputError(f"{folder}: no {' or '.join(_CLOUDS[:2])}/; unpack the set's clouds as well")
    submaps = _poses(listed, clouds)
    aerial = "aerial" in folder.name
    xy = np.array([each.xy for each in submaps]).reshape(-1, 2)
    asked = np.full(len(submaps), not aerial)
    if regions := _REGIONS[layout].get(site):
        asked &= np.any([_inside(xy, corners) for corners in regions], axis=0)
    if layout == "cs-wild-places" and site in _LEFT_OUT:
        asked &= ~_inside(xy, _LEFT_OUT[site])
    searched = aerial or layout == "wild-places"
    return Traverse(folder.name, submaps, [int(k) for k in np.flatnonzero(asked)], searched)


def _inside(xy: Floats, corners: Sequence[tuple[float, float]]) -> Bools:
    return np.asarray(Outline(np.array(corners)).contains_points(xy), dtype=bool)


def _poses(listed: Path, clouds: Path) -> list[Submap]:
    with listed.open(newline="") as stream:
        reader = csv.DictReader(stream, skipinitialspace=True)
        if missing := [name for name in _COLUMNS if name not in (reader.fieldnames or ())]:
            raise InputError(
                f"{listed}: has no column {', '.join(missing)}; the first line names {', '.join(_COLUMNS)}"
            )
        found = []
        for row in reader:
            try:
                numbers = np.array([float(row[name]) for name in _COLUMNS[1:]])
            except (TypeError, ValueError) as error:
                raise InputError(f"{listed}:{reader.line_num}: not a number ({error}); get the file again") from error
            pose = pose_from(quat_to_matrix(numbers[None, 3:])[0], numbers[:3])
            found.append(Submap(clouds / f"{row['timestamp']}.pcd", numbers[:2], pose))
    if not found:
        raise InputError(f"{listed}: holds no pose; get the file again")
    return found


def _campus(root: Path) -> Site:
    """Read CS-Campus3D: traverses of the database, then one of queries for each set of them."""
    databases, asked = (_unpickled(root / name) for name in _CAMPUS)
    found = [Traverse(f"database {k}", _entries(root, each, _CAMPUS[0]), []) for k, each in enumerate(databases)]
    for k, entries in enumerate(asked):
        submaps = _entries(root, entries, _CAMPUS[1])
        rows = _rows(entries)
        right = {
            d: {q: [int(i) for i in row[d]] for q, row in enumerate(rows) if len(row.get(d, ()))}
            for d in range(len(databases))
        }
        found.append(Traverse(f"queries {k}", submaps, list(range(len(submaps))), False, right))
    return Site("campus", found, 0.0)


def _rows(entries: Any) -> list[Any]:
    return list(entries.values()) if isinstance(entries, dict) else list(entries)


def _entries(root: Path, entries: Any, name: str) -> list[Submap]:
    try:
        return [
            Submap(root / str(row["query"]), np.array([float(row["easting"]), float(row["northing"])]))
            for row in _rows(entries)
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{root / name}: an entry has no query, northing and easting ({error})") from error


class _Plain(pickle.Unpickler):
    """Unpickler of containers, numbers and arrays alone."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the parts of NumPy that arrays and numbers are made with."""
        names = {"dtype", "ndarray", "scalar", "_reconstruct", "_frombuffer"}
        if (module.split(".")[0] == "numpy" and name in names) or (module, name) == ("_codecs", "encode"):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is no plain data")


def _unpickled(file: Path) -> list[Any]:
    if not file.is_file():
        raise InputError(f"{file}: not there; CS-Campus3D has both {' and '.join(_CAMPUS)}")
    try:
        with file.open("rb") as stream:
            sets = _Plain(stream).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, ValueError) as error:
        raise InputError(f"{file}: cannot be read ({error}); get the file again") from error
    if not isinstance(sets, list) or not all(isinstance(each, (dict, list)) for each in sets):
        raise InputError(f"{file}: is no list of sets; get the file again")
    return sets


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
