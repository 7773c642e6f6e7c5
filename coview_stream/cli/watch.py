"""``coview-stream watch``: see poses live, as a table, as JSON lines or in a viewer."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coview_stream.errors import ConfigError, MessageError

if TYPE_CHECKING:
    from coview_stream.cli.signals import Stop
    from coview_stream.messages.types import PoseMessage, Sample
    from coview_stream.stream.client.client import LatestQueue
    from coview_stream.stream.client.fleet import FleetTable
    from coview_stream.stream.transport.transport import Transport

HELP = "see robots' poses live: a table, JSON lines, or a viewer"

_PATIENCE = 3.0  # seconds without a message after which watch says where it is listening
_REDRAW = 0.5  # seconds, on a terminal
_LINE = 1.0  # seconds between lines where there is none
_KEPT = 10_000  # samples waiting for a slow reader of our output


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--robot", nargs="+", action="extend", metavar="NAME", help="(all robots of the base)"
    )
    parser.add_argument(
        "--connect", action="append", metavar="EP", help="endpoint to connect to (tcp/127.0.0.1:7447)"
    )
    parser.add_argument("--listen", action="append", metavar="EP", help="endpoint to be connected to on")
    parser.add_argument("--config", type=Path, metavar="FILE", help="zenoh configuration, JSON5")
    parser.add_argument("--base", default="coview", help="first part of the keys (coview)")
    parser.add_argument(
        "--preset", default="native", help="native, ros2dds, rmw_zenoh or keelson; needs --robot (native)"
    )
    parser.add_argument("--json", action="store_true", help="print every pose and status as one line of JSON")
    parser.add_argument("--rerun", action="store_true", help="show poses in the rerun viewer (extra: viz)")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after this long (at a signal)")


def run(args: argparse.Namespace) -> int:
    """Subscribe and show, until a signal or the time is over."""
    from coview_stream.cli.signals import stop_on_signals
    from coview_stream.stream.client.fleet import FleetTable
    from coview_stream.stream.transport.rpc import open_client

    if args.seconds is not None and not args.seconds > 0:
        raise ConfigError(f"--seconds {args.seconds!r}: give a number above 0")
    sources = _sources(args)
    show_pose = _viewer() if args.rerun else lambda pose: None
    transport = open_client(args.connect, args.listen, args.config)
    try:
        with stop_on_signals() as stop:
            watch = _Watch(args, FleetTable(), sources, show_pose, transport)
            watch.until(stop, None if args.seconds is None else time.monotonic() + args.seconds)
    finally:
        transport.close()
    return 0


class _Source:
    """What one key expression carries, and how to read it."""

    def __init__(self, key: str, poses: bool, robot: str | None = None, hint: str | None = None) -> None:
        self.key, self.poses, self.robot, self.hint = key, poses, robot, hint


def _sources(args: argparse.Namespace) -> list[_Source]:
    from coview_stream.stream.transport.key_expressions import check_prefix
    from coview_stream.stream.transport.keys import robot_keys

    if args.robot:
        keys = [robot_keys(args.preset, args.base, name) for name in dict.fromkeys(args.robot)]
        poses = [_Source(k.pose, True, k.robot, k.pose_hint) for k in keys]
        return poses + [_Source(k.status, False, k.robot) for k in keys]
    if args.preset != "native":
        raise ConfigError(f"--preset {args.preset} has no key for all robots' poses: name them with --robot")
    base = check_prefix(args.base, "--base")
    return [_Source(f"{base}/*/out/pose", True), _Source(f"{base}/*/out/status", False)]


def _viewer() -> Callable[[PoseMessage], None]:
    from coview_stream.report.viewer import PoseViewer

    return PoseViewer().show


class _Watch:
    """Takes samples from the network's threads and shows them on this one."""

    def __init__(
        self,
        args: argparse.Namespace,
        fleet: FleetTable,
        sources: list[_Source],
        show_pose: Callable[[PoseMessage], None],
        transport: Transport,
    ) -> None:
        from coview_stream.stream.client.client import LatestQueue

        self._args, self._fleet, self._sources = args, fleet, sources
        self._show_pose, self._transport = show_pose, transport
        self._box: LatestQueue[tuple[float, _Source, Sample]] = LatestQueue(_KEPT)
        self._terminal = sys.stdout.isatty() and not args.json
        self._drawn = 0  # lines of the table on the terminal
        self._complained: set[str] = set()
        self._depth = len(args.base.split("/"))
        for source in sources:
            transport.subscribe(source.key, self._receiver(source), "all")

    def until(self, stop: Stop, end: float | None) -> None:
        """Show until told to stop, or until ``end`` on the steady clock."""
        period = _REDRAW if self._terminal else _LINE
        started = time.monotonic()
        redraw, patience, heard = started + period, started + _PATIENCE, False
        while not stop.requested and (end is None or time.monotonic() < end):
            item = self._box.get(timeout=0.1)
            if item is not None:
                heard = True
                self._take(*item)
            now = time.monotonic()
            if not heard and now > patience:
                self._say_where()
                patience = float("inf")
            if now >= redraw and not self._args.json:
                self._draw(now)
                redraw = now + period
        if self._box.dropped:
            print(f"{self._box.dropped} messages were not shown: the output is too slow", file=sys.stderr)

    def _receiver(self, source: _Source) -> Callable[[Sample], None]:
        return lambda sample: self._box.put((time.monotonic(), source, sample))

    def _take(self, arrived: float, source: _Source, sample: Sample) -> None:
        try:
            record = (
                self._pose(arrived, source, sample) if source.poses else self._status(arrived, source, sample)
            )
        except MessageError as error:
            if sample.key not in self._complained:  # once per key: it would come ten times a second
                self._complained.add(sample.key)
                print(f"cannot be read: {error}", file=sys.stderr)
            return
        if self._args.json:
            print(json.dumps({"key": sample.key, **record}), flush=True)

    def _pose(self, arrived: float, source: _Source, sample: Sample) -> dict[str, Any]:
        from coview_stream.messages import decode_pose
        from coview_stream.messages.json_messages import pose_record

        pose = replace(decode_pose(sample, hint=source.hint), robot=self._name(source, sample))
        self._fleet.add_pose(pose, arrived)
        self._show_pose(pose)
        return pose_record(pose, sample)

    def _status(self, arrived: float, source: _Source, sample: Sample) -> dict[str, Any]:
        from coview_stream.messages.json_messages import read_status

        status = read_status(sample)
        self._fleet.add_status(self._name(source, sample), status, arrived)
        return status

    def _name(self, source: _Source, sample: Sample) -> str:
        return source.robot or sample.key.split("/")[self._depth]

    def _draw(self, now: float) -> None:
        if not self._terminal:
            for line in self._fleet.table(now, header=False):
                print(line, flush=True)
            return
        width = shutil.get_terminal_size().columns
        lines = [line[: width - 1] for line in self._fleet.table(now)]
        back = f"\x1b[{self._drawn}F" if self._drawn else ""
        print(f"{back}\x1b[J" + "\n".join(lines), flush=True)
        self._drawn = len(lines)

    def _say_where(self) -> None:
        connection = self._transport.connection()
        count = len(connection.routers) + len(connection.peers)
        whom = f"connected to {count} other(s)" if count else "connected to nobody"
        at = ", ".join(self._args.connect or self._args.listen or [str(self._args.config or "")])
        keys = ", ".join(source.key for source in self._sources)
        print(f"nothing yet on {keys}; {whom} ({at or _default()})", file=sys.stderr, flush=True)


def _default() -> str:
    from coview_stream.stream.transport.rpc import DEFAULT_ENDPOINT

    return DEFAULT_ENDPOINT
