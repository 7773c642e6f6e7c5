"""``coview-stream keygen``: a pair of keys that sign and verify maps."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "make a pair of keys to sign maps with (build --sign) and to verify them by (--verify-key)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("name", type=Path, metavar="NAME", help="writes NAME.key (keep it secret) and NAME.pub")


def run(args: argparse.Namespace) -> int:
    """Write both keys and print their use."""
    from coview_stream.basemap.signature import make_keys

    private, public, fingerprint = make_keys(args.name)
    print(f"{private}: signs maps (build --sign); keep it where maps are built, readable by you only")
    print(f"{public}: verifies them (--verify-key of serve, locate, info and fuse); fingerprint {fingerprint}")
    return 0
