"""Building of one tile: a pure function of its points, of those around it, and of the site's settings."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.site.layers import PACKING, cloud_layer, encode, square_metres, stations_layer
from coview_stream.basemap.site.manifest import FEATURE_HALO, HALO, LayerEntry, SiteGrid, TileEntry
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.sources import Source
from coview_stream.basemap.stations import find_stations
from coview_stream.basemap.tiles import Key
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.files import stream_cloud
from coview_stream.clouds.filters import estimate_normals, remove_outliers, voxel_grid
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Floats, Floats32, Reals
from coview_stream.geometry.transforms import Points
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


_CODE = 2
"""Counts changes of what a tile is made of: tiles of other code are not taken for done."""

_SLAB = 8_000_000  # points that are thinned at a time: 0.6 GB; set by hand


@dataclass(frozen=True)
class ThinJob:
    """What :func:`thin` is told.

    Attributes:
        grid: the tiles.
        key: the tile.
        parts: of the sources that have points there, in the order of their names.
        folder: for the thinned points.
    """

    grid: SiteGrid
    key: Key
    parts: tuple[Parts, ...]
    folder: Path

    @property
    def digest(self) -> str:
        """Hash of all that the result depends on."""
        of = [[part.sha256, part.crs, part.tiles[self.key]] for part in self.parts]
        return _hash([_settings(self.grid), self.key, of])

    @property
    def file(self) -> Path:
        """Where the result goes: (N, 3) float32 metres about the tile's corner."""
        return self.folder / f"{self.key[0]}_{self.key[1]}.{self.digest[:16]}.npy"


@dataclass(frozen=True)
class TileJob:
    """What :func:`build_tile` is told.

    Attributes:
        grid: the tiles.
        key: the tile.
        thinned: of the tiles around and of itself: key, file of the thinned points, and hash of what they are.
        site: directory of the site.
        records: folder of the entries of tiles that are done.
    """

    grid: SiteGrid
    key: Key
    thinned: tuple[tuple[Key, Path, str], ...]
    site: Path
    records: Path

    @property
    def digest(self) -> str:
        """Hash of all that the result depends on."""
        of = [[key, digest] for key, _, digest in self.thinned]
        return _hash([_CODE, _settings(self.grid), self.key, of, _weights(self.grid)])


@dataclass(frozen=True)
class BuiltTile:
    """What :func:`build_tile` tells.

    Attributes:
        entry: of the manifest; None for a tile on which nothing is left after cleaning.
        reused: whether it was done already.
    """

    entry: TileEntry | None
    reused: bool


def thin(job: ThinJob) -> int:
    """Write the centroids of a tile's occupied voxels, and return their number; what is there is not done again."""
    if job.file.is_file():
        return len(np.load(job.file, mmap_mode="r"))
    voxel, total = job.grid.config.voxel, sum(part.tiles[job.key] for part in job.parts)
    slabs = max(1, -(-total // _SLAB))
    rows = int(np.ceil(job.grid.tile / voxel))
    edges = np.linspace(0, rows, slabs + 1).astype(int)
    found = [
        voxel_grid(
            _slab(job, edges[k] * voxel if k else -np.inf, edges[k + 1] * voxel if k + 1 < slabs else np.inf), voxel
        )
        for k in range(slabs)
    ]
    job.folder.mkdir(parents=True, exist_ok=True)
    points = np.concatenate(found)
    with atomic_file(job.file) as file:
        np.save(file, points, allow_pickle=False)
    return len(points)


def _slab(job: ThinJob, begin: float, end: float) -> Points:
    found = []
    for part in job.parts:
        points = part.read(job.key)
        found.append(np.array(points[(points[:, 1] >= begin) & (points[:, 1] < end)]))
    return np.concatenate(found)


def build_tile(job: TileJob) -> BuiltTile:
    """Write a tile's layers into the site's store, unless they are there, and return its entry."""
    store, record = TileStore(job.site), job.records / f"{job.key[0]}_{job.key[1]}.{job.digest[:16]}.json"
    known = _recorded(record, store)
    if known is not None:
        return replace(known, reused=True)
    entry = _build(job, store)
    job.records.mkdir(parents=True, exist_ok=True)
    with atomic_file(record) as file:
        file.write(json.dumps(None if entry is None else asdict(entry)).encode())
    return BuiltTile(entry, reused=False)


def _recorded(record: Path, store: TileStore) -> BuiltTile | None:
    try:
        plain = json.loads(record.read_bytes())
    except (OSError, ValueError):
        return None
    if plain is None:
        return BuiltTile(None, reused=True)
    layers = {name: LayerEntry(**each) for name, each in plain.pop("layers").items()}
    if not all(store.is_whole(layer.sha256, layer.bytes) for layer in layers.values()):
        return None
    return BuiltTile(TileEntry(layers=layers, **plain), reused=True)


def _build(job: TileJob, store: TileStore) -> TileEntry | None:
    config = job.grid.config
    region = _region(job, FEATURE_HALO if config.learned else HALO)
    if config.outlier_neighbours:
        region, _ = remove_outliers(region, config.outlier_neighbours, config.outlier_std_ratio)
    near = region[_within(region, job.grid.tile, HALO)]
    inside = _within(near, job.grid.tile, 0.0)
    if not inside.any():
        return None
    normals, planarity = estimate_normals(near, config.normal_neighbours, config.normal_radius)
    corner = job.grid.corner(job.key)
    # in the site's frame: blocks are the same whichever tile they are found from
    stations = find_stations((near + corner).astype(np.float32), config.block, config.levels)
    stations = stations[_within((stations - corner).astype(np.float32), job.grid.tile, 0.0)]
    layers = {
        "cloud": cloud_layer(near[inside], normals[inside], planarity[inside], job.grid.tile, config.voxel),
        "stations": stations_layer(stations, config.block),
    }
    if config.learned:
        from coview_stream.descriptors.feature_map import features_of_square

        layers["features"] = features_of_square(
            (region + corner).astype(np.float32), np.rint(corner[:2]).astype(np.int64), round(job.grid.tile)
        )
    entries = {}
    for name, arrays in layers.items():
        content = encode(arrays, PACKING[name])
        entries[name] = LayerEntry(store.put(content), len(content))
    heights = near[inside][:, 2]
    low, high = round(float(heights.min()), 2), round(float(heights.max()), 2)
    return TileEntry(*job.key, int(inside.sum()), len(stations), square_metres(near[inside]), low, high, entries)


def _region(job: TileJob, halo: float) -> Points:
    """Return the thinned points (N, 3) of a tile and around it, about its corner."""
    found = []
    for key, file, _ in job.thinned:
        points = np.load(file, mmap_mode="r", allow_pickle=False)
        shift = np.array([key[0] - job.key[0], key[1] - job.key[1], 0.0]) * job.grid.tile
        moved = (points + shift).astype(np.float32)
        found.append(moved[_within(moved, job.grid.tile, halo)])
    return np.concatenate(found)


def _within(points: Points, tile: float, margin: float) -> np.ndarray:
    low, high = np.float32(-margin), np.float32(tile + margin)
    return np.asarray(((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1))


def _settings(grid: SiteGrid) -> object:
    return [list(grid.origin), grid.tile, asdict(grid.config)]


def _weights(grid: SiteGrid) -> str:
    if not grid.config.learned:
        return ""
    from coview_stream.descriptors.feature_map import weights_sha256

    return weights_sha256()


def _hash(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
