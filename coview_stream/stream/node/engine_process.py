"""Engine in a process of its own, which is started again when it dies, and killed when it hangs.

Native code (registration, BLAS, tree building) may hold the interpreter lock for long; a process of its own is the only
thing that keeps the pose clock of this one steady.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import CoViewError

if TYPE_CHECKING:
    from coview_stream.basemap.signature import Trust
    from coview_stream.config import LocalizerConfig
    from coview_stream.stream.node.engine_queue import Job, Result
    from coview_stream.stream.node.engines import Engine

NICE = {"odometry": 2, "track": 4, "search": 10}
"""Niceness of the engines, below the pose clock and the receiving threads in the parent. Every pose waits for
odometry."""

_POLL_INTERVAL = 0.1  # seconds between two checks whether the opening has been cancelled


class RejectedError(Exception):
    """The engine could not use a job's frame, which changes nothing; its hints may have been applied."""


class FailedError(Exception):
    """The engine failed at a job; it has forgotten the job's robot."""


class DiedError(Exception):
    """The engine's process died or hung; it has forgotten all robots."""


class CancelledError(Exception):
    """The engine is no longer waited for."""


class Opening(NamedTuple):
    """Message that names the map that a child has to open.

    Attributes:
        map_path: the map's file.
        sha256: of the map.
        config: of the localizers and searches; None for the defaults.
        trust: demands that the map is signed; None takes any.
    """

    map_path: str
    sha256: str
    config: LocalizerConfig | None = None
    trust: Trust | None = None


class EngineChild:
    """A process of :mod:`coview_stream.stream.node.worker`, which may be started before map and robots are known.

    It imports its libraries and loads its kernels first, which takes most of its start, and only then waits for its
    :class:`Opening`: meanwhile the parent reads options, checks the map and opens the network. It is a new interpreter,
    not a fork, which deadlocks once zenoh is open, nor a spawn, which would import the host's main module.

    Args:
        kind: ``track``, ``search`` or ``odometry``.
        nice: added to its niceness; None for that of its kind.
    """

    def __init__(self, kind: str, nice: int | None = None) -> None:
        ours, theirs = socket.socketpair()
        nice = NICE[kind] if nice is None else nice
        with theirs:
            self.process = subprocess.Popen(
                python_command("coview_stream.stream.node.worker", str(theirs.fileno()), kind, str(nice)),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=engine_environment(kind),
                start_new_session=True,  # an interrupt at the terminal is for the parent to pass on
            )
        self.pipe = Connection(ours.detach())

    def close(self) -> None:
        """Kill the process, which has nothing to save, and close the pipe."""
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=1.0)
        with contextlib.suppress(OSError):
            self.pipe.close()


def start_children(lidar_odometry: bool) -> dict[str, EngineChild]:
    """Start the engines of a node; that of odometry, whose library may be missing, comes first."""
    return {kind: EngineChild(kind) for kind in NICE if lidar_odometry or kind != "odometry"}


def engine_environment(kind: str) -> dict[str, str]:
    """Return our environment, with this package in reach and few threads, to leave cores to the other engines.

    BLAS has one. The kernels and networks of searches have all cores but one, unless ``COVIEW_THREADS`` is set: they
    are always busy while a robot is off the map, and work with deadlines needs a free core.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = {"COVIEW_THREADS": str(max(1, cores - 1))} if kind == "search" else {}
    ours = {name: value for name, value in python_environment().items() if name != "NOTIFY_SOCKET"}  # the node notifies
    return threads | ours | {"OPENBLAS_NUM_THREADS": "1"}


class EngineRunner(Protocol):
    """Runs an engine's jobs one at a time. Raises RejectedError, FailedError or DiedError."""

    def run(self, job: Job) -> Result:
        """Do one job and wait for it."""
        ...

    @property
    def pid(self) -> int | None:
        """Process id, None while there is none."""
        ...

    @property
    def ready(self) -> bool:
        """Whether a job would be done at once."""
        ...

    def watch(self) -> None:
        """Check the engine while it has no job, never waiting; a dead one is reported once, then started."""
        ...

    def end_stopped(self) -> None:
        """Kill an engine that is stopped or hangs; called from any thread, once a second."""
        ...

    def close(self) -> None:
        """End the engine; a job under way raises DiedError."""
        ...


