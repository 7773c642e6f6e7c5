"""Compilation of the kernels before they are needed: each takes some hundredths of a second or more, cached or not.

A module of kernels names what is to be compiled before its function runs, beside the function::

    compiled_by("nearest", lambda: nearest(PointGrid(SAMPLE), SAMPLE, 1.0))

and a caller whose first call must not wait calls ``warm_up("nearest")`` before.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coview_kernels import runtime

SAMPLE = np.ones((2, 3), dtype=np.float32)
"""A cloud for the calls of :func:`compiled_by`; not to be written to."""

_calls: dict[str, Callable[[], object]] = {}


def compiled_by(name: str, call: Callable[[], object]) -> None:
    """Have ``call()``, cheap in itself, compile all kernels that the public function ``name`` launches."""
    _calls[name] = call


def warm_up(*names: str) -> None:
    """Start the backend and compile kernels now rather than at first use.

    Args:
        names: of the public functions that will be called, all of them by default.

    Raises:
        ValueError: a name is unknown.
    """
    if unknown := sorted(set(names) - set(_calls)):
        raise ValueError(f"no kernel {', '.join(unknown)}; there are {', '.join(sorted(_calls))}")
    if runtime.backend() == "numpy":
        return
    for name in names or sorted(_calls):
        _calls[name]()
