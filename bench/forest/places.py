"""Public sets of submaps for place recognition, as they lie on disk: Wild-Places, CS-Wild-Places and CS-Campus3D.

=============== ====================================================================================================
Wild-Places     ``SITE/SEQUENCE/poses_aligned.csv`` and ``Clouds_downsampled/STAMP.pcd``; sites Karawatha and Venman
CS-Wild-Places  ``SITE/SEQUENCE/poses.csv`` and ``clouds/STAMP.pcd``; ``ground`` or ``aerial`` in each sequence's name
CS-Campus3D     ``umd_evaluation_database.pickle``, ``umd_evaluation_query.pickle``; clouds of float64 triples
=============== ====================================================================================================

Poses are rows of ``timestamp,x,y,z,qx,qy,qz,qw``, site <- submap, metres. Of the pickles only plain containers and
arrays are taken, nothing else in them is run. The sets are not part of the repository; their licences are their own.
"""

from __future__ import annotations

import csv
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline

from coview_stream.clouds import read_cloud
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats
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
    """One submap.

    Attributes:
        file: its cloud.
        xy: (2,) where it is, metres.
        pose: (4, 4) site <- submap; None where only the place is known.
    """

    file: Path
    xy: Floats
    pose: Pose | None = None

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
    """Submaps of one flight or walk.

    Attributes:
        name: of its folder.
        submaps: all of them.
        queries: indices of those that are asked for.
        searched: whether its submaps are a database.
        right: of CS-Campus3D, by database and query: indices of the right submaps. Empty where distance decides.
    """

    name: str
    submaps: list[Submap]
    queries: list[int]
    searched: bool = True
    right: dict[int, dict[int, list[int]]] = field(default_factory=dict)


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
    for number, entries in enumerate(asked):
        submaps = _entries(root, entries, _CAMPUS[1])
        rows = _rows(entries)
        right = {
            k: {q: [int(i) for i in row[k]] for q, row in enumerate(rows) if len(row.get(k, ()))}
            for k in range(len(databases))
        }
        found.append(Traverse(f"queries {number}", submaps, list(range(len(submaps))), False, right))
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
