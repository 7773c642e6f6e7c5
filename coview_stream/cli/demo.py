"""``coview-stream demo``: the whole path from a laser scan to live poses, without input files or other machines.

A node, a robot and a watcher run as separate processes on the loopback interface.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from coview_stream.cli.options import add_world
from coview_stream.cli.view import add_web
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import ConfigError, TransportError

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.localization.offline import RunResult
    from coview_stream.recordings.run import Run
    from coview_stream.report.evaluation import Evaluation, Trajectory


HELP = "simulate a site and a robot, build the map, localize, compare with the truth; needs no input"

_PICTURES = ("map.png", "trajectory.png", "errors.png", "descriptors.png")
_WRITTEN = (*_PICTURES, "trajectory.tum", "result.json", "report.json")
_STEPS = 4  # of the demo, numbered on stderr


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; names and ranges are checked by SimulationConfig."""
    parser.add_argument("--out", type=Path, default="coview-demo", metavar="DIR", help="folder to write (coview-demo)")
    add_world(parser, 180.0, 40.0)
    parser.add_argument("--offline", action="store_true", help="frames straight from file to localizer, no zenoh")
    add_web(parser)
    parser.epilog = (
        "Runs `serve`, `replay` and `watch` as processes of their own, which talk over zenoh on the loopback "
        "interface; at the robot's own pace. Exit code 0 if the robot was localized rightly, 1 if not."
    )


