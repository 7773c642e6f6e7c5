"""An engine in its own process, which is restarted when it dies and killed when it hangs.

Native code (registration, BLAS, tree building) may hold the interpreter lock for long, so only a separate process keeps
the node's pose clock steady. It is started by ``python -m coview_stream.stream.node.engine_process FD KIND PARENT``.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pickle
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import CoViewError
from coview_stream.stream.node.heap import bound_heaps, return_free_memory

if TYPE_CHECKING:
    from coview_stream.basemap.signature import Trust
    from coview_stream.config import LocalizerConfig
    from coview_stream.stream.node.engine_queue import Job, Result
    from coview_stream.stream.node.engines import Engine

log = logging.getLogger("coview_stream.node")

NICE = {"odometry": 2, "track": 4, "search": 10}
"""Niceness of the engines, below the parent's pose clock and receiving threads. Every pose waits for odometry."""

_POLL_INTERVAL = 0.1  # seconds between checks whether the opening was cancelled
_PARENT_INTERVAL = 2.0  # seconds between an idle child's checks that its parent lives
_DOUBT = ("doubt", None)  # message sent during a job
_REST = 3  # idle checks before memory is freed, 6 s: while a robot is searched for, a keyframe comes every few seconds


class RejectedError(Exception):
    """The engine could not use a job's frame; nothing changes, though its hints may have been applied."""


class FailedError(Exception):
    """The engine failed at a job; it has forgotten the job's robot."""


class DiedError(Exception):
    """The engine's process died or hung; the engine has forgotten all robots."""


class CancelledError(Exception):
    """The wait for the engine was cancelled."""


# ---- the parent's side


