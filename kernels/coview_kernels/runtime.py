"""Start, choice and end of the backend, in the only module that imports quadrants (a fork of Taichi) or Taichi.

"Taichi" means either, here and elsewhere, as both compile the same source. Quadrants is preferred, because it needs no
system library except libc and starts in half the time (commit 731ba9db, bench/speed).

Taichi starts at the first kernel, not at import, and belongs to one thread: a program must be initialised and first
launched on the same thread, and concurrent launches sometimes fail. One daemon thread owns it and takes calls from a
queue, while callers wait; frequent prepared launches run on the caller's thread while the owner waits.

* ``COVIEW_KERNELS`` = ``quadrants``, ``taichi`` or ``numpy`` forces a backend; the default is the first usable one.
* ``COVIEW_THREADS`` = 1, 2, ... bounds the threads of a kernel; the default is all cores of the process, up to 16.
* A host program that has initialised Taichi keeps it, as a second ``init`` would destroy its fields. We then use the
  other library, if installed, or NumPy. The same holds if the host initialises Taichi after us, which it must not do
  while one of our kernels runs.
* A forked child computes in NumPy, as it inherits Taichi's state without its threads and would hang.
* :func:`shutdown` ends the thread and frees Taichi; the next kernel starts both again. It also runs at exit.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import importlib
import importlib.util
import inspect
import linecache
import os
import shutil
import stat
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

from coview_kernels.owner_thread import OwnerThread, StoppedError

P = ParamSpec("P")
R = TypeVar("R")

_BACKENDS = ("quadrants", "taichi", "numpy")
_STALE_LOCK = 60.0  # seconds; the library locks the cache for milliseconds
_MAX_WORKERS = 16  # memory bounds the kernels; more threads only add private bins to merge


class _DisplacedError(Exception):
    """The host has replaced our Taichi program."""


class _Backend:
    """An initialised library, its program, and the thread that launches every kernel."""

    def __init__(self, name: str) -> None:
        self.library: Any = None
        self._program: Any = None
        self._name = name
        self._thread = OwnerThread("coview-kernels")
        self.call, self.here = self._thread.call, self._thread.here
        try:
            self.call(self._start)
        except BaseException:
            self._thread.stop()
            raise

    def _start(self) -> None:
        self.library = _import(self._name)
        for name, module in list(sys.modules.items()):  # kernels of another library
            if name.startswith("coview_kernels._ti_") and vars(module).get("ti") is not self.library:
                del sys.modules[name]
        _init(self.library)
        self._program = _program(self.library)

    def displaced(self) -> bool:
        return _program(self.library) is not self._program

    def stop(self) -> None:
        self.call(lambda: None if self.displaced() else self.library.reset())
        self._thread.stop()


_lock = threading.RLock()
_owner: _Backend | None = None
_backend: str | None = None


def _import(name: str) -> ModuleType:
    if os.name == "posix" and not os.environ.get("HOME"):  # as in a service; Taichi would end the process
        os.environ.pop("HOME", None)  # an empty value would hide the password database
        home = os.path.expanduser("~")  # noqa: PTH111  # Path raises for a user who has none
        os.environ["HOME"] = home if os.access(home, os.W_OK) else str(_folder_for_this_process())
    # suppress the banner of the import, unless the user has set this
    os.environ.setdefault(f"ENABLE_{name.upper()}_HEADER_PRINT", "0")
    os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # else Taichi asks over the network once a day
    with _quick_frames():
        return importlib.import_module(name)


@contextlib.contextmanager
def _quick_frames() -> Iterator[None]:
    """Answer this thread's ``inspect.getframeinfo`` from the frame alone, without searching every module.

    The library calls it for the line of every function that it decorates, which takes a third of its import.
    """
    original, ours = inspect.getframeinfo, threading.get_ident()

    def quick(frame: Any, context: int = 1) -> inspect.Traceback:
        if threading.get_ident() != ours or context != 1:
            return original(frame, context)
        code, number = frame.f_code, frame.f_lineno
        line = linecache.getline(code.co_filename, number, frame.f_globals)
        return inspect.Traceback(code.co_filename, number, code.co_name, [line], 0)

    inspect.getframeinfo = quick
    try:
        yield
    finally:
        inspect.getframeinfo = original


def _program(library: Any) -> Any:
    """Return the initialised program of the library, or None."""
    state = vars(library.lang.impl.get_runtime())
    return state["_prog"] if "_prog" in state else state["prog"]  # quadrants, taichi


def _init(library: Any) -> None:
    # init prints a line at every log level. A name in its module hides the builtin only there; redirecting sys.stdout
    # would also swallow the output of other threads.
    misc = library.lang.misc
    misc.print = lambda *args, **kwargs: None
    folder = _cache_folder(library)
    _remove_stale_lock(folder)
    library.set_logging_level(library.ERROR)  # init's level comes too late for the folder's environment variable
    try:
        library.init(
            arch=library.cpu,
            cpu_max_num_threads=workers(),
            fast_math=False,  # the twins agree exactly on edges; this costs nothing measurable
            log_level="error",
            offline_cache_file_path=str(folder),
        )
    finally:
        del misc.print


@functools.cache
def _cache_folder(library: Any) -> Path:
    """Return the folder of compiled kernels; for quadrants a subfolder, as it finds a kernel by its source.

    That search (see :func:`kernel`) ignores the constants of a kernel's functions, so a hash of all our sources names
    the subfolder. Native code is loaded unchecked: if others may write there, this process compiles in its own folder.
    """
    quadrants = library.__name__ == "quadrants"
    named = os.environ.get(f"{'QD' if quadrants else 'TI'}_OFFLINE_CACHE_FILE_PATH")
    folder = Path(named or library.lang.impl.default_cfg().offline_cache_file_path).absolute()
    if quadrants:
        warnings.filterwarnings("ignore", message=r"\[PURE\.VIOLATION\]", category=UserWarning)  # of those constants
        digest = hashlib.sha256()
        for path in sorted(Path(__file__).parent.rglob("*.py")):
            digest.update(path.read_bytes())
        folder /= f"coview-{digest.hexdigest()[:16]}"
    try:
        for each in (*reversed(folder.parents), folder):
            if not each.exists():
                each.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 16))
    except OSError:  # a full or read-only disk, on which quadrants would raise
        return _folder_for_this_process()
    return folder if is_private(folder) else _folder_for_this_process()


def mark_of(names: Sequence[str]) -> Path | None:
    """Return the file that marks kernels as stored for such processes; None if a backend runs or keeps no kernels."""
    name = _choose()
    if _backend is not None or name == "numpy":
        return None
    library = _import(name)
    folder = _cache_folder(library)
    if any(folder.is_relative_to(each) for each in _temporary):
        return None
    version = ".".join(map(str, library.__version__))
    digest = hashlib.sha256(" ".join(names).encode()).hexdigest()[:8]
    return folder / f"stored-{name}-{version}-{workers()}-{digest}"


_temporary: set[Path] = set()


def _folder_for_this_process() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="coview-kernels."))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    _temporary.add(folder)
    return folder


def is_private(folder: Path) -> bool:
    """Return whether only this user or root may put files into a folder, or replace the folder."""
    if os.name != "posix":
        return True
    folder = folder.resolve()
    for each in (folder, *folder.parents):
        status = each.stat()
        if status.st_uid not in (0, os.geteuid()):
            return False
        if each != folder and status.st_mode & stat.S_ISVTX and status.st_uid == 0:
            continue  # like /tmp, where only owners rename
        if status.st_mode & stat.S_IWOTH or (status.st_mode & stat.S_IWGRP and not _is_own_group(status.st_gid)):
            return False
    return True


def _is_own_group(number: int) -> bool:
    """Return whether a group has only this user, as on systems where files have mode 664."""
    import grp
    import pwd

    try:
        group, name = grp.getgrgid(number), pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
    return group.gr_name == name and not set(group.gr_mem) - {name}


def kernel(function: Callable[..., Any]) -> Any:
    """Decorate the source of a kernel in its module, so that quadrants finds the compiled form without parsing it."""
    decorate = library().kernel
    return decorate(fastcache=True)(function) if library().__name__ == "quadrants" else decorate(function)


def _remove_stale_lock(folder: Path) -> None:
    """Remove the lock that a killed process has left on the cache of compiled kernels.

    The library holds the lock for an instant, and ignores the cache while it exists, so every start would compile.
    """
    for lock in (folder / "ticache.lock", folder / "qdcache.lock"):
        with contextlib.suppress(OSError):
            if time.time() - lock.stat().st_mtime > _STALE_LOCK:
                lock.unlink()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def workers() -> int:
    """Return the number of threads of a kernel; ValueError if ``COVIEW_THREADS`` is not a positive whole number."""
    asked = os.environ.get("COVIEW_THREADS", "")
    if not asked:
        return min(_MAX_WORKERS, cores())
    if not asked.isdecimal() or int(asked) < 1:
        raise ValueError(f"COVIEW_THREADS is {asked!r}; set it to a whole number from 1 up, or unset it")
    return min(_MAX_WORKERS, cores(), int(asked))


def library() -> Any:
    """Return the initialised Taichi module, for modules of kernels."""
    if _owner is None:
        raise RuntimeError("kernel modules are imported by runtime.kernels, on the owner thread")
    return _owner.library


def program() -> Any:
    """Return the initialised program of :func:`library`; kernels compiled for another program are invalid."""
    return _program(library())


def kernels(name: str) -> Any:
    """Return the module ``_ti_<name>``, imported at first use; call on the owner thread."""
    name = f"coview_kernels._ti_{name}"
    if name in sys.modules:
        return sys.modules[name]
    with _quick_frames():
        return importlib.import_module(name)


def _usable(name: str) -> bool:
    """Return whether the library can be imported and has no program of the host."""
    if importlib.util.find_spec(name) is None:
        return False
    try:
        return _program(_import(name)) is None
    except (ImportError, OSError):  # also a wheel for another system
        return False


def _choose() -> str:
    forced = os.environ.get("COVIEW_KERNELS", "")
    if not forced:
        return next((name for name in _BACKENDS[:-1] if _usable(name)), "numpy")
    if forced not in _BACKENDS:
        raise ValueError(f"COVIEW_KERNELS is {forced!r}; set it to {', '.join(_BACKENDS)}, or unset it")
    if forced != "numpy" and not _usable(forced):
        raise ImportError(f"COVIEW_KERNELS={forced}, but it is missing or in use by the host; unset it")
    return forced


def backend() -> str:
    """Return the backend that runs, ``taichi``, ``quadrants`` or ``numpy``; start it if need be.

    Raises:
        ValueError: ``COVIEW_KERNELS`` names no backend, or ``COVIEW_THREADS`` is not a positive whole number.
        ImportError: ``COVIEW_KERNELS`` names a backend that is missing, or that the host program uses.
    """
    global _owner, _backend
    if _backend is not None:
        return _backend
    with _lock:
        if _backend is None:
            name = _choose()
            if name != "numpy":
                _owner = _Backend(name)
                # registered after the import of Taichi, to run before Taichi's own exit handler
                atexit.unregister(_at_exit)
                atexit.register(_at_exit)
            _backend = name
    return _backend


def submit(fn: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Run ``fn(*args, **kwargs)`` on the thread that may launch kernels, and return its result or raise its error.

    Any thread may call this, also the owner. With the NumPy backend ``fn`` runs on the caller's thread.
    """
    while True:
        backend()
        owner = _owner
        if owner is None:
            return fn(*args, **kwargs)
        try:
            return owner.call(lambda: fn(*args, **kwargs))
        except StoppedError:  # a shutdown came first
            with _lock:  # wait for its end, then start again
                continue


