"""Compilation of the kernels before their first use: each takes some hundredths of a second or more, cached or not.

A module of kernels registers a call for each public function::

    compiled_by("nearest", lambda: nearest(PointGrid(SAMPLE), SAMPLE, 1.0))

and a caller that must not wait later first calls ``warm_up("nearest")``.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import numpy as np

from coview_kernels import runtime

SAMPLE = np.ones((2, 3), dtype=np.float32)
"""A cloud for the calls of :func:`compiled_by`, which must not change it."""

_PATIENCE = 600.0  # seconds to wait; compiling takes five on an idle computer, some minutes on the smallest boards
_INTERVAL = 1.0  # seconds between checks of another process that compiles

_calls: dict[str, Callable[[], object]] = {}


def compiled_by(name: str, call: Callable[[], object]) -> None:
    """Register a cheap call that compiles all kernels of the public function ``name``."""
    _calls[name] = call


def warm_up(*names: str) -> None:
    """Start the backend and compile the kernels of public functions, by default all; ValueError for unknown names."""
    if unknown := sorted(set(names) - set(_calls)):
        raise ValueError(f"no kernel {', '.join(unknown)}; there are {', '.join(sorted(_calls))}")
    if runtime.backend() == "numpy":
        return
    for name in names or sorted(_calls):
        _calls[name]()


def compile_once(*names: str, say: Callable[[str], None] = lambda text: None) -> None:
    """Compile and store the kernels of public functions in another process, the first time on a machine.

    The library stores kernels only when a process exits by itself. A process that will be killed calls this before its
    first kernel, or it would compile them at every start. The other process continues if this one is killed. ``say`` is
    called with each step. Does nothing if compiled kernels cannot be kept.
    """
    mark = runtime.mark_of(names)
    if mark is None or mark.is_file():
        return
    code = "import sys; from coview_kernels.warm_up import _store; _store(*sys.argv[1:])"
    command = [sys.executable, "-P", "-c", code, str(mark), *names]
    with contextlib.suppress(OSError):
        quiet = subprocess.DEVNULL  # a process that outlives us must not keep our output open
        with subprocess.Popen(command, stdin=quiet, stdout=subprocess.PIPE, stderr=quiet, text=True) as helper:
            for line in helper.stdout or ():
                say(line.strip())


def _store(mark: str, *names: str) -> None:
    """Compile and store kernels unless the file ``mark`` marks them as stored, and print each step."""
    done = Path(mark)
    with done.with_name("coview.lock").open("w") as lock:  # one process at a time
        _wait_for(lock)
        if done.is_file():  # another process has stored them
            return
        for number, name in enumerate(names, 1):
            _tell(f"compiling kernels for this machine, once: {number} of {len(names)}")
            warm_up(name)
        runtime.shutdown()
        done.touch()


def _wait_for(lock: TextIO) -> None:
    """Wait for the lock and take it, on systems with locks."""
    end = time.monotonic() + _PATIENCE
    with contextlib.suppress(ImportError, OSError):  # OSError: a file system without locks
        import fcntl

        while time.monotonic() < end:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                _tell("waiting for another process that compiles kernels")
                time.sleep(_INTERVAL)
            else:
                return


def _tell(text: str) -> None:
    with contextlib.suppress(OSError):  # the reader may have been killed
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
