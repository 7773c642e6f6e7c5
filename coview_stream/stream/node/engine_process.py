"""Engine in a process of its own, which is started again when it dies, and ended when it hangs.

Native code (registration, BLAS, tree building) may hold the interpreter lock for long; a process of its own is the only
thing that keeps the pose clock of this one steady.
"""

from __future__ import annotations

import contextlib
import subprocess
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from coview_stream.config import AcceptanceConfig, RegistrationMethod, Reloc
from coview_stream.errors import CoViewError
from coview_stream.stream.node.engine_child import EngineChild, Opening, end
from coview_stream.stream.node.watchdog import Watchdog

if TYPE_CHECKING:
    from coview_stream.basemap.signature import Trust
    from coview_stream.stream.node.engines import Engine
    from coview_stream.stream.node.jobs import Job, Result

_POLL_INTERVAL = 0.1  # seconds between two checks whether the opening has been cancelled


class RejectedError(Exception):
    """The engine could not use a job's frame, which changes nothing; what comes with it may have been applied."""


class FailedError(Exception):
    """The engine failed at a job; it has forgotten the job's robot."""


class DiedError(Exception):
    """The engine's process died or hung; it has forgotten all robots."""


class CancelledError(Exception):
    """The engine is no longer waited for."""


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
        """Look after the engine while it has no job, never waiting; one that died is reported once, then started."""
        ...

    def end_stopped(self) -> None:
        """End an engine that somebody has stopped, which may do no more jobs; called from any thread, now and then."""
        ...

    def close(self) -> None:
        """End the engine; a job under way raises DiedError."""
        ...


