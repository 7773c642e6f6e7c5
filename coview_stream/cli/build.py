"""``coview-stream build``: a base map file of one or many clouds."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

HELP = "build a base map file from one or many clouds of the same frame"

_OPTIONS: dict[str, tuple[Any, str]] = {
    "block_size": (float, "edge of the station grid, metres (2)"),
    "radius": (float, "radius of the virtual scans, metres (50; preset tls: 100)"),
    "voxel": (float, "edge of the stored cloud's voxels, metres (0.25)"),
    "rings": (int, "rings of the descriptor (20)"),
    "sectors": (int, "sectors of the descriptor (60)"),
}
_FIELDS = {"block_size": "block"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    kinds = "las, laz, e57, ply, pcd, xyz, pts, npy, bin"
    parser.add_argument(
        "maps", nargs="+", type=Path, metavar="MAP", help=f"clouds ({kinds}), folders or patterns of them"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="SITE.coview")
    parser.add_argument("--preset", choices=("slam", "tls"), default="slam", help="tls: for terrestrial scans")
    for name, (kind, text) in _OPTIONS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar="N", help=text)
    parser.add_argument("--channels", metavar="A,B", help="descriptor channels that vote (scan_context,coview)")
    parser.add_argument(
        "--learned",
        action=argparse.BooleanOptionalAction,
        help="store features for learned re-localization, 35 MB per km2 (they are, where onnxruntime can be loaded)",
    )
    parser.add_argument("--crs", metavar="EPSG:N", help="reference system of clouds that state none, metres")
    parser.add_argument("--sign", type=Path, metavar="NAME.key", help="sign the map with this private key (keygen)")
    parser.add_argument("--progress", action="store_true", help="draw progress bars even without a terminal")


def run(args: argparse.Namespace) -> int:
    """Build and save the map, and print its sizes."""
    import time

    from coview_stream.basemap import file_format
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.signature import SigningKey
    from coview_stream.basemap.summary import summary
    from coview_stream.errors import MapError, warn

    if args.output.resolve() in [path.resolve() for path in args.maps]:
        raise MapError(f"{args.output}: is one of the scans to read; give the map another name")
    file_format.check_target(args.output)
    key = None if args.sign is None else SigningKey(args.sign)  # before anything slow
    options = {_FIELDS.get(n, n): getattr(args, n) for n in _OPTIONS if getattr(args, n) is not None}
    if args.channels is not None:
        options["channels"] = tuple(name.strip() for name in args.channels.split(","))
    options["learned"] = _networks_available() if args.learned is None else args.learned
    begin = time.perf_counter()
    base_map = BaseMap.build(
        args.maps, args.preset, progress=args.progress or sys.stderr.isatty(), crs=args.crs, **options
    )
    base_map.save(args.output, key)
    print(
        f"{args.output}: {base_map.parameters['source_points']} points read, {len(base_map.points)} kept, "
        f"{len(base_map)} stations, {time.perf_counter() - begin:.1f} s, {args.output.stat().st_size} bytes"
        + ("" if key is None else f", signed with {key.fingerprint}")
    )
    covered = summary(base_map)
    for warning in covered.warnings:
        warn(warning)
    print(covered)
    return 0


def _networks_available() -> bool:
    """Return whether features can be made; if not, print why: the user may rely on them."""
    from coview_stream.descriptors.network import VIEW_NAMES, network
    from coview_stream.errors import CoViewError

    try:
        for view in VIEW_NAMES:
            network(view)
    except CoViewError as error:
        print(f"without learned features: {' '.join(str(error).split())}", file=sys.stderr)
        return False
    return True
