"""Steps of a site's build: partition of a source, thinning of a tile, and building of a tile.

Each step is a pure function of complete files and of the settings, and is skipped if its result exists.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.site.layers import PACKING, cloud_layer, encode, square_metres, stations_layer
from coview_stream.basemap.site.manifest import LayerEntry, TileEntry
from coview_stream.basemap.site.site_grid import FEATURE_HALO, HALO, SiteGrid
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.sources import Source
from coview_stream.basemap.stations import find_stations
from coview_stream.basemap.tiles import Key
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.files import stream_cloud
from coview_stream.clouds.filters import estimate_normals, remove_outliers, voxel_grid
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Reals
from coview_stream.geometry.transforms import Points
from coview_stream.geometry.validation import MAX_COORDINATE

_CODE = 2  # version of the tiles' content: tiles of other versions are rebuilt
_MAX_STRAYS = 1 << 15  # columns or rows from the origin; farther points are dropped
_SLAB = 8_000_000  # points thinned at a time: 0.6 GB


@dataclass(frozen=True)
class Parts:
    """Points of a source in one file per tile.

    Attributes:
        folder: folder with a file ``COLUMN_ROW.f4`` for each tile, (N, 3) float32 metres from the tile's corner.
        name: name of the source.
        sha256: hash of the source.
        crs: reference system that the source states.
        points: number of usable points.
        tiles: number of points by column and row.
        metres: length of the units of x, y and z, if the given unit is not the metre.
    """

    folder: Path
    name: str
    sha256: str
    crs: str | None
    points: int
    tiles: dict[Key, int]
    metres: tuple[float, ...] = ()

    def file(self, key: Key) -> Path:
        """Return the file of a tile."""
        return self.folder / f"{key[0]}_{key[1]}.f4"

    def read(self, key: Key) -> Floats32:
        """Return the points (N, 3) on a tile, mapped into memory."""
        return np.memmap(self.file(key), dtype=np.float32, mode="r", shape=(self.tiles[key], 3))


def extent_of(source: Source) -> tuple[Floats, Floats]:
    """Read a source and return the corners (3,) of its extent, metres; CloudError if it has no points."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)

    class Extent(CloudBuilder):
        def add(self, raw: Reals, classification: npt.NDArray[np.uint8] | None = None, dropped: int = 0) -> None:
            usable = _usable(raw)
            np.minimum(low, usable.min(axis=0, initial=np.inf), out=low)
            np.maximum(high, usable.max(axis=0, initial=-np.inf), out=high)

    stream_cloud(source.path, Extent(), source.unit_to_convert())
    if not np.isfinite(low).all():
        raise CloudError(f"{source.path}: holds zero points; export the cloud again")
    return low, high


def partition(job: tuple[Source, str, SiteGrid, Path]) -> Parts:
    """Write the points of a source (with its name in the manifest) into one file per tile; ``FOLDER.json`` comes last.

    Raises:
        CloudError: the source cannot be read. OSError: the parts cannot be written.
    """
    source, name, grid, folder = job
    done = folder.with_suffix(".json")
    stat = source.path.stat()
    unit = source.unit_to_convert()
    metres = () if unit is None else unit.metres
    state = [str(source.path.resolve()), stat.st_size, stat.st_mtime_ns, list(grid.origin), grid.tile, source.crs]
    state += metres
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # missing or incomplete
        facts = json.loads(done.read_bytes())
        tiles = {(column, row): count for column, row, count in facts["tiles"]}
        parts = Parts(folder, name, facts["sha256"], facts["crs"], facts["points"], tiles, metres)
        if facts["state"] == state and all(parts.file(k).stat().st_size == 12 * n for k, n in tiles.items()):
            return parts
    shutil.rmtree(folder, ignore_errors=True)
    done.unlink(missing_ok=True)
    folder.mkdir(parents=True)
    writer = _Writer(grid, folder)
    crs = stream_cloud(source.path, writer, unit) or source.crs
    if not writer.counts:
        raise CloudError(f"{source.path}: holds no points that can be used; export the cloud again")
    parts = Parts(folder, name, source.sha256(), crs, sum(writer.counts.values()), writer.counts, metres)
    facts = {
        "state": state, "sha256": parts.sha256, "crs": crs, "points": parts.points,
        "tiles": [[*key, count] for key, count in sorted(writer.counts.items())],
    }  # fmt: skip
    with atomic_file(done) as file:
        file.write(json.dumps(facts).encode())
    return parts


class _Writer(CloudBuilder):
    """Builder that appends each chunk to the tiles' files."""

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


@dataclass(frozen=True)
class ThinJob:
    """Arguments of :func:`thin`: a tile, the parts by name with points on it, and a folder for the thinned points."""

    grid: SiteGrid
    key: Key
    parts: tuple[Parts, ...]
    folder: Path

    @property
    def digest(self) -> str:
        """Hash of all inputs."""
        points = [[part.sha256, part.crs, part.tiles[self.key], *part.metres] for part in self.parts]
        return _hash([_settings(self.grid), self.key, points])

    @property
    def file(self) -> Path:
        """File of the result: (N, 3) float32 metres from the tile's corner."""
        return self.folder / f"{self.key[0]}_{self.key[1]}.{self.digest[:16]}.npy"


