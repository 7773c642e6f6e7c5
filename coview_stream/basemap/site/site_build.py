"""Building of a site out of core: sources to parts, parts to thinned tiles, tiles to layers, and a manifest of them.

Each step is a pure function of files that are complete, so the result is the same, byte for byte, with any number of
workers and whatever the order, and a build that was broken off goes on where it was.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from coview_stream.basemap.ground import ground_filter
from coview_stream.basemap.signature import SigningKey
from coview_stream.basemap.site.executors import Executor, SerialExecutor
from coview_stream.basemap.site.manifest import TILE, Manifest, SiteGrid, TileEntry, in_order, is_site, origin_of
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.site.tile_build import Parts, ThinJob, TileJob, build_tile, extent_of, partition, thin
from coview_stream.basemap.sources import Given, Source, sources_of
from coview_stream.basemap.tiles import Key
from coview_stream.clouds.cloud_head import CloudHead, check_together
from coview_stream.config import MapConfig
from coview_stream.errors import CoViewError, InputError, MapError, warn
from coview_stream.geometry.arrays import Floats

WORK = ".build"
"""Folder in a site's directory for what a build has done; only its small records stay when it has ended."""

_MIN_POINTS = 1000  # as of a map in one file

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class SiteBuilt:
    """What a build has come to.

    Attributes:
        manifest: of the site.
        source_points: that were read.
        reused: tiles that had been built before.
        skipped: what was left out, and why, in a line each.
    """

    manifest: Manifest
    source_points: int
    reused: int
    skipped: tuple[str, ...]


def build_site(
    given: Given | Sequence[Given],
    directory: Path,
    config: MapConfig,
    *,
    executor: Executor | None = None,
    tile: float = TILE,
    crs: str | None = None,
    key: SigningKey | None = None,
    keep_going: bool = False,
    progress: bool = False,
) -> SiteBuilt:
    """Build a site, or bring it up to date with its sources.

    Args:
        given: cloud files, folders or patterns of them.
        directory: of the site; made where it is not there.
        config: of the map.
        executor: runs the steps; None does so in this process.
        tile: edge of the tiles, metres.
        crs: reference system of files that state none.
        key: signs the manifest.
        keep_going: leave out sources and tiles that fail, instead of ending.
        progress: show bars on stderr.

    Raises:
        CloudError: a source cannot be read. MapError: nothing to stand on, or the directory cannot be used.
        ConfigError: a setting that sites cannot have.
    """
    check_directory(directory)
    sources = _named(sources_of(given, crs))
    work = directory / WORK
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MapError(f"{directory}: cannot be written ({error.strerror}); choose a writable place") from error
    run = _Run(executor or SerialExecutor(), keep_going, progress)
    sources, low, high = _extent(sources, run)
    before = Manifest.load(directory) if is_site(directory) else None
    origin = before.origin if before is not None and before.tile == tile else origin_of(low, high)
    grid = SiteGrid(origin, tile, config)

    names = list(sources)
    jobs = [(sources[name], name, grid, work / "parts" / f"{k:06d}") for k, name in enumerate(names)]
    parts = run("reading", _partition, jobs, names)
    if not parts:
        raise MapError(f"{directory}: no source could be read")
    warn(check_together([CloudHead(Path(each.name), each.crs) for each in parts]))
    keys = sorted({key for each in parts for key in each.tiles}, key=lambda key: (key[1], key[0]))
    thin_jobs = [ThinJob(grid, key, tuple(each for each in parts if key in each.tiles), work / "thin") for key in keys]
    counts = run("thinning", _thin, thin_jobs, [_tile_name(job.key) for job in thin_jobs])
    if sum(counts) < _MIN_POINTS:
        raise MapError(
            f"{names[0]}: {sum(counts)} points are left; a base map needs {_MIN_POINTS}: are they in metres?"
        )
    thinned = {job.key: job for job in thin_jobs if job.file.is_file()}
    tile_jobs = [_tile_job(grid, key, thinned, directory) for key in thinned]
    built = run("building tiles", build_tile, tile_jobs, [_tile_name(job.key) for job in tile_jobs])
    entries = in_order(each.entry for each in built if each.entry is not None)
    manifest = _manifest(grid, parts, entries, directory)
    if key is not None:
        manifest = manifest.signed(key)
    manifest.save(directory)
    TileStore(directory).prune(manifest.hashes())
    for folder in ("parts", "thin"):
        shutil.rmtree(work / folder, ignore_errors=True)
    _prune_records(work / "records", tile_jobs)
    reused = sum(each.reused for each in built)
    return SiteBuilt(manifest, sum(each.points for each in parts), reused, tuple(run.skipped))


def check_directory(directory: Path) -> None:
    """Refuse to build into anything but a new or empty directory, or a site.

    Raises:
        MapError: the path is a file, or a directory with something else in it.
    """
    if directory.exists() and not directory.is_dir():
        raise MapError(f"{directory}: is a file; a site is a directory, a map in one file is called NAME.coview")
    if not directory.is_dir() or is_site(directory) or (directory / WORK).is_dir():
        return
    if any(directory.iterdir()):
        raise MapError(f"{directory}: is no site, and not empty; name a new directory")


