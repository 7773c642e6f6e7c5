"""Build a site out of core: sources to parts, parts to thinned tiles, tiles to layers, and a manifest.

The result is the same, byte for byte, with any number of workers and in any order. An interrupted build resumes.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from coview_stream.basemap.ground import ground_filter
from coview_stream.basemap.signature import SigningKey
from coview_stream.basemap.site.executors import Executor
from coview_stream.basemap.site.manifest import Manifest, TileEntry, in_order, is_site
from coview_stream.basemap.site.site_grid import TILE, SiteGrid, origin_of
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.site.tile_build import Parts, ThinJob, TileJob, build_tile, extent_of, partition, thin
from coview_stream.basemap.sources import Given, Source, short_names, sources_of, warn_of_other_systems
from coview_stream.basemap.summary import MapSummary, too_thin
from coview_stream.clouds.cloud_head import CloudHead, check_together
from coview_stream.clouds.progress import Progress, staged_bar
from coview_stream.clouds.reference_system import short_name
from coview_stream.config import MapConfig, config_of_map
from coview_stream.errors import CoViewError, InputError, MapError, warn
from coview_stream.geometry.arrays import Floats

WORK = ".build"
"""Folder in a site's directory for intermediate results; its small records stay after the build."""

_SHARES = {"reading heads": 0.01, "finding extents": 0.04, "reading": 0.15, "thinning": 0.15, "building tiles": 0.65}
"""Shares of the build time, for the progress bar."""

_MIN_POINTS = 1000  # the same as for a map in one file

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class SiteBuilt:
    """Result of a build.

    Attributes:
        manifest: manifest of the site.
        source_points: number of points read.
        reused: number of tiles that existed already.
        skipped: sources and tiles that failed, with the reason, one line each.
        low, high: (3,) corners of the sources' extent, in their frame, metres.
    """

    manifest: Manifest
    source_points: int
    reused: int
    skipped: tuple[str, ...]
    low: Floats
    high: Floats

    def summary(self) -> MapSummary:
        """Summarise the map from its manifest, without reading points."""
        site = self.manifest
        area = max(1, sum(tile.area for tile in site.tiles))
        density = sum(tile.points for tile in site.tiles) / area
        thin = too_thin(density, config_of_map(site.parameters["config"]).voxel)
        width, depth, _ = (self.high - self.low).tolist()
        return MapSummary(
            width, depth, area=area,
            lowest=min(tile.low for tile in site.tiles) + site.origin[2],
            highest=max(tile.high for tile in site.tiles) + site.origin[2],
            density=density, crs=short_name(site.crs), bytes=site.nbytes, form="tiles",
            warnings=(thin,) if thin else (),
        )  # fmt: skip


def build_site(
    given: Given | Sequence[Given],
    directory: Path,
    config: MapConfig,
    *,
    crs: str | None = None,
    key: SigningKey | None = None,
    executor: Executor | None = None,
    keep_going: bool = False,
    progress: bool = False,
) -> SiteBuilt:
    """Build a site, or update it from its sources.

    Args:
        given: cloud files, folders, or patterns.
        directory: directory of the site, created if it does not exist.
        config: settings of the map.
        crs: reference system of files that state none.
        key: signs the manifest.
        executor: runs the steps; None runs them in this process.
        keep_going: skip sources and tiles that fail, instead of raising.
        progress: show a bar on stderr, or one line per stage where stderr is not a terminal.

    Raises:
        CloudError: a source cannot be read. MapError: there are no stations, or the directory cannot be used.
        ConfigError: a setting that sites cannot have. InputError: no weights for learned features, or an array.
    """
    if config.learned:
        from coview_stream.descriptors.network import VIEW_NAMES, weights_file

        for view in VIEW_NAMES:  # before the clouds are read
            weights_file(view)
    check_directory(directory)
    listed = sources_of(given, crs)
    if any(source.rows is not None for source in listed):
        raise InputError("a site is built of files; save the arrays as .npy first, or build one .coview file")
    # sorted by their name in the manifest: the order of the arguments does not matter
    sources = dict(sorted(zip(short_names([source.path for source in listed]), listed, strict=True)))
    work = directory / WORK
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MapError(f"{directory}: cannot be written ({error.strerror}); choose a writable place") from error
    with staged_bar(_SHARES, progress) as stage:
        run = _Run(executor or Executor(), keep_going, stage)
        sources, low, high = _extent(sources, run)
        before = Manifest.load(directory) if is_site(directory) else None
        origin = before.origin if before is not None and before.tile == TILE else origin_of(low, high)
        grid = SiteGrid(origin, TILE, config)

        names = list(sources)
        jobs = [(sources[name], name, grid, work / "parts" / f"{k:06d}") for k, name in enumerate(names)]
        parts = run("reading", partition, jobs, names)
        if not parts:
            raise MapError(f"{directory}: no source could be read")
        warn(check_together([CloudHead(Path(part.name), part.crs) for part in parts]))
        keys = sorted({key for part in parts for key in part.tiles}, key=lambda key: (key[1], key[0]))
        thin_jobs = [
            ThinJob(grid, key, tuple(part for part in parts if key in part.tiles), work / "thin") for key in keys
        ]
        counts = run("thinning", thin, thin_jobs, ["tile {}, {}".format(*job.key) for job in thin_jobs])
        if sum(counts) < _MIN_POINTS:
            raise MapError(
                f"{names[0]}: {sum(counts)} points are left; a base map needs {_MIN_POINTS}: are they in metres?"
            )
        thinned = {job.key: (job.key, job.file, job.digest) for job in thin_jobs if job.file.is_file()}
        tile_jobs = [
            TileJob(grid, key, tuple(thinned[k] for k in grid.around(key) if k in thinned), directory, work / "records")
            for key in thinned
        ]
        built = run("building tiles", build_tile, tile_jobs, ["tile {}, {}".format(*job.key) for job in tile_jobs])
    manifest = _manifest(grid, parts, in_order(entry for entry, _ in built if entry is not None), directory)
    if key is not None:
        manifest = manifest.signed(key)
    manifest.save(directory)
    TileStore(directory).prune(manifest.hashes())
    for folder in ("parts", "thin"):
        shutil.rmtree(work / folder, ignore_errors=True)
    records = {job.record for job in tile_jobs}
    for path in (work / "records").glob("*.json"):
        if path not in records:
            path.unlink(missing_ok=True)
    return SiteBuilt(
        manifest, sum(part.points for part in parts), sum(old for _, old in built), tuple(run.skipped), low, high
    )


