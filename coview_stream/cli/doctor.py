"""``coview-stream doctor``: checks of the machine, a map, the network and what robots send."""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import sys
from collections.abc import Generator, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.cli.map_argument import add_map, local_map
from coview_stream.cli.options import add_network, add_shared, check_codec, mount_of
from coview_stream.errors import ConfigError, CoViewError, TransportError, counted

if TYPE_CHECKING:
    from coview_stream.doctor.finding import Finding
    from coview_stream.doctor.network_checks import Heard
    from coview_stream.stream.transport.keys import RobotKeys

HELP = "check this machine, a map, the network and the robots' messages, with a remedy for each finding"

_MAX_SECONDS = 600.0  # to listen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; keys and encodings are those of ``serve``."""
    add_map(parser, optional=True)
    parser.add_argument("--robot", nargs="+", action="extend", metavar="NAME", help="robots to listen to")
    recorded = parser.add_argument_group("a recorded run")
    recorded.add_argument(
        "--run", type=Path, dest="run_path", metavar="RUN", help="recorded run to judge, and to search for on the map"
    )
    recorded.add_argument("--odometry", default="auto", metavar="auto|FILE|kiss-icp", help="as for locate (auto)")
    add_shared(recorded, "--cloud-delay", "--cloud-topic", "--odometry-topic")
    add_shared(parser, "--mount")
    add_network(parser, "not checked, but with --robot --connect tcp/127.0.0.1:7447")
    parser.add_argument("--seconds", type=float, default=3.0, metavar="S", help="seconds to listen to robots (3)")
    keys = parser.add_argument_group("keys and encodings, as for serve")
    add_shared(keys, "--preset")
    keys.add_argument("--domain", type=int, default=0, help="ROS domain id, for rmw_zenoh (0)")
    keys.add_argument("--cloud-key", metavar="KEY", help="key of clouds (the preset's)")
    keys.add_argument("--odometry-key", metavar="KEY", help="key of odometry (the preset's)")
    keys.add_argument("--cloud-encoding", metavar="CODEC", help="encoding of all clouds")
    keys.add_argument("--odometry-encoding", metavar="CODEC", help="encoding of all odometry")
    add_shared(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Print a line per finding; exit code 1 if something will not work."""
    from coview_stream.doctor.finding import failed

    keys = _robot_keys(args)
    mount_of(args)  # before anything slow
    findings: list[Finding] = []
    for finding in _findings(args, keys):
        findings.append(finding)
        if not args.json:
            print(finding.line(), flush=True)  # the next finding may take seconds
    if args.json:
        print(json.dumps({"format": 1, "findings": [finding.to_json() for finding in findings]}, indent=1))
    else:
        print(_conclusion(findings, args))
    return 1 if failed(findings) else 0


def _conclusion(findings: list[Finding], args: argparse.Namespace) -> str:
    """Return the last line: no problem and with whom, or how many problems and warnings, and the page about them."""
    problems, warnings = (sum(finding.verdict == verdict for finding in findings) for verdict in ("FAIL", "warn"))
    if not problems + warnings:
        asked = {"the map": args.map, "the run": args.run_path, "the robots": args.robot}
        checked = ", ".join(["this machine", *(name for name, given in asked.items() if given)])
        clouds = args.run_path or args.robot
        more = "a delay or a wrong mount shows only in turns" if clouds else "clouds were not checked: --robot, --run"
        return f"no problem found with {checked} ({more})"
    counts = [counted(count, kind) for count, kind in ((problems, "problem"), (warnings, "warning")) if count]
    return f"{', '.join(counts)}; symptoms and remedies: `coview-stream help reasons`"


def _robot_keys(args: argparse.Namespace) -> list[RobotKeys]:
    """Return the keys of the robots to listen to; ConfigError for a wrong option, with or without robots."""
    from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS
    from coview_stream.stream.transport.keys import robot_keys

    if not 0 < args.seconds <= _MAX_SECONDS:
        raise ConfigError(f"--seconds {args.seconds!r}: give a number above 0, {_MAX_SECONDS:g} at most")
    check_codec("--cloud-encoding", args.cloud_encoding, CLOUD_CODECS)
    check_codec("--odometry-encoding", args.odometry_encoding, ODOMETRY_CODECS)
    names = dict.fromkeys(args.robot or ["any"])  # at least one robot, to check the keys
    keys = [
        robot_keys(args.preset, args.base, name, args.cloud_key, args.odometry_key, None, args.domain) for name in names
    ]
    return keys if args.robot else []


def _findings(args: argparse.Namespace, keys: list[RobotKeys]) -> Iterator[Finding]:
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.config import LocalizerConfig
    from coview_stream.doctor.finding import Finding, from_error
    from coview_stream.doctor.machine_checks import machine_findings, memory
    from coview_stream.doctor.map_checks import map_findings, open_map, run_findings
    from coview_stream.recordings.open_run import STAMPS, open_run
    from coview_stream.stream.transport.zenoh_config import compose
    from coview_stream.stream.transport.zenoh_transport import DEFAULT_ENDPOINT

    connect = None  # no network checks were requested
    if args.robot or args.connect or args.listen or args.zenoh_config:
        connect = args.connect or ([] if args.listen or args.zenoh_config else [DEFAULT_ENDPOINT])
    zenoh = connect is not None and importlib.util.find_spec("zenoh") is not None  # a finding if it is missing
    if connect is not None and zenoh:
        compose(connect, args.listen, args.zenoh_config)  # reports mistakes before anything slow
    # listen first: the robot may stop during the other checks, which take seconds
    heard = (yield from _listen(args, connect, keys)) if connect is not None and zenoh else None
    yield from machine_findings()
    sha256 = base_map = None
    if args.map is not None:
        try:
            path = local_map(
                args.map, args.around, base=args.base, connect=args.connect or (), config=args.zenoh_config
            ).path
        except CoViewError as error:
            finding = from_error("map", error)
        else:
            base_map, finding = open_map(path)
        yield finding
        if base_map is not None:
            sha256 = base_map.sha256
            yield from map_findings(base_map, base_map.nbytes, memory()[1])
    if args.run_path is not None:
        given = args.odometry, args.cloud_topic, args.odometry_topic
        try:
            recorded = open_run(args.run_path, *given, mount=mount_of(args))
        except CoViewError as error:
            yield from_error("run", error)
        else:
            notes = (note.removeprefix(f"{recorded.path}: ") for note in recorded.notes)
            yield from (Finding("ok", "recording", note) for note in notes if not note.startswith(STAMPS))
            config = LocalizerConfig(cloud_delay=args.cloud_delay or 0.0)
            drawn = sys.stderr.isatty() and importlib.util.find_spec("tqdm") is not None
            with progress_bar("judging", unit="frame") if drawn else nullcontext() as follow:
                yield from run_findings(recorded, base_map, config, follow)
    if heard is not None:
        from coview_stream.doctor.network_checks import robots_findings

        yield from robots_findings(heard, sha256, mount_of(args))


def _listen(
    args: argparse.Namespace, connect: list[str], keys: list[RobotKeys]
) -> Generator[Finding, None, Heard | None]:
    """Yield the finding on the connection, and return the messages heard; None without a connection."""
    from coview_stream.doctor.finding import from_error
    from coview_stream.doctor.network_checks import connection_finding, listen
    from coview_stream.stream.transport.zenoh_transport import open_transport

    logger = logging.getLogger("coview_stream.stream")
    before = logger.level
    logger.setLevel(logging.CRITICAL)  # errors that the transport would log are findings here
    try:
        transport = open_transport(connect, args.listen, args.zenoh_config)
    except TransportError as error:
        yield from_error("network", error)
        return None
    finally:
        logger.setLevel(before)
    try:
        connected = connection_finding(transport, connect)
        yield connected
        if connected.verdict == "FAIL":
            return None
        return listen(transport, keys, args.seconds, (args.cloud_encoding, args.odometry_encoding))
    finally:
        transport.close()
