"""A clock for the stages of what is measured: with blocks, or around functions of the package while it runs."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch


class Clock:
    """Seconds by name, added up; ``with clock("name"):`` adds to them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the seconds of the block."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - begin

    @contextmanager
    def around(self, stages: Iterable[tuple[str, Any, str]]) -> Iterator[None]:
        """Time functions until the block ends: the name, the module or class where it is looked up, its attribute."""
        with ExitStack() as stack:
            for label, owner, name in stages:
                timed: Any = self._timed(label, getattr(owner, name))
                bound = isinstance(vars(owner)[name], classmethod)
                stack.enter_context(patch.object(owner, name, staticmethod(timed) if bound else timed))
            yield

    def _timed(self, label: str, stage: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(stage)
        def run(*arguments: Any, **options: Any) -> Any:
            with self(label):
                return stage(*arguments, **options)

        return run
