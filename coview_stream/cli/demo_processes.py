"""Processes of the demo: a node, a robot and a watcher on loopback; a pattern for tests of a site."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import TransportError

ROBOT = "demo"

# all set by hand, seconds
_MAX_START = 60.0  # until the node publishes something and can search; a first run compiles its kernels
_MAX_SHUTDOWN = 5.0  # for a process after a signal
_IN_TRANSIT = 0.3  # for the last frame and its pose after the robot has ended


@dataclass
class Recording:
    """Messages that the watcher received, in order.

    Attributes:
        poses: as published, JSON.
        statuses: likewise.
    """

    poses: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)

    def add(self, record: dict[str, Any]) -> None:
        """Append one line of the watcher to the list that its key names."""
        (self.poses if str(record.get("key", "")).endswith("/out/pose") else self.statuses).append(record)


def record_live(
    map_path: Path,
    run_path: Path,
    logs: Path,
    on_record: Callable[[dict[str, Any]], None] = lambda record: None,
    web: str | None = None,
) -> Recording:
    """Serve a map, replay a run to it at its own pace, and record what is published.

    Args:
        map_path: a ``.coview`` file.
        run_path: a run directory.
        logs: directory for the stderr of the three processes.
        on_record: called with every pose and status, as they come.
        web: ``HOST:PORT`` of a web page of the drive; None for none.

    Raises:
        TransportError: a process failed; the message ends with the last line of its log.
    """
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    recording = Recording()
    with contextlib.ExitStack() as stack:

        def start(name: str, *args: str) -> subprocess.Popen[bytes]:
            return stack.enter_context(_process(logs / f"{name}.log", name, *args))

        page = () if web is None else (f"--web={web}",)
        node = start("serve", str(map_path), "--robot", ROBOT, "--listen", endpoint, "--no-state", *page)
        watcher = start("watch", "--json", "--robot", ROBOT, "--connect", endpoint)
        lines = _lines(watcher)
        _await_first(lines, recording, (node, watcher), logs)
        _await_engines(endpoint)
        robot = start("replay", str(run_path), "--robot", ROBOT, "--connect", endpoint)
        while robot.poll() is None or not lines.empty():
            with contextlib.suppress(queue.Empty):
                record = lines.get(timeout=0.1)
                recording.add(record)
                on_record(record)
            if node.poll() is not None or watcher.poll() is not None:
                raise _failure("serve" if node.poll() is not None else "watch", logs)
        if robot.returncode:
            raise _failure("replay", logs)
        time.sleep(_IN_TRANSIT)
        _end(node)
        with contextlib.suppress(queue.Empty):
            while True:
                recording.add(lines.get(timeout=0.5))
    return recording


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def _process(log: Path, *args: str) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as errors:
        process = subprocess.Popen(
            python_command("coview_stream", *args),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if args[0] == "watch" else subprocess.DEVNULL,
            stderr=errors,
            env=python_environment(),
            start_new_session=True,  # this process passes an interrupt at the terminal on
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


def _lines(watcher: subprocess.Popen[bytes]) -> queue.Queue[dict[str, Any]]:
    found: queue.Queue[dict[str, Any]] = queue.Queue()

    def read(stream: IO[bytes]) -> None:
        for line in stream:
            with contextlib.suppress(ValueError):
                found.put(json.loads(line))

    if watcher.stdout is not None:
        threading.Thread(target=read, args=(watcher.stdout,), daemon=True).start()
    return found


def _await_first(
    lines: queue.Queue[dict[str, Any]],
    recording: Recording,
    processes: tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]],
    logs: Path,
) -> None:
    deadline = time.monotonic() + _MAX_START
    while time.monotonic() < deadline:
        with contextlib.suppress(queue.Empty):
            recording.add(lines.get(timeout=0.1))
            return
        for name, process in zip(("serve", "watch"), processes, strict=True):
            if process.poll() is not None:
                raise _failure(name, logs)
    raise TransportError(f"the node has said nothing for {_MAX_START:g} s; see {logs / 'serve.log'}")


def _await_engines(endpoint: str) -> None:
    """Wait until the node's engines can search: on a busy machine the drive would be over before."""
    from coview_stream.stream.transport.keys import node_keys
    from coview_stream.stream.transport.zenoh_transport import open_client

    transport = open_client([endpoint], None, None)
    try:
        deadline = time.monotonic() + _MAX_START
        while time.monotonic() < deadline:
            with contextlib.suppress(TransportError):
                if transport.query(node_keys("coview", ROBOT).ask_health, timeout=2.0)["ready"]["ok"]:
                    return
            time.sleep(0.2)
    finally:
        transport.close()


def _failure(name: str, logs: Path) -> TransportError:
    log = (logs / f"{name}.log").read_text(errors="replace").strip().splitlines()
    return TransportError(f"`coview-stream {name}` ended: {log[-1] if log else 'it said nothing'}")