class EngineProcess:
    """Runs an engine's jobs in a child process. A child that hangs is killed.

    Args:
        kind: ``track``, ``search`` or ``odometry``.
        map_path: the map's file, which every process maps for itself.
        sha256: of the map; a file that was replaced meanwhile is refused, or poses would be of another map than said.
        nice: added to the child's niceness, so that the clock here is never late; None for that of its kind.
        registration: its method; small_gicp, if that is it, holds the interpreter lock in the child only.
        reloc: recognizers that propose the places to search at.
        risk: probability of a wrong place below which a search gives one.
        sensor_leans: whether sensors may lean against odometry's gravity.
        job_timeout: seconds after which a job counts as hung; set by hand.
        open_timeout: seconds after which opening the map, or preparing for the first job, does; set by hand.
        trust: demands that the map is signed; None takes any.
        child: started before, to be the first one; None starts one.
    """

    def __init__(
        self,
        kind: str,
        map_path: str,
        sha256: str,
        nice: int | None = 0,
        job_timeout: float = 30.0,
        open_timeout: float = 120.0,
        registration: RegistrationMethod = "trimmed-icp",
        reloc: Reloc = "auto",
        risk: float = AcceptanceConfig.risk,
        sensor_leans: bool = True,
        trust: Trust | None = None,
        child: EngineChild | None = None,
    ) -> None:
        self.kind = kind
        self.map_path = map_path
        self.sha256 = sha256
        self.nice = nice
        self.job_timeout = job_timeout
        self.open_timeout = open_timeout
        self.registration = registration
        self.reloc = reloc
        self.risk = risk
        self.sensor_leans = sensor_leans
        self.trust = trust
        self._started = child
        self._closed = False
        self._lock = threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._awaited: list[str] = []  # messages that a fresh child has yet to send
        self._stopped: int | None = None  # process that was seen stopped when last looked at
        self._watchdog = Watchdog(f"coview-watch-{kind}", self._kill)

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        return self._child.pid if self._child else None

    @property
    def ready(self) -> bool:
        """Whether the child has opened the map and prepared for jobs, as far as it has been asked."""
        return self._pipe is not None and not self._awaited

    def start(self) -> None:
        """Start the child without waiting until it is ready."""
        with self._lock:
            if self._closed:
                raise DiedError(f"the {self.kind} engine has been closed")
            started, self._started = self._started or EngineChild(self.kind, self.nice), None
            self._child, self._pipe = started.take()
            self._awaited = ["ready", "prepared"]
            with contextlib.suppress(OSError):  # it has died, as the wait for its answer will find
                asked = (self.registration, self.reloc, self.risk, self.sensor_leans, self.trust)
                self._pipe.send(Opening(self.map_path, self.sha256, *asked))

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
        """Wait until a job would not wait any more; asks and raises what :meth:`wait_ready` does."""
        for message in list(self._awaited):
            self._await(message, cancelled)

    def run(self, job: Job) -> Result:
        """Do one job; a child that died before is started again first."""
        if self._pipe is None:
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

    def watch(self) -> None:
        """Look after the child while there is no job, without waiting: it may have become ready, or died.

        A child that died is reaped and reported once; the next call starts another one, so that the next job finds it.
        By the thread that runs the jobs.

        Raises:
            DiedError: it died, or could not open the map, and says why.
        """
        child, pipe = self._child, self._pipe
        if child is None or pipe is None:
            self.start()
            return
        try:
            while self._awaited and pipe.poll():
                self._await(self._awaited[0])
        except CoViewError as error:
            self._end()
            raise DiedError(str(error)) from error
        except OSError as error:  # closed by another thread meanwhile
            self._end()
            raise DiedError(f"the {self.kind} engine died") from error
        if child.poll() is not None:
            self._end()
            raise DiedError(f"the {self.kind} engine died ({_cause(child.returncode)})")

    def end_stopped(self) -> None:
        """Kill a child that has been stopped (SIGSTOP, a full terminal) for two calls in a row; Linux only.

        It would hold up the jobs until the time limit of one, and robots with them.
        """
        child = self._child
        pid = None if child is None or child.returncode is not None else child.pid
        stopped = pid if pid is not None and _is_stopped(pid) else None
        if child is not None and stopped is not None and stopped == self._stopped:
            child.kill()
        self._stopped = stopped

    def close(self) -> None:
        """Kill the child at once; it keeps nothing that would have to be saved."""
        with self._lock:
            self._closed = True
        if self._started is not None:
            self._started.close()
        self._end()
        self._watchdog.close()

    def _await(self, message: str, cancelled: Callable[[], bool] = lambda: False) -> None:
        with self._exchange(self.open_timeout) as pipe:
            while not pipe.poll(_POLL_INTERVAL):
                if cancelled():
                    raise CancelledError(f"the {self.kind} engine is no longer wanted")
            kind, value = pipe.recv()
        if kind == "error":
            raise CoViewError(value)
        self._awaited.remove(message)

    @contextmanager
    def _exchange(self, seconds: float) -> Iterator[Connection]:
        """Yield the pipe; sending, waiting and receiving may all hang, and together have ``seconds``."""
        pipe = self._pipe
        try:
            if pipe is None:
                raise EOFError
            with self._watchdog.limit(seconds):
                yield pipe
        except (EOFError, OSError, TypeError) as error:  # the last one: closed by another thread meanwhile
            self._end()
            hung = f" had no answer for {seconds:g} s and was ended"
            raise DiedError(f"the {self.kind} engine{hung if self._watchdog.acted else ' died'}") from error

    def _kill(self) -> None:
        child = self._child
        if child is not None:
            child.kill()

    def _end(self) -> None:
        with self._lock:
            child, self._child = self._child, None
            pipe, self._pipe = self._pipe, None
        end(child, pipe)


def _cause(code: int) -> str:
    """Return how a process ended, by its exit code."""
    return f"by signal {-code}" if code < 0 else f"exit code {code}"


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
    """Return the result or raise what :func:`attempt` caught."""
    if kind == "done":
        result: Result = value
        return result
    raise (RejectedError if kind == "rejected" else FailedError)(str(value))
