"""Where kernels run. For now in NumPy, on the calling thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def submit(fn: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Run ``fn(*args, **kwargs)`` where kernels may be launched and return its result; from any thread."""
    return fn(*args, **kwargs)


def backend() -> str:
    """Which implementation runs: ``taichi``, ``quadrants`` or ``numpy``."""
    return "numpy"


def warm_up() -> None:
    """Start the backend and compile every kernel now rather than at first use."""


def shutdown() -> None:
    """Stop the owner thread; the next call starts it again."""
