"""Compilation of the kernels before their first use: each takes some hundredths of a second or more, cached or not.

A module of kernels registers a call for each public function::

    compiled_by("nearest", lambda: nearest(PointGrid(SAMPLE), SAMPLE, 1.0))

and a caller that must not wait later calls ``warm_up("nearest")`` first.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable

import numpy as np

from coview_kernels import runtime

SAMPLE = np.ones((2, 3), dtype=np.float32)
"""A cloud for the calls of :func:`compiled_by`; not to be written to."""

_PATIENCE = 300.0  # seconds; on an idle computer it takes five

_calls: dict[str, Callable[[], object]] = {}


def compiled_by(name: str, call: Callable[[], object]) -> None:
    """Register a cheap call that compiles all kernels of the public function ``name``."""
    _calls[name] = call


def warm_up(*names: str) -> None:
    """Start the backend and compile the kernels of public functions, by default of all; ValueError for other names."""
    if unknown := sorted(set(names) - set(_calls)):
        raise ValueError(f"no kernel {', '.join(unknown)}; there are {', '.join(sorted(_calls))}")
    if runtime.backend() == "numpy":
        return
    for name in names or sorted(_calls):
        _calls[name]()


def compile_once(*names: str) -> None:
    """Have the kernels of public functions compiled and stored by another process, the first time on a machine.

    The library stores them only when a process exits by itself: one that will be killed calls this before its first
    kernel, and would compile them at every start. Does nothing where compiled kernels cannot be kept.
    """
    mark = runtime.mark_of(names)
    if mark is None or mark.is_file():
        return
    code = "import sys; from coview_kernels import warm_up; warm_up(*sys.argv[1:])"
    with contextlib.suppress(OSError, subprocess.SubprocessError), runtime.locked(mark.with_name("coview.lock")):
        if mark.is_file():  # another process has, meanwhile
            return
        subprocess.run(
            [sys.executable, "-P", "-c", code, *names], check=True, stdin=subprocess.DEVNULL, timeout=_PATIENCE
        )
        mark.touch()
