"""Processes of the engines, which may be started before anything is known of map and robots.

A child imports its libraries and loads its kernels first, which takes most of its start, and only then asks its pipe
what to open: meanwhile the parent reads options, checks the map and opens the network. It is started anew rather than
forked or spawned by multiprocessing: a fork after zenoh has been opened deadlocks, and a spawn would import the host's
main module.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NamedTuple

from coview_stream.clouds.python_child import python_command, python_environment

if TYPE_CHECKING:
    from coview_stream.basemap.signature import Trust

NICE = {"odometry": 2, "track": 4, "search": 10}
"""Niceness of the engines, which stand back: the pose clock and the receiving threads are in the parent. Every pose
waits for odometry. Set by hand."""


class Opening(NamedTuple):
    """What an engine is to be opened with; as it was given, to be checked by the engine.

    Attributes:
        map_path: the map's file.
        sha256: of the map.
        registration: method of registration.
        reloc: recognizers that propose the places to search at.
        risk: probability of a wrong place below which a search gives one.
        sensor_leans: whether sensors may lean against odometry's gravity.
        trust: demands that the map is signed; None takes any.
    """

    map_path: str
    sha256: str
    registration: str
    reloc: str
    risk: float
    sensor_leans: bool = True
    trust: Trust | None = None


class EngineChild:
    """A process of :mod:`coview_stream.stream.node.worker` that waits for its :class:`Opening`.

    Args:
        kind: ``track``, ``search`` or ``odometry``.
        nice: added to its niceness; None for that of its kind.
    """

    def __init__(self, kind: str, nice: int | None = None) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                python_command("coview_stream.stream.node.worker", str(theirs.fileno()), kind,
                               str(NICE[kind] if nice is None else nice)),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=_environment(kind),
                start_new_session=True,  # an interrupt at the terminal is for the parent to pass on
            )  # fmt: skip
        self._pipe = Connection(ours.detach())
        self._taken = False

    def take(self) -> tuple[subprocess.Popen[bytes], Connection]:
        """Return the process and the pipe to it, which are the caller's from now on."""
        self._taken = True
        return self._process, self._pipe

    def close(self) -> None:
        """Kill the process unless it has been taken."""
        if not self._taken:
            self._taken = True
            end(self._process, self._pipe)


def start_children(lidar_odometry: bool) -> dict[str, EngineChild]:
    """Start the engines of a node; that of odometry, whose library may be missing, comes first."""
    return {kind: EngineChild(kind) for kind in NICE if lidar_odometry or kind != "odometry"}


def end(process: subprocess.Popen[bytes] | None, pipe: Connection | None) -> None:
    """Kill a child, which keeps nothing that would have to be saved, and close the pipe to it."""
    if process is not None:
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=1.0)
    if pipe is not None:
        with contextlib.suppress(OSError):
            pipe.close()


def _environment(kind: str) -> dict[str, str]:
    """Return our environment, with this package in reach and threads so few that engines leave each other the cores.

    BLAS has one. The kernels and networks of searches have all cores but one, unless ``COVIEW_THREADS`` says otherwise:
    they are always busy where a robot is off the map, and what has deadlines needs a core that is free.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = {"COVIEW_THREADS": str(max(1, cores - 1))} if kind == "search" else {}
    ours = {name: value for name, value in python_environment().items() if name != "NOTIFY_SOCKET"}  # the node notifies
    return threads | ours | {"OPENBLAS_NUM_THREADS": "1"}