def check_directory(directory: Path) -> None:
    """Raise MapError for a directory that is not new, empty, a site or an unfinished build of one."""
    if directory.exists() and not directory.is_dir():
        raise MapError(f"{directory}: is a file; a site is a directory, a map in one file is called NAME.coview")
    if not directory.is_dir() or is_site(directory) or (directory / WORK).is_dir():
        return
    if any(directory.iterdir()):
        raise MapError(f"{directory}: is not a site, and not empty; name a new directory")


def _extent(sources: dict[str, Source], run: _Run) -> tuple[dict[str, Source], Floats, Floats]:
    """Return the readable sources, and the corners of their extent."""
    names = list(sources)
    heads = run("reading heads", Source.head, list(sources.values()), names)
    usable = {name: source for name, source in sources.items() if name not in run.left_out}
    if not usable:
        raise MapError(f"{names[0]}: no source could be read")
    warn(check_together(heads))
    warn_of_other_systems(list(usable.values()), heads)
    unknown = [source for source, head in zip(usable.values(), heads, strict=True) if head.low is None]
    extents = [(head.low, head.high) for head in heads if head.low is not None and head.high is not None]
    measured = run("finding extents", extent_of, unknown, [str(source.path) for source in unknown])
    lows, highs = zip(*extents, *measured, strict=True)
    return usable, np.min(lows, axis=0), np.max(highs, axis=0)


def _manifest(grid: SiteGrid, parts: Sequence[Parts], tiles: tuple[TileEntry, ...], directory: Path) -> Manifest:
    if not sum(tile.stations for tile in tiles):
        raise MapError(f"{directory}: no ground found; a base map needs points on the ground, z up")
    parameters: dict[str, Any] = {
        "config": asdict(grid.config),
        "sources": {part.name: part.sha256 for part in parts},
        "source_points": sum(part.points for part in parts),
        "ground_filter": ground_filter(np.zeros((1, 3), dtype=np.float32)),
        "learned": None,
    }
    if grid.config.learned:
        from coview_stream.descriptors.feature_map import weights_sha256
        from coview_stream.descriptors.network import LOCAL_CELL

        parameters["learned"] = {"weights": weights_sha256(), "cell": LOCAL_CELL}
    crs = next((part.crs for part in parts if part.crs is not None), None)
    return Manifest.from_bytes(Manifest(grid.origin, grid.tile, crs, parameters, tiles).to_bytes(), str(directory))


class _Run:
    """Runner of a build's steps, one after the other.

    Attributes:
        skipped: one line for each item that failed and was skipped.
        left_out: names of these items.
    """

    def __init__(self, executor: Executor, keep_going: bool, stage: Callable[[str], Progress]) -> None:
        self.executor, self.keep_going, self.stage = executor, keep_going, stage
        self.skipped: list[str] = []
        self.left_out: set[str] = set()

    def __call__(
        self, title: str, function: Callable[[Item], Result], items: Sequence[Item], names: Sequence[str]
    ) -> list[Result]:
        """Return the results in the order of the items; failed items are left out if that is allowed."""
        results: dict[int, Result] = {}
        failed: dict[int, Exception] = {}
        step = self.stage(title)
        for done, (number, result) in enumerate(self.executor.run(function, items), start=1):
            step(done, len(items))
            if not isinstance(result, Exception):
                results[number] = result
                continue
            if not isinstance(result, CoViewError | OSError):
                raise result
            if not self.keep_going:
                raise _naming(names[number], result) from result
            failed[number] = result
        for number in sorted(failed):
            self.left_out.add(names[number])
            self.skipped.append(str(_naming(names[number], failed[number])))
        return [results[number] for number in sorted(results)]


def _naming(name: str, error: Exception) -> Exception:
    """Return the error with the name of its source or tile."""
    if Path(name).name in str(error):
        return error
    reason = error.strerror if isinstance(error, OSError) else str(error)
    kind = type(error) if isinstance(error, CoViewError) else MapError
    return kind(f"{name}: {reason}")
