"""``coview-stream convert``: a directory of tiles to one map file, the reverse, and light copies."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.cli.map_argument import check_map_name

if TYPE_CHECKING:
    from coview_stream.basemap.site.manifest import Manifest

HELP = "make one .coview file of a directory of tiles, or a directory of a file"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("map", type=Path, metavar="FROM", help="SITE.coview, or the directory of a site")
    parser.add_argument("output", metavar="TO", help="the other of them; with --light, a directory")
    parser.add_argument(
        "--light",
        action="store_true",
        help="from a directory to another: one point of each half metre, no features, for robots that fetch it",
    )
    parser.add_argument("--sign", type=Path, metavar="NAME.key", help="sign it with this private key (keygen)")


def run(args: argparse.Namespace) -> int:
    """Convert, and print the sizes."""
    from coview_stream.basemap import file_format
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.signature import SigningKey
    from coview_stream.basemap.site.convert import join, lighten, split
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.errors import ConfigError, naming_missing_libraries

    key = None if args.sign is None else SigningKey(args.sign)
    output, directory = Path(args.output), args.output.endswith("/")
    if not args.map.exists():
        raise ConfigError(f"{args.map}: is not there; give SITE.coview, or the directory of a site")
    check_map_name(args.output, directory=args.light or not args.map.is_dir())
    if args.light:
        if not args.map.is_dir():
            raise ConfigError(
                f"{args.map}: is not a directory of tiles; convert it to one first, then that with --light"
            )
        with naming_missing_libraries("coview-stream convert", "node"), progress_bar("converting", unit="step") as step:
            site = lighten(args.map, output, key, step)
        _tell(output, site)
    elif args.map.is_dir():
        if directory:
            raise ConfigError(
                f"{args.output}: {args.map} is a directory already; name a file, NAME.coview, or add --light"
            )
        file_format.check_target(output)
        with naming_missing_libraries("coview-stream convert", "node"), progress_bar("converting", unit="step") as step:
            sha256 = join(args.map, output, key, step)
        print(f"{output}: {output.stat().st_size} bytes, sha256 {sha256[:12]}")
    else:
        base_map = BaseMap.load(args.map)
        _tell(output, split(base_map.arrays, base_map.parameters, output, key))
    return 0


def _tell(output: Path, site: Manifest) -> None:
    area = max(1, sum(tile.area for tile in site.tiles))
    print(
        f"{output}: {len(site.tiles)} tiles of {site.tile:g} m, {site.nbytes} bytes, "
        f"{site.nbytes / area:.0f} MB per km2; manifest {site.sha256[:12]}"
    )
