"""Partition of one source: its points written, chunk by chunk, into a file for each tile that they lie on."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.site.grid import Key, SiteGrid
from coview_stream.basemap.sources import Source
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.stream import stream_cloud
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Floats, Floats32, Reals
from coview_stream.geometry.validation import MAX_COORDINATE

_MAX_STRAYS = 1 << 15  # columns or rows from the origin: farther points are no part of any site


@dataclass(frozen=True)
class Parts:
    """Where the points of a source are.

    Attributes:
        folder: of a file ``COLUMN_ROW.f4`` for each tile, (N, 3) float32 metres about its corner.
        name: of the source.
        sha256: of the source.
        crs: as it states it.
        points: that it has and that can be used.
        tiles: number of points by column and row.
    """

    folder: Path
    name: str
    sha256: str
    crs: str | None
    points: int
    tiles: dict[Key, int]

    def file(self, key: Key) -> Path:
        """Return the file of a tile."""
        return self.folder / f"{key[0]}_{key[1]}.f4"

    def read(self, key: Key) -> Floats32:
        """Return the points (N, 3) on a tile, mapped into memory."""
        count = self.tiles.get(key, 0)
        if not count:
            return np.empty((0, 3), dtype=np.float32)
        return np.memmap(self.file(key), dtype=np.float32, mode="r", shape=(count, 3))


def extent_of(source: Source) -> tuple[Floats, Floats]:
    """Return the corners (3,) of a source's extent, metres, for which it is read.

    Raises:
        CloudError: it cannot be read, or holds nothing.
    """
    measure = _Extent()
    stream_cloud(source.path, measure)
    if measure.low is None or measure.high is None:
        raise CloudError(f"{source.path}: holds zero points; export the cloud again")
    return measure.low, measure.high


def partition(source: Source, name: str, grid: SiteGrid, folder: Path) -> Parts:
    """Write a source's points by tiles; what an earlier call has completed is not done again.

    Args:
        source: a file.
        name: of it in the manifest.
        grid: the tiles.
        folder: for the parts, this source's own; ``FOLDER.json`` says that they are complete.

    Raises:
        CloudError: the source cannot be read. OSError: the parts cannot be written.
    """
    done = folder.with_suffix(".json")
    stat = source.path.stat()
    state = [str(source.path.resolve()), stat.st_size, stat.st_mtime_ns, list(grid.origin), grid.tile, source.crs]
    known = _completed(done, state, folder, name)
    if known is not None:
        return known
    shutil.rmtree(folder, ignore_errors=True)
    done.unlink(missing_ok=True)
    folder.mkdir(parents=True)
    writer = _Writer(grid, folder)
    crs = stream_cloud(source.path, writer)
    if not writer.counts:
        raise CloudError(f"{source.path}: holds no points that can be used; export the cloud again")
    sha256, points = source.sha256(), sum(writer.counts.values())
    facts = {
        "state": state, "sha256": sha256, "crs": crs or source.crs, "points": points,
        "tiles": [[*key, count] for key, count in sorted(writer.counts.items())],
    }  # fmt: skip
    with atomic_file(done) as file:
        file.write(json.dumps(facts).encode())
    return Parts(folder, name, sha256, crs or source.crs, points, writer.counts)


def _completed(done: Path, state: list[object], folder: Path, name: str) -> Parts | None:
    try:
        facts = json.loads(done.read_bytes())
        if facts["state"] != state:
            return None
        tiles = {(column, row): count for column, row, count in facts["tiles"]}
        parts = Parts(folder, name, facts["sha256"], facts["crs"], facts["points"], tiles)
        whole = all(parts.file(key).stat().st_size == 12 * count for key, count in tiles.items())
        return parts if whole else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


class _Extent(CloudBuilder):
    """Builder that keeps nothing but the extent."""

    def __init__(self) -> None:
        super().__init__()
        self.low: Floats | None = None
        self.high: Floats | None = None

    def add(self, raw: Reals, classification: npt.NDArray[np.uint8] | None = None, dropped: int = 0) -> None:
        usable = _usable(raw)
        if len(usable):
            low, high = usable.min(axis=0), usable.max(axis=0)
            self.low = low if self.low is None else np.minimum(self.low, low)
            self.high = high if self.high is None else np.maximum(self.high, high)


class _Writer(CloudBuilder):
    """Builder that hands the chunks on to the tiles' files instead of keeping them."""

    def __init__(self, grid: SiteGrid, folder: Path) -> None:
        super().__init__()
        self.grid, self.folder = grid, folder
        self.counts: dict[Key, int] = {}

    def add(self, raw: Reals, classification: npt.NDArray[np.uint8] | None = None, dropped: int = 0) -> None:
        usable = _usable(raw)
        if not len(usable):
            return
        cells = self.grid.cells(usable)
        near = (np.abs(cells) < _MAX_STRAYS).all(axis=1)
        usable, cells = usable[near], cells[near]
        order = np.lexsort((cells[:, 0], cells[:, 1]))  # stable: a tile's points stay in the file's order
        usable, cells = usable[order], cells[order]
        begins = np.flatnonzero(np.append(True, (np.diff(cells, axis=0) != 0).any(axis=1)))
        for begin, end in zip(begins, np.append(begins[1:], len(cells)), strict=True):
            key = (int(cells[begin, 0]), int(cells[begin, 1]))
            local = usable[begin:end] - np.asarray(self.grid.origin) - self.grid.corner(key)
            with (self.folder / f"{key[0]}_{key[1]}.f4").open("ab") as file:
                file.write(np.ascontiguousarray(local, dtype=np.float32).tobytes())
            self.counts[key] = self.counts.get(key, 0) + int(end - begin)


def _usable(raw: Reals) -> Floats:
    with np.errstate(invalid="ignore"):
        usable = (np.abs(raw) < MAX_COORDINATE).all(axis=1)
    return np.asarray(raw if usable.all() else raw[usable], dtype=np.float64)
