"""``coview-stream watch``: live poses as a table, as JSON lines or in a viewer."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import shutil
import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from coview_stream.cli.map_argument import local_map
from coview_stream.cli.options import add_network, add_shared
from coview_stream.cli.view import add_view
from coview_stream.errors import ConfigError, MessageError, counted

if TYPE_CHECKING:
    from coview_stream.cli.process import Stop
    from coview_stream.messages.types import Sample
    from coview_stream.stream.client.fleet_table import FleetTable
    from coview_stream.stream.client.latest_queue import LatestQueue
    from coview_stream.stream.transport.transport import Transport
    from coview_stream.viewers.session_feed import Topic

HELP = "see robots' poses live: a table, JSON lines, or a viewer"

_SILENCE = 3.0  # seconds without a first message until the keys and endpoints are printed
_REDRAW_PERIOD = 0.5  # seconds, on a terminal
_PRINT_PERIOD = 1.0  # seconds, elsewhere
_MAX_QUEUED = 10_000  # samples that wait for a slow reader of our output
_MAX_BYTES = 16_384  # of one sample: statuses have 3,500
_LINES_APART = 10.0  # seconds between lines about unreadable messages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--robot", nargs="+", action="extend", metavar="NAME", help="robots (default: all of the base)")
    add_network(parser)
    add_shared(parser, "--preset", "--json")
    add_view(parser)
    parser.add_argument("--map", metavar="SITE", help="map to show, path or address (default: the node's)")
    parser.add_argument("--no-clouds", action="store_true", help="show no scans: clouds are most of the traffic")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after S seconds (default: at a signal)")


def run(args: argparse.Namespace) -> int:
    """Subscribe and show, until a signal or for the given time."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.summary import MapView
    from coview_stream.cli.process import stop_on_signals
    from coview_stream.cli.view import feed_of_watch, open_sinks
    from coview_stream.stream.client.fleet_table import FleetTable
    from coview_stream.stream.transport.zenoh_transport import open_client

    if args.seconds is not None and not args.seconds > 0:
        raise ConfigError(f"--seconds {args.seconds!r}: give a number above 0")
    topics = _topics(args)
    view = None
    if args.map is not None:
        shown = local_map(args.map, base=args.base, connect=args.connect, config=args.zenoh_config)
        view = MapView.of(BaseMap.load(shown.path, check=False))
    with contextlib.ExitStack() as closing:
        sinks = open_sinks(args, closing)
        transport = open_client(args.connect, args.listen, args.zenoh_config)
        closing.callback(transport.close)
        stop = closing.enter_context(stop_on_signals())
        if (feed := feed_of_watch(args, transport, sinks, view, topics)) is not None:
            closing.callback(feed.close)
        watch = _Watch(args, FleetTable(), [t for t in topics if t.kind in ("pose", "status")], transport)
        watch.run(stop, None if args.seconds is None else time.monotonic() + args.seconds)
    return 0


def _topics(args: argparse.Namespace) -> list[Topic]:
    from coview_stream.stream.transport.keys import robot_keys
    from coview_stream.viewers.session_feed import topics_of_base, topics_of_robots

    if args.robot:
        return topics_of_robots([robot_keys(args.preset, args.base, name) for name in dict.fromkeys(args.robot)])
    if args.preset != "native":
        raise ConfigError(f"--preset {args.preset} has no key for all robots' poses: name them with --robot")
    return topics_of_base(args.base)


class _Watch:
    """Display of samples on this thread; the network's threads deliver them."""

    def __init__(self, args: argparse.Namespace, fleet: FleetTable, topics: list[Topic], transport: Transport) -> None:
        from coview_stream.stream.client.latest_queue import LatestQueue

        self._args, self._fleet, self._topics = args, fleet, topics
        self._transport = transport
        self._queue: LatestQueue[tuple[float, Topic, Sample]] = LatestQueue(_MAX_QUEUED)
        self._terminal = sys.stdout.isatty() and not args.json
        self._lines_drawn = 0  # of the table
        self._unreadable = 0  # messages since the last line about one
        self._next_line = 0.0  # time on the monotonic clock
        for topic in topics:
            transport.subscribe(topic.key, functools.partial(self._receive, topic), "all")

    def run(self, stop: Stop, end: float | None) -> None:
        """Show samples until told to stop, or until ``end`` on the monotonic clock."""
        period = _REDRAW_PERIOD if self._terminal else _PRINT_PERIOD
        started = time.monotonic()
        redraw, silent_until, heard = started + period, started + _SILENCE, False
        while not stop.requested and (end is None or time.monotonic() < end):
            item = self._queue.get(timeout=0.1)
            if item is not None:
                heard = True
                self._show(*item)
            now = time.monotonic()
            if not heard and now > silent_until:
                self._print_silence()
                silent_until = float("inf")
            if now >= redraw and not self._args.json:
                self._draw(now)
                redraw = now + period
        if self._queue.dropped:
            print(f"{self._queue.dropped} messages were not shown: the output is too slow", file=sys.stderr)

    def _receive(self, topic: Topic, sample: Sample) -> None:
        if len(sample.payload) > _MAX_BYTES:
            sample = replace(sample, payload=b"", attachment=None)
        self._queue.put((time.monotonic(), topic, sample))

    def _show(self, arrived: float, topic: Topic, sample: Sample) -> None:
        from coview_stream.errors import printable
        from coview_stream.messages import decode_pose
        from coview_stream.messages.json_messages import pose_record, read_status

        robot = topic.robot or sample.key.split("/")[topic.depth]
        try:
            if topic.kind == "pose":
                pose = replace(decode_pose(sample, hint=topic.hint), robot=robot)
                self._fleet.add_pose(pose, arrived)
                record = pose_record(pose, sample)
            else:
                record = read_status(sample)
                self._fleet.add_status(robot, record, arrived)
        except MessageError as error:
            self._unreadable += 1
            if arrived >= self._next_line:
                more = f" ({self._unreadable - 1} more since the last line)" if self._unreadable > 1 else ""
                print(f"cannot be read: {printable(error)}{more}", file=sys.stderr)
                self._unreadable, self._next_line = 0, arrived + _LINES_APART
            return
        if self._args.json:
            print(json.dumps({"key": sample.key, **record}), flush=True)

    def _draw(self, now: float) -> None:
        if not self._terminal:
            if not self._fleet.views:
                return
            for line in self._fleet.table(now, header=not self._lines_drawn):  # titles once
                print(line, flush=True)
            self._lines_drawn = 1
            return
        size = shutil.get_terminal_size()
        lines = self._fleet.table(now, width=size.columns - 1)[: max(2, size.lines - 1)]
        back = f"\x1b[{self._lines_drawn}F" if self._lines_drawn else ""
        print(f"{back}\x1b[J" + "\n".join(lines), flush=True)
        self._lines_drawn = len(lines)

    def _print_silence(self) -> None:
        """Print the keys, connections and endpoints from which nothing has come."""
        from coview_stream.stream.transport.zenoh_transport import DEFAULT_ENDPOINT

        connection = self._transport.connection()
        count = len(connection.routers) + len(connection.peers)
        connected = f"connected to {counted(count, 'program')}" if count else "not connected"
        at = ", ".join(self._args.connect or self._args.listen or [str(self._args.zenoh_config or DEFAULT_ENDPOINT)])
        keys = ", ".join(topic.key for topic in self._topics)
        print(f"nothing yet on {keys}; {connected} ({at})", file=sys.stderr, flush=True)