def _named(sources: list[Source]) -> dict[str, Source]:
    """Return the sources by their names in the manifest, sorted: the order they were given in changes nothing."""
    if any(source.rows is not None for source in sources):
        raise InputError("a site is built of files; save the arrays as .npy first, or build one .coview file")
    paths = [source.path for source in sources]
    short = [path.name for path in paths]
    names = [path.name if short.count(path.name) == 1 else str(path) for path in paths]
    return dict(sorted(zip(names, sources, strict=True)))


def _extent(sources: dict[str, Source], run: _Run) -> tuple[dict[str, Source], Floats, Floats]:
    """Return the sources that can be read, and the corners of what they cover, by their heads where these tell."""
    names = list(sources)
    heads = run("looking", _head, list(sources.values()), names)
    usable = {name: source for name, source in sources.items() if name not in run.left_out}
    if not usable:
        raise MapError(f"{names[0]}: no source could be read")
    warn(check_together(heads))
    unknown = [source for source, head in zip(usable.values(), heads, strict=True) if head.low is None]
    extents = [(head.low, head.high) for head in heads if head.low is not None and head.high is not None]
    found = run("measuring", extent_of, unknown, [str(source.path) for source in unknown])
    lows, highs = zip(*extents, *found, strict=True)
    return usable, np.min(lows, axis=0), np.max(highs, axis=0)


def _head(source: Source) -> CloudHead:
    return source.head()


def _partition(job: tuple[Source, str, SiteGrid, Path]) -> Parts:
    return partition(*job)


def _thin(job: ThinJob) -> int:
    return thin(job)


def _tile_job(grid: SiteGrid, key: Key, thinned: dict[Key, ThinJob], directory: Path) -> TileJob:
    around = tuple(
        (other, thinned[other].file, thinned[other].digest) for other in grid.around(key) if other in thinned
    )
    return TileJob(grid, key, around, directory, directory / WORK / "records")


def _manifest(grid: SiteGrid, parts: Sequence[Parts], tiles: tuple[TileEntry, ...], directory: Path) -> Manifest:
    if not sum(tile.stations for tile in tiles):
        raise MapError(f"{directory}: no ground found; a base map needs points on the ground, z up")
    parameters: dict[str, Any] = {
        "config": asdict(grid.config),
        "sources": {each.name: each.sha256 for each in parts},
        "source_points": sum(each.points for each in parts),
        "ground_filter": ground_filter(np.zeros((1, 3), dtype=np.float32)),
        "learned": None,
    }
    if grid.config.learned:
        from coview_stream.descriptors.feature_map import weights_sha256
        from coview_stream.descriptors.network import LOCAL_CELL

        parameters["learned"] = {"weights": weights_sha256(), "cell": LOCAL_CELL}
    crs = next((each.crs for each in parts if each.crs is not None), None)
    return Manifest.from_bytes(Manifest(grid.origin, grid.tile, crs, parameters, tiles).to_bytes(), str(directory))


def _prune_records(folder: Path, jobs: Sequence[TileJob]) -> None:
    kept = {f"{job.key[0]}_{job.key[1]}.{job.digest[:16]}.json" for job in jobs}
    for path in folder.glob("*.json"):
        if path.name not in kept:
            path.unlink(missing_ok=True)


def _tile_name(key: Key) -> str:
    return f"tile {key[0]}, {key[1]}"


class _Run:
    """Runs the steps of a build, one after the other.

    Attributes:
        skipped: what failed and was left out, in a line each.
        left_out: names of these.
    """

    def __init__(self, executor: Executor, keep_going: bool, progress: bool) -> None:
        self.executor, self.keep_going, self.progress = executor, keep_going, progress
        self.skipped: list[str] = []
        self.left_out: set[str] = set()

    def __call__(
        self, title: str, function: Callable[[Item], Result], items: Sequence[Item], names: Sequence[str]
    ) -> list[Result]:
        """Return the results in the order of the items; without those that failed, where that is allowed."""
        results: dict[int, Result] = {}
        failed: dict[int, Exception] = {}
        with _bar(self.progress, title, len(items)) as advance:
            for number, result in self.executor.run(function, items):
                advance()
                if not isinstance(result, Exception):
                    results[number] = result
                    continue
                if not isinstance(result, CoViewError | OSError):
                    raise result
                if not self.keep_going:
                    raise _told(names[number], result) from result
                failed[number] = result
        for number in sorted(failed):
            self.left_out.add(names[number])
            self.skipped.append(str(_told(names[number], failed[number])))
        return [results[number] for number in sorted(results)]


def _told(name: str, error: Exception) -> Exception:
    """Return an error that names what it is about."""
    if Path(name).name in str(error):
        return error
    reason = error.strerror if isinstance(error, OSError) else str(error)
    kind = type(error) if isinstance(error, CoViewError) else MapError
    return kind(f"{name}: {reason}")


@contextmanager
def _bar(show: bool, title: str, total: int) -> Iterator[Callable[[], None]]:
    from tqdm import tqdm

    with tqdm(total=total, desc=title, unit="", disable=not show or not total, leave=False) as bar:
        yield partial(bar.update, 1)
