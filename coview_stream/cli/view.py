"""Views of a session that ``serve`` and ``watch`` open: their options, sinks and feed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.cli.options import host_port
from coview_stream.errors import ConfigError

if TYPE_CHECKING:
    from coview_stream.basemap.summary import MapView
    from coview_stream.stream.node.node import Node
    from coview_stream.stream.node.serve import ServeOptions
    from coview_stream.stream.transport.transport import Transport
    from coview_stream.viewers.scene import Sink
    from coview_stream.viewers.session_feed import SessionFeed, Topic

_WEB = "127.0.0.1:8642"  # as viewers.web_page has it; --help imports nothing
_FOXGLOVE = "127.0.0.1:8765"


def add_web(parser: argparse._ActionsContainer) -> None:
    """Declare ``--web``."""
    parser.add_argument(
        "--web", nargs="?", const=_WEB, type=host_port("--web", _WEB), metavar="HOST:PORT",
        help=f"show map and robots on a web page ({_WEB} if no address is named)",
    )  # fmt: skip


def add_view(parser: argparse._ActionsContainer) -> None:
    """Declare the views that ``serve`` and ``watch`` share."""
    add_web(parser)
    parser.add_argument(
        "--foxglove", nargs="?", const=_FOXGLOVE, type=host_port("--foxglove", _FOXGLOVE), metavar="HOST:PORT",
        help=f"show map and robots in Foxglove ({_FOXGLOVE} if no address is named; extra foxglove)",
    )  # fmt: skip
    parser.add_argument(
        "--record", action="append", default=[], type=Path, metavar="FILE",
        help="record map and robots: F.mcap (extra foxglove), F.rrd (extra viz); repeat for both",
    )  # fmt: skip
    parser.add_argument("--rerun", action="store_true", help="show map and robots in rerun (extra viz)")


def open_sinks(args: argparse.Namespace, closing: ExitStack) -> list[Sink]:
    """Open the requested sinks, and print their addresses; ``closing`` closes them, also if no feed ever does."""
    sinks: list[Sink] = []
    mcap, rrd = ([path for path in args.record if path.suffix == suffix] for suffix in (".mcap", ".rrd"))
    for path in args.record:
        if path not in mcap + rrd:
            raise ConfigError(f"--record {path}: name a file .mcap (Foxglove) or .rrd (rerun)")
    if args.rerun or rrd:
        from coview_stream.viewers.rerun_sink import RerunSink

        for path in [*([None] if args.rerun else []), *rrd]:
            sinks.append(rerun := RerunSink(path))
            closing.callback(rerun.close)
    if args.foxglove is not None or mcap:
        from coview_stream.viewers.foxglove_sink import FoxgloveSink

        sinks.append(foxglove := FoxgloveSink())
        closing.callback(foxglove.close)
        for path in mcap:
            foxglove.record(path)
        if args.foxglove is not None:
            host, _, port = args.foxglove.rpartition(":")
            host = host.strip("[]") or "127.0.0.1"
            port = foxglove.serve(host, int(port))
            print(f"Foxglove at ws://{host}:{port}", file=sys.stderr, flush=True)
    if args.web is not None:
        from coview_stream.viewers.web_page import WebPage

        page = WebPage(args.web)
        closing.callback(page.close)
        print(f"page at {page.url}", file=sys.stderr, flush=True)
        sinks.append(page.sink)
    return sinks


def feed_of_watch(
    args: argparse.Namespace, transport: Transport, sinks: Sequence[Sink], view: MapView | None, topics: Sequence[Topic]
) -> SessionFeed | None:
    """Return a running feed of the topics that ``watch`` shows; None without sinks."""
    if not sinks:
        return None
    from coview_stream.viewers.session_feed import SessionFeed, asked_of_node

    source = None if view is not None else asked_of_node(transport, args.base)
    return _running(SessionFeed(transport, topics, view, source, clouds=not args.no_clouds), sinks)


def feed_of_node(node: Node, options: ServeOptions, sinks: Sequence[Sink]) -> SessionFeed | None:
    """Return a running feed of a node in this process, on the node's own session; None without sinks."""
    if not sinks:
        return None
    from coview_stream.viewers.session_feed import SessionFeed, read_from_files, topics_of_robots

    source = read_from_files(node.map_files, lambda: node.map_sha256)
    topics = topics_of_robots(options.keys, options.codecs.cloud)
    feed = SessionFeed(node.transport, topics, None, source, mount=options.node.mount, policy="newest")
    return _running(feed, sinks)


def _running(feed: SessionFeed, sinks: Sequence[Sink]) -> SessionFeed:
    for sink in sinks:
        feed.add(sink)
    feed.start()
    return feed
