"""The map that a command works on: a file, a site's directory, or the address of a site, of which a copy is kept."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from coview_stream.basemap.joined import ServedMaps
    from coview_stream.basemap.signature import VerifyKey
    from coview_stream.basemap.site.fetch import Mirror
    from coview_stream.basemap.site.served_site import ServedSite


class LocalMap(NamedTuple):
    """A map on this machine.

    Attributes:
        path: what :meth:`BaseMap.load` takes.
        mirror: of a site elsewhere, None of a map that is here.
        site: whose changes or robots can be followed; None where that was not asked for, and of one file.
    """

    path: Path
    mirror: Mirror | None = None
    site: ServedSite | ServedMaps | None = None


def add_map(parser: argparse.ArgumentParser, optional: bool = False, several: bool = False) -> None:
    """Declare the map's argument, and ``--around``; ``several``: or more than one."""
    parser.add_argument(
        "map",
        nargs="+" if several else "?" if optional else None,
        metavar="SITE",
        help="SITE.coview, a site's directory, or its address: zenoh://SITE, https://..., s3://..."
        + ("; several (storeys, sites) are searched together, by name: FLOOR=SITE.coview" if several else ""),
    )
    parser.add_argument(
        "--around",
        metavar="X,Y,RADIUS",
        help="of a directory or an address only the tiles that this circle meets; of `serve` it moves with the robots",
    )


def local_map(
    name: str,
    around: str | None = None,
    verify_key: VerifyKey | None = None,
    base: str = "coview",
    connect: Sequence[str] = (),
    config: Path | None = None,
    follows: bool = False,
) -> LocalMap:
    """Return the map on this machine that a command was given; of an address, what has been fetched and checked.

    Args:
        name: path or address.
        around: ``X,Y,RADIUS``; None for all of it.
        verify_key: has to have signed it, if it comes from elsewhere.
        base: first part of zenoh keys.
        connect: zenoh endpoints, for ``zenoh://SITE``.
        config: a zenoh configuration, likewise.
        follows: whether the site's changes, and with ``around`` its robots, are to be followed.

    Raises:
        ConfigError: a malformed address or circle. TransportError: it cannot be fetched, and never was.
        MapError: what came is not what it should be, or nothing is in the circle.
    """
    if around is None and "://" not in name:
        return LocalMap(Path(name))  # without the modules below: most maps are files

    from coview_stream.basemap.site.fetch import is_site_address
    from coview_stream.basemap.site.manifest import Around, Manifest, is_site, part_file, tiles_around
    from coview_stream.basemap.site.served_site import ServedSite
    from coview_stream.errors import ConfigError

    circle = None if around is None else Around.parse(around)
    if is_site_address(name):
        from coview_stream.stream.maps.fetch_map import open_mirror

        mirror = open_mirror(name, circle, verify_key, base, connect, config)
        if not follows:
            return LocalMap(mirror.map_path, mirror)
        served = ServedSite(mirror.directory, mirror, circle)
        return LocalMap(served.map_path, mirror, served)
    path = Path(name)
    if circle is None:
        return LocalMap(path)
    if not is_site(path):
        raise ConfigError(
            f"--around: {name} is no directory of tiles; `coview-stream build CLOUDS -o DIRECTORY/` makes one, "
            "`convert` one of a .coview file"
        )
    if follows:
        served = ServedSite(path, None, circle)
        return LocalMap(served.map_path, None, served)
    return LocalMap(part_file(path, tiles_around(Manifest.load(path), circle), str(circle)))


def open_map_argument(args: argparse.Namespace, follows: bool = False) -> LocalMap:
    """Return the map that parsed arguments name, and put its path in the place of ``args.map``.

    Args:
        args: the arguments.
        follows: as of :func:`local_map`; of several maps only changes are followed, not robots.

    Raises:
        As of :func:`local_map`; InputError: the key cannot be read.
    """
    from coview_stream.basemap.signature import read_verify_key

    key = None if getattr(args, "verify_key", None) is None else read_verify_key(args.verify_key)
    connect, config = getattr(args, "connect", None) or (), getattr(args, "config", None)
    base = getattr(args, "base", "coview")
    given = args.map if isinstance(args.map, list) else [args.map]
    if len(given) == 1:
        found = local_map(str(given[0]), args.around, key, base, connect, config, follows)
    else:
        found = _several([_named(str(each)) for each in given], args.around, key, base, connect, config, follows)
    args.map = found.path
    return found


def _several(
    maps: Sequence[tuple[str, str]],
    around: str | None,
    verify_key: VerifyKey | None,
    base: str,
    connect: Sequence[str],
    config: Path | None,
    follows: bool,
) -> LocalMap:
    """Return several maps as one, by their names; the arguments are those of :func:`local_map`."""
    from coview_stream.basemap.joined import ServedMaps

    found = [(name, local_map(path, around, verify_key, base, connect, config)) for name, path in maps]
    mirrors = [each.mirror for _, each in found if each.mirror is not None]
    served = ServedMaps([(name, each.path) for name, each in found], mirrors)
    if follows and mirrors:
        return LocalMap(served.map_path, None, served)
    served.close()
    return LocalMap(served.map_path)


def _named(text: str) -> tuple[str, str]:
    """Return the name and the path of ``NAME=PATH``, or of a path alone."""
    name, sign, path = text.partition("=")
    if sign and name and "/" not in name:
        return name, path
    return Path(text.rstrip("/")).name.removesuffix(".coview"), text
