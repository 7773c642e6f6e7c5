"""The map that a command works on: a file, a site's directory, or the address of a site, which is cached."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from coview_stream.errors import ConfigError, MapError

if TYPE_CHECKING:
    from coview_stream.basemap.signature import VerifyKey
    from coview_stream.basemap.site.fetch import Mirror


class LocalMap(NamedTuple):
    """A map on this machine: the argument of :meth:`BaseMap.load`, and mirrors of the remote sites that form it."""

    path: Path
    mirrors: tuple[Mirror, ...] = ()


def add_map(parser: argparse.ArgumentParser, optional: bool = False, several: bool = False) -> None:
    """Declare the map argument and ``--around``; ``several``: the command accepts more than one map."""
    parser.add_argument(
        "map",
        nargs="*" if several else "?" if optional else None,
        metavar="SITE",
        help="SITE.coview, a directory of tiles, or zenoh://SITE, https://..., s3://..."
        + ("; several: FLOOR=SITE" if several else ""),
    )
    parser.add_argument(
        "--around", metavar="X,Y,RADIUS", help="load only the tiles of a directory or address within RADIUS of X,Y"
    )


def check_map_name(output: str, directory: bool) -> None:
    """Refuse a name of another format than the one written (ConfigError): a file is ``NAME.coview``."""
    from coview_stream.clouds.files import is_cloud_name

    path = Path(output)
    if directory and (path.suffix == ".coview" or is_cloud_name(path)) and not path.is_dir():
        raise ConfigError(f"{output}: a directory of tiles is written, which is no such file; call it {path.stem}/")
    if not directory and path.suffix not in ("", ".coview"):
        raise ConfigError(
            f"{output}: a map is written, not a {path.suffix}; call it {path.stem}.coview, or {path.stem}/ for a "
            "directory of tiles"
        )


def refuse_run(path: Path) -> None:
    """Refuse a run in place of a map (MapError): the two arguments are easily swapped."""
    if path.suffix == ".coview" or (path / "manifest.json").exists():
        return
    from coview_stream.recordings.layouts import is_run

    if is_run(path):
        raise MapError(f"{path}: is a run, no map; give the map (SITE.coview) first, then the run")


def local_map(
    name: str,
    around: str | None = None,
    verify_key: VerifyKey | None = None,
    base: str = "coview",
    connect: Sequence[str] = (),
    config: Path | None = None,
) -> LocalMap:
    """Return the map that a command was given, by path or address; a remote site is fetched and checked.

    ``around`` is ``X,Y,RADIUS``, None for all of it; ``verify_key`` must have signed a remote site. ``base``,
    ``connect`` and ``config`` are the first part of its keys, endpoints and configuration for ``zenoh://SITE``.

    Raises:
        ConfigError: a malformed address or circle. TransportError: it cannot be fetched, and never was.
        MapError: a missing map, a damaged or unsigned site, or no tile in the circle.
    """
    if around is None and "://" not in name:
        if not Path(name).exists():
            raise MapError(f"{name}: cannot read the map (No such file or directory); check the path")
        refuse_run(Path(name))
        return LocalMap(Path(name))  # skips the imports below: most maps are files

    from coview_stream.basemap.site.fetch import is_site_address
    from coview_stream.basemap.site.manifest import Manifest, is_site
    from coview_stream.basemap.site.site_grid import Around, part_file

    circle = None if around is None else Around.parse(around)
    if is_site_address(name):
        from coview_stream.stream.maps.fetch_map import open_mirror

        mirror = open_mirror(name, circle, verify_key, base, connect, config)
        return LocalMap(mirror.map_path, (mirror,))
    path = Path(name)
    if circle is None:
        return LocalMap(path)
    if not is_site(path):
        raise ConfigError(
            f"--around: {name} is not a directory of tiles; `coview-stream build CLOUDS -o DIRECTORY/` makes one, "
            "`convert` one of a .coview file"
        )
    return LocalMap(part_file(path, Manifest.load(path).tiles_around(circle), str(circle)))


def open_map_argument(args: argparse.Namespace) -> LocalMap:
    """Return the map that parsed arguments name, and replace ``args.map`` by its path.

    Raises:
        As :func:`local_map`; InputError: the key cannot be read.
    """
    from coview_stream.basemap.signature import read_verify_key

    key = None if getattr(args, "verify_key", None) is None else read_verify_key(args.verify_key)
    connect, config = getattr(args, "connect", None) or (), getattr(args, "zenoh_config", None)
    base = getattr(args, "base", "coview")
    given = args.map if isinstance(args.map, list) else [args.map]
    if len(given) == 1:
        opened = local_map(str(given[0]), args.around, key, base, connect, config)
    else:
        from coview_stream.basemap.joined import write_names

        named = []
        for text in map(str, given):
            name, sign, path = text.partition("=")
            if not (sign and name and "/" not in name):  # a path alone
                name, path = Path(text.rstrip("/")).name.removesuffix(".coview"), text
            named.append((name, path))
        maps = [(name, local_map(path, args.around, key, base, connect, config)) for name, path in named]
        mirrors = tuple(mirror for _, part in maps for mirror in part.mirrors)
        opened = LocalMap(write_names([(name, part.path) for name, part in maps]), mirrors)
    args.map = opened.path
    return opened