def run(args: argparse.Namespace) -> int:
    """Run the four steps, write the results, print the errors."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.cli.evaluate import table
    from coview_stream.clouds.atomic_file import atomic_file
    from coview_stream.clouds.trajectory import read_tum
    from coview_stream.recordings.open_run import open_run
    from coview_stream.sim import SimulationConfig, simulate

    if args.web is not None and args.offline:
        raise ConfigError("--offline has no node to show: leave --web away")
    config = SimulationConfig(scene=args.scene, sensor=args.sensor, seed=args.seed, size=args.size, length=args.length)
    out = args.out
    _prepare_folder(out)
    world, shown = out / "world", sys.stderr.isatty()
    seconds: dict[str, float] = {}
    with _step(seconds, "simulate", f"simulating a {args.scene}, {args.size:g} m wide, and a {args.sensor}"):
        simulate(world, config, progress=shown, overwrite=True)
    with _step(seconds, "build", "building the base map"):
        base_map = BaseMap.build(world / "base.laz", progress=shown)
        base_map.save(out / "site.coview")
    seen = "" if args.web is None else f", to be seen at http://{args.web}/"
    with _step(seconds, "locate", f"driving {args.length:g} m without knowing where{seen}"):
        recorded = open_run(world / "run")
        located = _offline(base_map, recorded, shown) if args.offline else _live(recorded, out, shown, args.web)
    with _step(seconds, "report", "comparing with the truth, drawing"):
        evaluation = _write_results(located, base_map, read_tum(world / "truth.tum"), out)
    facts = json.loads(evaluation.to_json()) | {"world": config.to_dict(), "seconds": seconds}
    with atomic_file(out / "report.json") as stream:
        stream.write((json.dumps(facts, indent=1) + "\n").encode())
    print(table(evaluation))
    if located.reason:
        print(f"{'reason':<18} {located.reason}")
    if located.dropped:
        print(f"{'busy':<18} {located.dropped}; odometry carries the pose over some; try demo --offline")
    command = sys.argv[0] if Path(sys.argv[0]).stem == "coview-stream" else "coview-stream"
    names = ("site.coview", "world", *([] if args.offline else ["logs"]), *_WRITTEN)
    print(f"{'written':<18} {out}: {', '.join(name for name in names if (out / name).exists())}")
    print(f"{'step by step':<18} {command} build {world / 'base.laz'} -o site.coview")
    print(f"{'':<18} {command} locate site.coview {world / 'run'} -o out")
    print(f"{'':<18} {command} eval out/trajectory.tum {world / 'truth.tum'}")
    return 0 if evaluation.success else 1


def _prepare_folder(out: Path) -> None:
    """Create the directory, or clear it of an earlier demo; InputError if it has other files or is not writable."""
    from coview_stream.errors import InputError

    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a directory with --out")
    if out.exists() and any(out.iterdir()) and not (out / "world" / "world.json").is_file():
        raise InputError(f"{out}: is not empty and holds no earlier demo; name a new directory with --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in _WRITTEN:  # an old picture would contradict the new result
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); name another with --out") from error


@contextlib.contextmanager
def _step(seconds: dict[str, float], name: str, text: str) -> Iterator[None]:
    """Print on stderr what the block does and, at its end, how long it took; store its seconds by name."""
    number = len(seconds) + 1
    print(f"[{number}/{_STEPS}] {text} ...", file=sys.stderr, flush=True)
    begin = time.perf_counter()
    yield
    seconds[name] = round(time.perf_counter() - begin, 2)
    print(f"[{number}/{_STEPS}] done in {seconds[name]:.1f} s", file=sys.stderr, flush=True)


def _offline(base_map: BaseMap, recorded: Run, shown: bool) -> RunResult:
    """Localize the run without a network, frame by frame."""
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.localization.offline import locate

    with progress_bar("locating", shown, "frame") as bar:
        return locate(base_map, recorded, None, lambda done, total, fix: bar(done, total, fix and fix.state.reported))


def _live(recorded: Run, out: Path, shown: bool, web: str | None) -> RunResult:
    """Serve, replay and watch the run as three processes; return what was published, frame by frame."""
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.localization.offline import from_stream

    stamps = recorded.stamps.tolist()
    with progress_bar("driving", shown, "frame") as bar:

        def show(record: dict[str, Any]) -> None:
            if "counters" in record:
                bar(int(record["counters"]["received"]), len(stamps), str(record["state"]))

        (out / "logs").mkdir(exist_ok=True)
        recorded_live = record_live(out / "site.coview", recorded.path, out / "logs", show, web)
    return from_stream(stamps, *recorded_live)


def _write_results(located: RunResult, base_map: BaseMap, truth: Trajectory, out: Path) -> Evaluation:
    """Write trajectory, evidence and pictures; return the evaluation of the trajectory."""
    from coview_stream.clouds.trajectory import read_tum
    from coview_stream.localization.offline import write
    from coview_stream.report.evaluation import evaluate, frame_errors
    from coview_stream.report.plots import draw_run, plot_errors
    from coview_stream.report.relief import plot_map

    write(located, base_map, out)
    draw_run(located, base_map, out, truth[1][:, :3, 3])
    plot_map(base_map, out / "map.png")
    estimate = read_tum(out / "trajectory.tum")
    errors = frame_errors(estimate, truth)
    plot_errors(errors.distance, errors.e_t, errors.e_r, out / "errors.png")
    return evaluate(estimate, truth)


ROBOT = "demo"

# seconds
_MAX_START = 300.0  # until the node publishes: a first run compiles its kernels; the robot waits for the rest
_MAX_SHUTDOWN = 5.0  # for a process after a signal
_IN_TRANSIT = 0.3  # for the last frame and its pose after the robot has ended


def record_live(
    map_path: Path,
    run_path: Path,
    logs: Path,
    on_record: Callable[[dict[str, Any]], None] = lambda record: None,
    web: str | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Serve a map and replay a run to it at its own pace; return the published poses and statuses, JSON, in order.

    ``logs`` is the directory for the stderr of the three processes, ``on_record`` is called with every pose and status
    on arrival, ``web`` is the ``HOST:PORT`` of a web page of the drive.

    Raises:
        TransportError: a process failed; the message ends with the last line of its log.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    records: list[dict[str, Any]] = []
    lines: queue.Queue[dict[str, Any]] = queue.Queue()

    def read(stream: IO[bytes]) -> None:
        for line in stream:
            with contextlib.suppress(ValueError):
                lines.put(json.loads(line))

    with contextlib.ExitStack() as stack:

        def start(name: str, *args: str) -> subprocess.Popen[bytes]:
            return stack.enter_context(_process(logs / f"{name}.log", name, *args))

        page = () if web is None else (f"--web={web}",)
        node = start("serve", str(map_path), "--robot", ROBOT, "--listen", endpoint, "--no-state", *page)
        watcher = start("watch", "--json", "--robot", ROBOT, "--connect", endpoint)
        if watcher.stdout is not None:
            threading.Thread(target=read, args=(watcher.stdout,), daemon=True).start()
        deadline = time.monotonic() + _MAX_START
        while not records:
            with contextlib.suppress(queue.Empty):
                records.append(lines.get(timeout=0.1))
            _check_running(logs, serve=node, watch=watcher)
            if time.monotonic() > deadline:
                raise TransportError(f"the node has said nothing for {_MAX_START:g} s; see {logs / 'serve.log'}")
        robot = start("replay", str(run_path), "--robot", ROBOT, "--connect", endpoint)
        while robot.poll() is None or not lines.empty():
            with contextlib.suppress(queue.Empty):
                records.append(lines.get(timeout=0.1))
                on_record(records[-1])
            _check_running(logs, serve=node, watch=watcher)
        if robot.returncode:
            _check_running(logs, replay=robot)
        time.sleep(_IN_TRANSIT)
        _end(node)
        with contextlib.suppress(queue.Empty):
            while True:
                records.append(lines.get(timeout=0.5))
    poses: list[dict[str, Any]] = []
    statuses: list[dict[str, Any]] = []
    for record in records:
        (poses if str(record.get("key", "")).endswith("/out/pose") else statuses).append(record)
    return poses, statuses


@contextlib.contextmanager
def _process(log: Path, *args: str) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as errors:
        process = subprocess.Popen(
            python_command("coview_stream", *args),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if args[0] == "watch" else subprocess.DEVNULL,
            stderr=errors,
            env=python_environment(),
            start_new_session=True,  # this process passes on an interrupt at the terminal
        )
        try:
            yield process
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=_MAX_SHUTDOWN)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _check_running(logs: Path, **processes: subprocess.Popen[bytes]) -> None:
    for name, process in processes.items():
        if process.poll() is not None:
            log = (logs / f"{name}.log").read_text(errors="replace").strip().splitlines()
            raise TransportError(f"`coview-stream {name}` ended: {log[-1] if log else 'it said nothing'}")