@dataclass(frozen=True)
class TileJob:
    """Arguments of :func:`build_tile`: a tile, the site's directory, and a folder for entries of finished tiles.

    ``thinned`` has, for the tile and each tile around it, key, file of the thinned points, and hash of their inputs.
    """

    grid: SiteGrid
    key: Key
    thinned: tuple[tuple[Key, Path, str], ...]
    site: Path
    records: Path

    @property
    def record(self) -> Path:
        """File of the tile's entry, named by the hash of all inputs."""
        weights = ""
        if self.grid.config.learned:
            from coview_stream.descriptors.feature_map import weights_sha256

            weights = weights_sha256()
        points = [[key, digest] for key, _, digest in self.thinned]
        digest = _hash([_CODE, _settings(self.grid), self.key, points, weights])
        return self.records / f"{self.key[0]}_{self.key[1]}.{digest[:16]}.json"


def thin(job: ThinJob) -> int:
    """Write the centroids of a tile's occupied voxels, and return their number."""
    if job.file.is_file():
        return len(np.load(job.file, mmap_mode="r"))
    voxel, total = job.grid.config.voxel, sum(part.tiles[job.key] for part in job.parts)
    slabs = max(1, -(-total // _SLAB))
    edges = np.linspace(0, int(np.ceil(job.grid.tile / voxel)), slabs + 1).astype(int) * voxel
    edges[0], edges[-1] = -np.inf, np.inf
    centroids = []
    for low, high in pairwise(edges):
        several = (part.read(job.key) for part in job.parts)
        slab = [np.array(points[(points[:, 1] >= low) & (points[:, 1] < high)]) for points in several]
        centroids.append(voxel_grid(np.concatenate(slab), voxel))
    job.folder.mkdir(parents=True, exist_ok=True)
    points = np.concatenate(centroids)
    with atomic_file(job.file) as file:
        np.save(file, points, allow_pickle=False)
    return len(points)


def build_tile(job: TileJob) -> tuple[TileEntry | None, bool]:
    """Write a tile's layers; return its entry (None if no points are left), and whether it existed already."""
    store, record = TileStore(job.site), job.record
    with contextlib.suppress(OSError, ValueError):  # missing or incomplete
        plain = json.loads(record.read_bytes())
        if plain is None:
            return None, True
        layers = {name: LayerEntry(**layer) for name, layer in plain.pop("layers").items()}
        if all(store.is_whole(layer.sha256, layer.bytes) for layer in layers.values()):
            return TileEntry(layers=layers, **plain), True
    entry = _build(job, store)
    job.records.mkdir(parents=True, exist_ok=True)
    with atomic_file(record) as file:
        file.write(json.dumps(None if entry is None else asdict(entry)).encode())
    return entry, False


def _build(job: TileJob, store: TileStore) -> TileEntry | None:
    config, tile = job.grid.config, job.grid.tile
    halo = FEATURE_HALO if config.learned else HALO
    around = []  # thinned points (N, 3) on and around the tile, from its corner
    for key, file, _ in job.thinned:
        shift = np.array([key[0] - job.key[0], key[1] - job.key[1], 0.0]) * tile
        moved = (np.load(file, mmap_mode="r", allow_pickle=False) + shift).astype(np.float32)
        around.append(moved[_within(moved, tile, halo)])
    region = np.concatenate(around)
    if config.outlier_neighbours:
        region, _ = remove_outliers(region, config.outlier_neighbours, config.outlier_std_ratio)
    near = region[_within(region, tile, HALO)]
    inside = _within(near, tile, 0.0)
    if not inside.any():
        return None
    normals, planarity = estimate_normals(near, config.normal_neighbours, config.normal_radius)
    corner = job.grid.corner(job.key)
    # in the site's frame, so that neighbouring tiles have the same blocks
    stations = find_stations((near + corner).astype(np.float32), config.block, config.levels)
    stations = stations[_within((stations - corner).astype(np.float32), tile, 0.0)]
    features = None
    if config.learned:
        from coview_stream.descriptors.feature_map import features_of_square

        features = features_of_square(
            (region + corner).astype(np.float32), np.rint(corner[:2]).astype(np.int64), round(tile)
        )
    return write_tile(store, job.grid, job.key, (near[inside], normals[inside], planarity[inside]), stations, features)


def write_tile(
    store: TileStore,
    grid: SiteGrid,
    key: Key,
    cloud: tuple[Points, Points, Floats32],
    stations: Floats32,
    features: Arrays | None,
) -> TileEntry:
    """Write the layers of a tile, and return its entry.

    ``cloud`` has points (N, 3) from the tile's corner, unit normals (N, 3) and planarity (N,); stations (M, 3) are
    relative to the site's origin.
    """
    points = cloud[0]
    layers = {
        "cloud": put_layer(store, "cloud", cloud_layer(*cloud, grid.tile, grid.config.voxel)),
        "stations": put_layer(store, "stations", stations_layer(stations, grid.config.block)),
    }
    if features is not None:
        layers["features"] = put_layer(store, "features", features)
    low, high = (round(float(height), 2) for height in (points[:, 2].min(), points[:, 2].max()))
    return TileEntry(*key, len(points), len(stations), square_metres(points), low, high, layers)


def put_layer(store: TileStore, name: str, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LayerEntry:
    """Write a layer, and return its entry."""
    content = encode(arrays, PACKING[name])
    return LayerEntry(store.put(content), len(content))


def _within(points: Points, tile: float, margin: float) -> Bools:
    low, high = np.float32(-margin), np.float32(tile + margin)
    return np.asarray(((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1))


def _settings(grid: SiteGrid) -> object:
    return [list(grid.origin), grid.tile, asdict(grid.config)]


def _hash(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
