"""Progress of long work on maps, and its bar on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[int, int], None]
"""Called with (done, total)."""


@contextmanager
def progress_bar(title: str, show: bool | None = None, unit: str = "", scale: bool = False) -> Iterator[Progress]:
    """Show a bar on stderr, and yield the function that moves it.

    Args:
        title: of the bar.
        show: None shows it on a terminal only.
        unit: of the numbers.
        scale: print thousands as k, millions as M.
    """
    from tqdm import tqdm

    shown = sys.stderr.isatty() if show is None else show
    with tqdm(total=1, desc=title, unit=unit, unit_scale=scale, disable=not shown, leave=False) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step
