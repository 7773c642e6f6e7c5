"""``coview-stream build``: a base map from one or many clouds."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from coview_stream.cli.map_argument import check_map_name
from coview_stream.errors import CoViewError, warn

if TYPE_CHECKING:
    from coview_stream.basemap.signature import SigningKey
    from coview_stream.basemap.summary import MapSummary
    from coview_stream.config import MapConfig


HELP = "build a base map from one or many clouds of the same frame"

_OPTIONS: dict[str, tuple[Any, str]] = {
    "block_size": (float, "edge of the station grid, metres (2)"),
    "radius": (float, "radius of the virtual scans, metres (50; preset tls: 100)"),
    "voxel": (float, "edge of the stored cloud's voxels, metres (0.25)"),
    "rings": (int, "rings of the descriptor (20)"),
    "sectors": (int, "sectors of the descriptor (60)"),
}
Clouds: TypeAlias = "Sequence[str | os.PathLike[str]]"

_FIELDS = {"block_size": "block"}
_STDIN = {"-", "/dev/stdin", "/dev/fd/0"}
_MAX_WORKERS = 8  # default: each may take 2 GB

# measured on two airborne towns, 1.0 and 1.5 km2 at 3.6 and 3.2 points/m2, on two cores
_SECONDS_PER_POINT, _SECONDS_PER_KM2 = 12e-6, 78.0
_GB_PER_KM2, _TILES_GB_PER_KM2 = 0.37, 0.09
_WORTH_SAYING = 30.0  # seconds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = "las, laz, copc, e57, ply, pcd, npy, bin; xyz, pts, asc, txt, csv, also .gz"
    parser.add_argument(
        "maps",
        nargs="+",
        metavar="MAP",
        help=f"clouds ({kinds}), folders or patterns of them, http(s):// addresses, - for stdin",
    )
    parser.add_argument(
        "--window", metavar="X0,Y0,X1,Y1", help="read only this rectangle, of COPC files (also by http ranges)"
    )
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="SITE.coview|SITE/",
        help="one file; or a directory of tiles, for sites that do not fit into memory",
    )
    parser.add_argument("--preset", choices=("slam", "tls"), default="slam", help="tls: for terrestrial scans")
    for name, (kind, text) in _OPTIONS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar="N", help=text)
    parser.add_argument(
        "--channels",
        metavar="A,B",
        help="descriptor channels that vote: scan_context, coview, paper (scan_context,coview)",
    )
    parser.add_argument(
        "--learned",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="store features for learned re-localization, 35 MB per km2 (they are)",
    )
    parser.add_argument(
        "--crs",
        metavar="EPSG:N",
        help="reference system of clouds that state none; feet or us-feet if only that is known",
    )
    parser.add_argument("--sign", type=Path, metavar="NAME.key", help="sign the map with this private key (keygen)")
    tiles = parser.add_argument_group("directories of tiles")
    tiles.add_argument(
        "--workers", type=int, metavar="N", help="processes that build tiles (as many as cores, 8 at most)"
    )
    tiles.add_argument(
        "--dask", metavar="HOST:PORT", help="have this Dask scheduler's workers build them (local: start some here)"
    )
    tiles.add_argument("--keep-going", action="store_true", help="leave out, and name, sources and tiles that fail")


def run(args: argparse.Namespace) -> int:
    """Build and save the map, and print its sizes."""
    from coview_stream.basemap.signature import SigningKey
    from coview_stream.config import map_preset
    from coview_stream.errors import ConfigError, MapError

    for name in args.maps:
        _refuse_frames(Path(name))
    output = Path(args.output)
    if output.resolve() in [Path(name).resolve() for name in args.maps]:
        raise MapError(f"{output}: is one of the scans to read; give the map another name")
    key = None if args.sign is None else SigningKey(args.sign)  # before anything slow
    options = {_FIELDS.get(n, n): getattr(args, n) for n in _OPTIONS if getattr(args, n) is not None}
    if args.channels is not None:
        options["channels"] = tuple(name.strip() for name in args.channels.split(","))
    options["learned"] = args.learned
    tiles = args.output.endswith("/") or output.is_dir()
    check_map_name(args.output, tiles)
    if not tiles and (args.workers is not None or args.dask is not None or args.keep_going):
        raise ConfigError(
            "--workers, --dask and --keep-going build directories of tiles; end the name of -o with a slash"
        )
    with local_clouds(args.maps, args.window) as clouds:
        _announce(clouds, tiles)
        if tiles:
            return _build_site(clouds, args, output, map_preset(args.preset, **options), key)
        return _build_file(clouds, args, output, options, key)


def _refuse_frames(path: Path) -> None:
    """Raise MapError for our recorded run, or its directory of frames, which a map would put on top of each other.

    Named files, patterns and other layouts are not checked.
    """
    from coview_stream.clouds.files import is_cloud_name
    from coview_stream.errors import MapError

    if not os.path.isdir(path):  # noqa: PTH112 - never raises
        return
    place = path.resolve()
    frames = place if place.name == "frames" else place / "frames"
    if not (frames.is_dir() and (frames.parent / "odometry.tum").is_file()):
        return
    if place == frames or not any(map(is_cloud_name, place.iterdir())):
        fault = "holds the frames of a run, each in the frame of the body"
        raise MapError(f"{path}: {fault}; name a scan of the site, or '{frames}/*' if they are in one frame")


def _announce(clouds: Clouds, tiles: bool) -> None:
    """Print on stderr how long the build takes and how large the map gets, if the file headers say enough."""
    import numpy as np

    from coview_stream.basemap.sources import sources_of
    from coview_stream.errors import CoViewError, CoViewWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CoViewWarning)  # the build reads the headers again, and warns
        try:
            heads = [source.head() for source in sources_of(clouds)]
        except CoViewError:
            return
    boxes = [np.prod(h.high[:2] - h.low[:2]) for h in heads if h.low is not None and h.high is not None]
    if len(boxes) < len(heads):
        return
    points, area = sum(head.points for head in heads), float(sum(boxes)) / 1e6
    seconds = points * _SECONDS_PER_POINT + area * _SECONDS_PER_KM2
    if seconds > _WORTH_SAYING:
        size = area * (_TILES_GB_PER_KM2 if tiles else _GB_PER_KM2)
        smaller = "" if tiles else " (as a directory, -o NAME/, a quarter)"
        print(
            f"{points / 1e6:.1f} million points on {area:.2g} km2: {math.ceil(seconds / 60)} min on two idle cores; "
            f"a map of {size:.1g} GB{smaller}",
            file=sys.stderr,
        )


def _build_file(
    clouds: Clouds, args: argparse.Namespace, output: Path, options: dict[str, Any], key: SigningKey | None
) -> int:
    from coview_stream.basemap import file_format
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.summary import summary

    file_format.check_target(output)
    begin = time.perf_counter()
    base_map = BaseMap.build(clouds, args.preset, progress=True, crs=args.crs, **options)
    base_map.save(output, key)
    print(
        f"{output}: {base_map.parameters['source_points']} points read, {len(base_map.points)} kept, "
        f"{len(base_map)} stations, {time.perf_counter() - begin:.1f} s, {output.stat().st_size} bytes"
        + ("" if key is None else f", signed with {key.fingerprint}")
    )
    _tell(summary(base_map), args.crs)
    return 0


def _build_site(
    clouds: Clouds, args: argparse.Namespace, output: Path, config: MapConfig, key: SigningKey | None
) -> int:
    from coview_stream.basemap.site.executors import DaskExecutor, Executor, ProcessExecutor
    from coview_stream.basemap.site.site_build import build_site

    begin = time.perf_counter()
    workers = args.workers if args.workers is not None else min(_MAX_WORKERS, os.cpu_count() or 1)
    dask = args.dask is not None
    executor: Executor = DaskExecutor(args.dask, args.workers) if dask else ProcessExecutor(workers)
    try:
        built = build_site(
            clouds, output, config, executor=executor, crs=args.crs, key=key, keep_going=args.keep_going, progress=True
        )
    finally:
        executor.close()
    site = built.manifest
    print(
        f"{output}: {built.source_points} points read, {sum(tile.points for tile in site.tiles)} kept, "
        f"{sum(tile.stations for tile in site.tiles)} stations, {time.perf_counter() - begin:.1f} s, "
        f"{site.nbytes} bytes" + ("" if key is None else f", signed with {key.fingerprint}")
    )
    print(f"{len(site.tiles)} tiles of {site.tile:g} m, {built.reused} as they were; manifest {site.sha256[:12]}")
    _tell(built.summary(), args.crs)
    for line in built.skipped:
        print(f"left out: {line}", file=sys.stderr)
    return 1 if built.skipped else 0


def _tell(covered: MapSummary, crs: str | None) -> None:
    """Print a summary, which does not ask for the unit if ``--crs`` has stated it."""
    for warning in covered.warnings:
        warn(warning)
    print(replace(covered, crs=f"unknown, converted from {crs}") if crs in ("feet", "us-feet") else covered)


@contextlib.contextmanager
def local_clouds(given: Sequence[str], window: str | None) -> Iterator[list[str | os.PathLike[str]]]:
    """Yield local cloud files; those from web servers, stdin (``-``) and windows of COPC files are temporary.

    ``window`` is ``X0,Y0,X1,Y1`` for all clouds; None takes whole files.

    Raises:
        ConfigError: a malformed window. CloudError: a file cannot be fetched, or has a window but is not a COPC file.
    """
    if not _STDIN.isdisjoint(given):
        with tempfile.TemporaryDirectory(prefix="coview-clouds-") as folder:
            read = str(_read_stdin(Path(folder)))
            try:
                with local_clouds([read if name in _STDIN else name for name in given], window) as clouds:
                    yield clouds
            except CoViewError as error:  # it names the temporary file, which the user does not know
                raise type(error)(str(error).replace(read, "stdin")) from error
        return
    from coview_stream.clouds.fetch import Window, fetch_cloud, is_web_address
    from coview_stream.clouds.files import expand_cloud_paths

    wanted = None if window is None else Window.parse(window)
    if wanted is None and not any(map(is_web_address, given)):
        yield list(given)
        return
    with tempfile.TemporaryDirectory(prefix="coview-clouds-") as folder:
        out: list[str | os.PathLike[str]] = []
        for name in given:
            several = [name] if is_web_address(name) or wanted is None else expand_cloud_paths([name])
            for cloud_name in several:
                if wanted is None and not is_web_address(cloud_name):
                    out.append(cloud_name)
                    continue
                path, cloud = fetch_cloud(cloud_name, Path(folder), wanted)
                out.append(path)
                size = f"{cloud.received / 1e6:.1f} MB"
                if wanted:
                    received = f", {size} in {cloud.requests} requests" if cloud.requests else ""
                    size = f"{cloud.points} points in the window{received}"
                print(f"{cloud_name}: {size}", file=sys.stderr)
        yield out


def _read_stdin(folder: Path) -> Path:
    """Write the cloud on stdin into a folder, named by its first bytes; CloudError if they fit no format."""
    from coview_stream.clouds.files import suffix_of_content
    from coview_stream.errors import CloudError

    path = folder / "stdin"
    with path.open("wb") as file:
        shutil.copyfileobj(sys.stdin.buffer, file)
    with path.open("rb") as file:
        suffix = suffix_of_content(file.read(512))
    if not path.stat().st_size:
        raise CloudError("stdin: nothing came (0 bytes)")
    if suffix is None:
        raise CloudError("-: stdin is not a cloud of a format that its first bytes tell; write it to a file")
    return path.rename(path.with_suffix(suffix))
