"""A lane to an engine: in this process, or in a process of its own that is started again when it dies.

Native code (registration, BLAS, tree building) may hold the interpreter lock for long; a process of its own is the only
thing that keeps the pose clock of this one steady. The child is started anew rather than forked or spawned by
multiprocessing: a fork after zenoh has been opened deadlocks, and a spawn would import the host's main module.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Any, Protocol

from coview_stream.errors import CoViewError
from coview_stream.search import Verdict
from coview_stream.stream.engine import Engine
from coview_stream.stream.jobs import FrameJob, FrameResult, SearchJob

Job = FrameJob | SearchJob
Result = FrameResult | Verdict


class RejectedError(Exception):
    """The engine could not use a job; its robot's state is as before."""


class FailedError(Exception):
    """The engine failed at a job; it has forgotten the job's robot."""


class DiedError(Exception):
    """The engine's process died or hung; it has forgotten all robots."""


class Lane(Protocol):
    """Runs jobs one at a time. Raises RejectedError, FailedError or DiedError."""

    def run(self, job: Job) -> Result:
        """Do one job and wait for it."""
        ...

    def close(self) -> None:
        """End the engine; a job under way raises DiedError."""
        ...


class InlineLane:
    """Runs jobs on the caller's thread."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def run(self, job: Job) -> Result:
        """Do one job."""
        kind, value = attempt(self.engine, job)
        return unwrap(kind, value)

    def close(self) -> None:
        """Nothing to end."""


class ProcessLane:
    """Runs jobs in a child process.

    Args:
        kind: ``track`` or ``search``.
        map_path: the map's file, which every process maps for itself.
        sha256: what the map has to be; if the file was replaced meanwhile, poses would be of another map than is said.
        nice: how far the child stands back from us, so that the clock here is never late.
        patience: seconds after which a job counts as hung.
    """

    def __init__(self, kind: str, map_path: str, sha256: str, nice: int = 0, patience: float = 30.0) -> None:
        self.kind = kind
        self.map_path = map_path
        self.sha256 = sha256
        self.nice = nice
        self.patience = patience
        self._closed = False
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._fresh = False

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        return self._child.pid if self._child else None

    def start(self) -> None:
        """Start the child without waiting until it is ready."""
        with self._lock:
            if self._closed:
                raise DiedError(f"the {self.kind} engine has been closed")
            ours, theirs = socket.socketpair()
            with theirs:
                self._child = subprocess.Popen(
                    [sys.executable, "-m", "coview_stream.stream.worker", str(theirs.fileno()), self.kind,
                     self.map_path, self.sha256, str(self.nice)],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    env=_environment(),
                    start_new_session=True,  # an interrupt at the terminal is for us to pass on
                )  # fmt: skip
            self._pipe = Connection(ours.detach())
            self._fresh = True

    def wait_ready(self) -> None:
        """Wait until the child has opened the map.

        Raises:
            CoViewError: it could not, and says why. DiedError: it died.
        """
        kind, value = self._receive()
        self._fresh = False
        if kind == "error":
            raise CoViewError(value)

    def run(self, job: Job) -> Result:
        """Do one job; a child that died before is started again first."""
        if self._pipe is None:
            self.start()
        if self._fresh:
            try:
                self.wait_ready()
            except CoViewError as error:
                self._end()
                raise DiedError(str(error)) from error
        try:
            assert self._pipe is not None
            self._pipe.send(job)
        except (OSError, AttributeError, AssertionError) as error:
            self._end()
            raise DiedError(f"the {self.kind} engine died") from error
        return unwrap(*self._receive())

    def close(self) -> None:
        """End the child at once; it keeps nothing that would have to be saved."""
        with self._lock:
            self._closed = True
        self._end()

    def _receive(self) -> tuple[str, Any]:
        pipe = self._pipe
        try:
            if pipe is None:
                raise EOFError
            if not pipe.poll(self.patience):
                raise DiedError(f"the {self.kind} engine has not answered for {self.patience:g} s")
            kind, value = pipe.recv()
            return str(kind), value
        except DiedError:
            self._end()
            raise
        except (EOFError, OSError) as error:
            self._end()
            raise DiedError(f"the {self.kind} engine died") from error

    def _end(self) -> None:
        with self._lock:
            child, self._child = self._child, None
            pipe, self._pipe = self._pipe, None
        if child is not None:
            child.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=1.0)
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


def attempt(engine: Engine, job: Job) -> tuple[str, Any]:
    """Do a job; say how it went: ``done`` and the result, or ``rejected`` or ``failed`` and why."""
    try:
        return "done", engine.run(job)
    except CoViewError as error:
        return "rejected", str(error)
    except Exception:
        with contextlib.suppress(Exception):
            engine.forget(job.robot)
        return "failed", traceback.format_exc(limit=-6)


def unwrap(kind: str, value: Any) -> Result:
    """Return the result or raise what :func:`attempt` caught."""
    if kind == "done":
        result: Result = value
        return result
    raise (RejectedError if kind == "rejected" else FailedError)(str(value))


def _environment() -> dict[str, str]:
    """Ours, with this package in reach and one BLAS thread: two engines share the cores."""
    paths = [p for p in sys.path if p]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OPENBLAS_NUM_THREADS": "1"}