def dispatch(native: Callable[P, R], plain: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Run ``native`` on the owner thread if Taichi runs, else its twin ``plain`` on the caller's thread."""
    global _owner, _backend
    if backend() == "numpy":
        return plain(*args, **kwargs)

    def launch(*args: P.args, **kwargs: P.kwargs) -> R:
        if _owner is None or _owner.displaced():
            raise _DisplacedError
        return native(*args, **kwargs)

    try:
        return submit(launch, *args, **kwargs)
    except _DisplacedError:
        with _lock:
            if _owner is not None and _owner.displaced():
                _owner.stop()
                _owner, _backend = None, "numpy"
        return plain(*args, **kwargs)


def dispatch_here(
    ready: Callable[[], bool], native: Callable[P, R], plain: Callable[P, R], *args: P.args, **kwargs: P.kwargs
) -> R:
    """Dispatch as :func:`dispatch` does, but run ``native`` on the caller's thread if ``ready()``; the owner waits.

    For frequent kernels: waking the owner, and then the caller, takes 0.25 ms if cores sleep. ``native`` may only
    launch prepared kernels (:meth:`coview_kernels.launch.Launch.ready`), and hands nothing to the owner.
    """
    owner = _owner
    if owner is not None:

        def launch() -> R:
            if owner.displaced() or not ready():
                raise _DisplacedError
            return native(*args, **kwargs)

        try:
            return owner.here(launch)
        except _DisplacedError:
            pass
    return dispatch(native, plain, *args, **kwargs)


def shutdown() -> None:
    """Finish the queued kernels, free Taichi and end its thread. Idempotent; the next kernel starts both again."""
    global _owner, _backend
    with _lock:  # held to the end: a new program would destroy the old one under a running kernel
        if _owner is not None:
            _owner.stop()
        _owner, _backend = None, None


def _at_exit() -> None:
    global _backend
    shutdown()
    _backend = "numpy"  # a daemon thread that still computes must not start Taichi during interpreter exit


def _after_fork() -> None:
    global _lock, _owner, _backend
    _lock = threading.RLock()  # the thread that held it does not exist here
    _owner, _backend = None, "numpy"


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