class EngineProcess:
    """Runs an engine's jobs in a child process. A child that hangs is killed.

    Args:
        kind: ``track``, ``search`` or ``odometry``.
        map_path: the map's file, which every process maps for itself.
        sha256: of the map; a file that was replaced meanwhile is refused, or poses would be of another map than stated.
        config: of the localizers and searches; None for the defaults.
        trust: demands that the map is signed; None takes any.
        child: the first child, started before; None starts one.
        nice: added to the child's niceness; None for that of its kind.
        job_timeout: seconds after which a job counts as hung.
        open_timeout: seconds after which opening the map, or preparing for the first job, does.
    """

    def __init__(
        self,
        kind: str,
        map_path: str,
        sha256: str,
        config: LocalizerConfig | None = None,
        *,
        trust: Trust | None = None,
        child: EngineChild | None = None,
        nice: int | None = None,
        job_timeout: float = 30.0,
        open_timeout: float = 120.0,
    ) -> None:
        self.kind = kind
        self.opening = Opening(map_path, sha256, config, trust)
        self.nice = nice
        self.job_timeout = job_timeout
        self.open_timeout = open_timeout
        self._prestarted = child
        self._closed = False
        self._lock = threading.Lock()
        self._child: EngineChild | None = None
        self._awaited: list[str] = []  # messages that a fresh child has yet to send
        self._stopped: int | None = None  # process that was stopped at the previous check
        self._deadline = float("inf")  # local time at which the present job counts as hung
        self._hung = False

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        child = self._child
        return child.process.pid if child else None

    @property
    def ready(self) -> bool:
        """Whether the child has opened the map and prepared for jobs."""
        return self._child is not None and not self._awaited

    def start(self) -> None:
        """Start the child without waiting until it is ready."""
        with self._lock:
            if self._closed:
                raise DiedError(f"the {self.kind} engine has been closed")
            child, self._prestarted = self._prestarted or EngineChild(self.kind, self.nice), None
            self._child = child
            self._awaited = ["ready", "prepared"]
            with contextlib.suppress(OSError):  # it has died, as the wait for its answer will find
                child.pipe.send(self.opening)

    def wait_ready(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Wait until the child has opened the map.

        Args:
            cancelled: asked ten times a second; True gives up.

        Raises:
            CoViewError: it could not, and says why. DiedError: it died or hung. CancelledError: as asked.
        """
        if "ready" in self._awaited:
            self._await("ready", cancelled)

    def wait_prepared(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Wait until a job would not wait any more; arguments and errors as of :meth:`wait_ready`."""
        for message in list(self._awaited):
            self._await(message, cancelled)

    def _await(self, message: str, cancelled: Callable[[], bool] = lambda: False) -> None:
        with self._exchange(self.open_timeout) as pipe:
            while not pipe.poll(_POLL_INTERVAL):
                if cancelled():
                    raise CancelledError(f"the {self.kind} engine is no longer wanted")
                self.end_hung_job()
            kind, value = pipe.recv()
        if kind == "error":
            raise CoViewError(value)
        self._awaited.remove(message)

    def run(self, job: Job) -> Result:
        """Do one job; a dead child is started again first."""
        if self._child is None:
            self.start()
        try:
            self.wait_prepared()
        except CoViewError as error:
            self._end()
            raise DiedError(str(error)) from error
        with self._exchange(self.job_timeout) as pipe:
            pipe.send(job)
            kind, value = pipe.recv()
        return unwrap(kind, value)

    @contextmanager
    def _exchange(self, seconds: float) -> Iterator[Connection]:
        """Yield the pipe; sending, waiting and receiving may all hang, and together have ``seconds``."""
        child = self._child
        self._deadline, self._hung = time.monotonic() + seconds, False
        try:
            if child is None:
                raise EOFError
            yield child.pipe
        except (EOFError, OSError, TypeError) as error:  # the last one: closed by another thread meanwhile
            self._end()
            end = f"had no answer for {seconds:g} s and was ended" if self._hung else "died"
            raise DiedError(f"the {self.kind} engine {end}") from error
        finally:
            self._deadline = float("inf")

    def watch(self) -> None:
        """Check the child while there is no job, without waiting: it may have become ready, or died.

        A dead child is reaped and reported once; the next call starts another one, in time for the next job. By the
        thread that runs the jobs.

        Raises:
            DiedError: it died, or could not open the map, and says why.
        """
        child = self._child
        if child is None:
            self.start()
            return
        try:
            while self._awaited and child.pipe.poll():
                self._await(self._awaited[0])
        except CoViewError as error:
            self._end()
            raise DiedError(str(error)) from error
        except OSError as error:  # closed by another thread meanwhile
            self._end()
            raise DiedError(f"the {self.kind} engine died") from error
        if (code := child.process.poll()) is not None:
            self._end()
            cause = f"by signal {-code}" if code < 0 else f"exit code {code}"
            raise DiedError(f"the {self.kind} engine died ({cause})")

    def end_stopped(self) -> None:
        """Kill a child whose job takes too long, or that has been stopped for two calls in a row (SIGSTOP; Linux only).

        A stopped one would hold up the jobs until the time limit of one, and robots with them.
        """
        self.end_hung_job()
        child = self._child
        running = child is not None and child.process.returncode is None
        stopped = child.process.pid if child is not None and running and _is_stopped(child.process.pid) else None
        if child is not None and stopped is not None and stopped == self._stopped:
            child.process.kill()
        self._stopped = stopped

    def end_hung_job(self) -> None:
        """Kill a child whose job takes too long."""
        child = self._child
        if child is not None and time.monotonic() >= self._deadline:
            self._hung = True
            child.process.kill()

    def close(self) -> None:
        """Kill the child at once; it has nothing to save."""
        with self._lock:
            self._closed = True
        if self._prestarted is not None:
            self._prestarted.close()
        self._end()

    def _end(self) -> None:
        with self._lock:
            child, self._child = self._child, None
        if child is not None:
            child.close()


def _is_stopped(pid: int) -> bool:
    """Whether a process is stopped by a signal; False where there is no ``/proc``. One that a debugger holds is not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[:1] == ["T"]
    except OSError:
        return False


def attempt(engine: Engine, job: Job) -> tuple[str, Any]:
    """Do a job; return ``done`` and the result, or ``rejected`` or ``failed`` and why."""
    try:
        return "done", engine.run(job)
    except CoViewError as error:
        return "rejected", str(error)
    except Exception:
        with contextlib.suppress(Exception):
            engine.forget(job.robot)
        return "failed", traceback.format_exc(limit=-6)


def unwrap(kind: str, value: Any) -> Result:
    """Return the result or raise the error of :func:`attempt`."""
    if kind == "done":
        result: Result = value
        return result
    raise (RejectedError if kind == "rejected" else FailedError)(str(value))
