"""``coview-stream serve-map``: serves directories of sites to nodes that fetch them over zenoh."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from coview_stream.cli.options import add_network, add_shared
from coview_stream.errors import ConfigError

MAP_SERVER_ENDPOINT = "tcp/127.0.0.1:7448"  # as stream.maps.fetch_map has it; --help imports nothing

HELP = "serve maps (directories of tiles) to nodes, over zenoh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("directories", nargs="+", type=Path, metavar="SITE/", help="directories of tiles")
    parser.add_argument("--name", help="name of the site in its keys (the directory's name)")
    add_network(parser, f"--listen {MAP_SERVER_ENDPOINT}")
    add_shared(parser, "--quiet")


def run(args: argparse.Namespace) -> int:
    """Serve until a signal comes; then exit code 0."""
    import logging

    from coview_stream.cli.process import start_logging, stop_on_signals
    from coview_stream.stream.maps.map_server import MapServer
    from coview_stream.stream.maps.zenoh_source import MapKeys

    start_logging(logging.ERROR if args.quiet else logging.INFO, False)
    if args.name is not None and len(args.directories) > 1:
        raise ConfigError("--name names one site: serve one directory, or leave it out")
    names = [args.name or directory.resolve().name for directory in args.directories]
    if len(set(names)) < len(names):
        raise ConfigError(f"two directories are called {next(n for n in names if names.count(n) > 1)}; rename one")
    keys = [MapKeys.of(name, args.base) for name in names]
    by_default = not (args.connect or args.listen or args.zenoh_config)
    listen = [MAP_SERVER_ENDPOINT] if by_default else args.listen
    with contextlib.ExitStack() as opened, stop_on_signals() as stop:
        for number, (directory, each) in enumerate(zip(args.directories, keys, strict=True)):
            # one session listens, and the others connect to it
            server = MapServer(
                directory, each, args.connect or ([] if number == 0 else listen), listen if number == 0 else [],
                args.zenoh_config,
            )  # fmt: skip
            opened.callback(server.close)
            site = server.manifest
            where = ", ".join([*args.connect, *listen]) or str(args.zenoh_config)
            print(
                f"{each.prefix}: {directory}, {len(site.tiles)} tiles, {site.nbytes / 1e6:.1f} MB, manifest "
                f"{site.sha256[:12]}; at {where}",
                flush=True,
            )
        while not stop.wait(60.0):
            pass
    return 0