class EngineChild:
    """The child process; it may start before map and robots are known.

    It imports its libraries and loads its kernels, which takes most of its start, then waits for the arguments of
    :func:`~coview_stream.stream.node.engines.open_engine`. Meanwhile the parent reads options, checks the map and opens
    the network. It is a new interpreter: a fork deadlocks once zenoh is open, a spawn imports the host's main module.
    """

    def __init__(self, kind: str) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self.process = subprocess.Popen(
                python_command(
                    "coview_stream.stream.node.engine_process", str(theirs.fileno()), kind, str(os.getpid())
                ),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=engine_environment(kind),
                start_new_session=True,  # the parent passes on an interrupt at the terminal
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
    """Start the engines of a node, odometry first, as its library may be missing."""
    return {kind: EngineChild(kind) for kind in NICE if lidar_odometry or kind != "odometry"}


def engine_environment(kind: str) -> dict[str, str]:
    """Return our environment with this package on the path and few threads, to leave cores to the other engines.

    BLAS has one thread. Search kernels and networks use all cores but one, unless ``COVIEW_THREADS`` is set: they are
    always busy while a robot is off the map, and work with deadlines needs a free core.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = {"COVIEW_THREADS": str(max(1, cores - 1))} if kind == "search" else {}
    ours = {name: value for name, value in python_environment().items() if name != "NOTIFY_SOCKET"}  # the node notifies
    return threads | ours | {"OPENBLAS_NUM_THREADS": "1"}


class EngineProcess:
    """Runs an engine's jobs in a child process, one at a time. A child that hangs is killed.

    Attributes:
        on_doubt: called during a job if its frame contradicts the robot's place.

    Args:
        kind: ``track``, ``search`` or ``odometry``.
        map_path: map file, which every process maps for itself.
        sha256: hash of the map; a file replaced meanwhile is refused, as its poses would be relative to another map.
        config: for the localizers and searches; None: the defaults.
        trust: requires a signed map; None accepts any.
        child: the first child, already started; None starts one.
        job_timeout: seconds after which a job counts as hung.
        open_timeout: seconds without a new step (a kernel compiled, the map opened) after which a start counts as hung.
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
        job_timeout: float = 30.0,
        open_timeout: float = 120.0,
    ) -> None:
        self.kind = kind
        self.job_timeout = job_timeout
        self.open_timeout = open_timeout
        self._opening = map_path, sha256, config, trust
        self.on_doubt: Callable[[], None] = lambda: None
        self._prestarted = child
        self._closed = False
        self._lock = threading.Lock()
        self._child: EngineChild | None = None
        self._awaited: list[str] = []  # messages that a fresh child has yet to send
        self._step: str | None = None  # newest step of the child's start
        self._stopped: int | None = None  # id of the process that the previous check found stopped
        self._deadline = float("inf")  # local time at which the present exchange with the child counts as hung
        self._hung = False

    @property
    def pid(self) -> int | None:
        """Process id of the child, None without one."""
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
            child, self._prestarted = self._prestarted or EngineChild(self.kind), None
            self._child = child
            self._awaited = ["ready", "prepared"]
            with contextlib.suppress(OSError):  # it died: the wait for its answer will report it
                child.pipe.send(self._opening)

    def wait_ready(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Wait until the child has opened the map; ``cancelled`` is polled ten times a second.

        Raises:
            CoViewError: the child failed; the text says why. DiedError: it died or hung. CancelledError: cancelled.
        """
        self._await("ready", cancelled)

    def wait_prepared(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Wait until a job would start at once; arguments and errors as in :meth:`wait_ready`."""
        for message in list(self._awaited):
            self._await(message, cancelled)

    def _await(self, message: str, cancelled: Callable[[], bool]) -> None:
        while message in self._awaited:
            with self._exchange(self.open_timeout) as pipe:
                while not pipe.poll(_POLL_INTERVAL):
                    if cancelled():
                        raise CancelledError(f"the {self.kind} engine is no longer wanted")
                    self.end_hung_job()
                news = pipe.recv()
            self._take(*news)

    def _take(self, kind: str, value: str | None) -> None:
        """Handle a message from a new child: an error, a step of its start or the end of a wait."""
        if kind == "error":
            raise CoViewError(value)
        if kind == "step":
            if value != self._step:
                log.info("%s engine: %s", self.kind, value)
            self._step = value
        else:
            self._awaited.remove(kind)

    def run(self, job: Job) -> Result:
        """Do one job and wait for it; RejectedError, FailedError or DiedError. A dead child is restarted first."""
        if self._child is None:
            self.start()
        try:
            self.wait_prepared()
        except CoViewError as error:
            self._end()
            raise DiedError(str(error)) from error
        with self._exchange(self.job_timeout) as pipe:
            pipe.send_bytes(pickle.dumps(job))  # a failed send() keeps a view of a BytesIO: python/cpython#111049
            while (answer := pipe.recv()) == _DOUBT:
                self.on_doubt()
        kind, value = answer
        return unwrap(kind, value)

    @contextmanager
    def _exchange(self, seconds: float) -> Iterator[Connection]:
        """Yield the pipe; sending, waiting and receiving may each hang, and share ``seconds``."""
        child = self._child
        self._deadline, self._hung = time.monotonic() + seconds, False
        try:
            if child is None:
                raise EOFError
            yield child.pipe
        except (EOFError, OSError, TypeError) as error:  # TypeError: another thread has closed it
            self._end()
            end = f"had no answer for {seconds:g} s and was ended" if self._hung else "died"
            raise DiedError(f"the {self.kind} engine {end}") from error
        finally:
            self._deadline = float("inf")

    def watch(self) -> None:
        """Check the child without waiting while there is no job: it may have become ready, or died.

        A dead child, or one that could not open the map, is reaped and reported once (DiedError); the next call starts
        another in time for the next job. Called on the thread that runs the jobs.
        """
        child = self._child
        if child is None:
            self.start()
            return
        try:
            while self._awaited and child.pipe.poll():
                with self._exchange(self.open_timeout) as pipe:
                    news = pipe.recv()
                self._take(*news)
        except (CoViewError, OSError) as error:  # OSError: another thread has closed it
            self._end()
            raise DiedError(str(error) if isinstance(error, CoViewError) else f"the {self.kind} engine died") from error
        if (code := child.process.poll()) is not None:
            self._end()
            cause = f"by signal {-code}" if code < 0 else f"exit code {code}"
            raise DiedError(f"the {self.kind} engine died ({cause})")

    def end_stopped(self) -> None:
        """Kill a child whose job takes too long, or that two calls in a row find stopped (SIGSTOP; Linux only).

        A stopped child would block the jobs, and the robots, until a job's time limit.
        """
        self.end_hung_job()
        child, stopped = self._child, None
        if child is not None and child.process.returncode is None:
            with contextlib.suppress(OSError):  # no /proc; a process held by a debugger is not "T"
                stat = Path(f"/proc/{child.process.pid}/stat").read_text(errors="replace")
                if stat.rpartition(")")[2].split()[:1] == ["T"]:
                    stopped = child.process.pid
            if stopped is not None and stopped == self._stopped:
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


def unwrap(kind: str, value: Any) -> Result:
    """Return the result of :func:`attempt`, or raise its error."""
    if kind == "done":
        result: Result = value
        return result
    raise (RejectedError if kind == "rejected" else FailedError)(str(value))


# ---- the child's side


def attempt(engine: Engine, job: Job) -> tuple[str, Any]:
    """Do a job; return ``done`` and the result, or ``rejected`` or ``failed`` and the reason."""
    try:
        return "done", engine.run(job)
    except CoViewError as error:
        return "rejected", str(error)
    except Exception:
        with contextlib.suppress(Exception):
            engine.forget(job.robot)
        return "failed", traceback.format_exc(limit=-6)


def work(
    pipe: Connection, kind: str, open_engine: Callable[..., Engine] | None = None, parent: int | None = None
) -> int:
    """Run an engine in this process: load its kernels, open it, do the jobs that arrive on the pipe.

    On the first start on a machine the kernels are compiled first, for some seconds. Kernels of later jobs are loaded
    one by one while no job waits; a job that arrives meanwhile waits for one of them, at most a quarter of a second.

    Args:
        pipe: to the parent: first the arguments of :func:`~coview_stream.stream.node.engines.open_engine`, then jobs.
        kind: kind of the engine.
        open_engine: replaces that function.
        parent: process id of the parent. The process ends if it gets another parent, even with an open pipe.

    Returns:
        The exit code: 0 when the parent has gone, 1 if the engine cannot be opened, which the parent has been told.
    """
    _set_group_nice(NICE[kind])
    from coview_kernels import warm_up
    from coview_kernels.warm_up import compile_once
    from coview_stream.stream.node import engines

    kernels, later_kernels = engines.KINDS[kind].kernels, engines.KINDS[kind].later_kernels
    compile_once(*kernels, *later_kernels, say=lambda text: pipe.send(("step", text)))
    for name in kernels:
        if pipe.poll():  # the parent has named the map: it waits for this engine, or a robot soon will: full priority
            _set_group_nice(0)
        warm_up(name)
    steps: deque[Callable[[], None]] = deque(partial(warm_up, name) for name in later_kernels)

    def use_pause() -> None:
        while steps and not pipe.poll():
            with contextlib.suppress(CoViewError):  # the job that needs it will report it
                steps.popleft()()

    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):  # the parent is gone: end too
        use_pause()
        opening = pipe.recv()
        _set_group_nice(0)
        try:
            engine = (open_engine or engines.open_engine)(kind, *opening)
            engine.on_doubt = partial(pipe.send, _DOUBT)
            pipe.send(("ready", None))
            engine.prepare()
        except CoViewError as error:
            pipe.send(("error", str(error)))
            return 1
        if not gc.isenabled():
            gc.freeze()  # most startup objects stay: scanning them again would slow every job
            gc.enable()
        pipe.send(("prepared", None))
        _set_group_nice(NICE[kind])
        steps.extend((engine.prepare_later, return_free_memory))
        while True:
            use_pause()
            pauses = 0
            while not pipe.poll(_PARENT_INTERVAL):
                if parent not in (None, os.getppid()):  # the parent's fork may hold the pipe open
                    return 0
                pauses += 1
                if pauses == _REST:
                    engine.rest()
                    return_free_memory()
            pipe.send(attempt(engine, pipe.recv()))
    return 0


def _set_group_nice(nice: int) -> None:
    """Set this session's niceness: where Linux schedules by session, a process's own counts only within its session."""
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(nice))


if __name__ == "__main__":
    bound_heaps(1)  # one per thread takes 20 MB more
    gc.disable()  # most startup objects stay: saves a tenth of the start
    with contextlib.suppress(OSError):
        os.nice(NICE[sys.argv[2]])
    sys.exit(work(Connection(int(sys.argv[1])), sys.argv[2], parent=int(sys.argv[3])))
