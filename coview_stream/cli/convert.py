"""``coview-stream convert``: a map in one file from a directory of tiles, and the other way round."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = "make one .coview file of a directory of tiles, or a directory of a file"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("map", type=Path, metavar="FROM", help="SITE.coview, or the directory of a site")
    parser.add_argument("output", type=Path, metavar="TO", help="the other of them")
    parser.add_argument("--sign", type=Path, metavar="NAME.key", help="sign it with this private key (keygen)")


def run(args: argparse.Namespace) -> int:
    """Convert, and print what became of it."""
    from coview_stream.basemap import file_format
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.signature import SigningKey
    from coview_stream.basemap.site.split import join, split
    from coview_stream.errors import naming_missing_libraries

    key = None if args.sign is None else SigningKey(args.sign)
    with naming_missing_libraries("coview-stream convert", "node"):
        from tqdm import tqdm
    if args.map.is_dir():
        file_format.check_target(args.output)
        with tqdm(desc="converting", unit="step", disable=not sys.stderr.isatty(), leave=False) as bar:

            def step(done: int, total: int) -> None:
                bar.total = total
                bar.update(done - bar.n)

            sha256 = join(args.map, args.output, key, step)
        print(f"{args.output}: {args.output.stat().st_size} bytes, sha256 {sha256[:12]}")
        return 0
    base_map = BaseMap.load(args.map)
    site = split(base_map.arrays, base_map.parameters, args.output, key)
    area = max(1, sum(tile.area for tile in site.tiles))
    print(
        f"{args.output}: {len(site.tiles)} tiles of {site.tile:g} m, {site.nbytes} bytes, "
        f"{site.nbytes / area:.0f} MB per km2; manifest {site.sha256[:12]}"
    )
    return 0
