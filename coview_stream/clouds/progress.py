"""Progress of long work, and its bar on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

_SHORT = 10.0  # seconds; shorter work prints no lines

Progress = Callable[[int, int], None]
"""Called with (done, total)."""


@contextmanager
def progress_bar(
    title: str, show: bool | None = None, unit: str = "", scale: bool = False
) -> Iterator[Callable[..., None]]:
    """Show a bar on stderr, and yield the function that moves it, a :data:`Progress` with a note as third argument.

    Args:
        title: title of the bar.
        show: None shows it on a terminal only.
        unit: unit of the numbers.
        scale: print thousands as k, millions as M.
    """
    from tqdm import tqdm

    shown = sys.stderr.isatty() if show is None else show
    with tqdm(total=1, desc=title, unit=unit, unit_scale=scale, disable=not shown, leave=False) as bar:

        def step(done: int, total: int, note: str | None = None) -> None:
            if done < bar.n:
                bar.reset()  # restarts the estimate of the time left
            bar.total = total
            bar.update(done - bar.n)
            if note is not None:
                bar.set_postfix_str(note)

        yield step


@contextmanager
def staged_bar(shares: Mapping[str, float], show: bool) -> Iterator[Callable[[str], Progress]]:
    """Show one bar for successive stages, with the time left, and yield the function that begins a stage.

    If stderr is not a terminal, each stage prints a line instead, once the work has taken ten seconds.

    Args:
        shares: share of each stage in the whole time, in order.
        show: whether anything is shown.
    """
    from tqdm import tqdm

    terminal, start = sys.stderr.isatty(), time.monotonic()
    form = "{desc}{percentage:3.0f}% |{bar}| {elapsed}, {remaining} left"
    with tqdm(total=sum(shares.values()), disable=not (show and terminal), leave=False, bar_format=form) as bar:

        def begin(stage: str) -> Progress:
            before = sum(share for name, share in list(shares.items())[: list(shares).index(stage)])
            bar.set_description(stage)
            if show and not terminal and (seconds := time.monotonic() - start) > _SHORT:
                sys.stderr.write(f"after {seconds:.0f} s: {stage}\n")
                sys.stderr.flush()
            bar.update(max(0.0, before - bar.n))

            def step(done: int, total: int) -> None:
                bar.update(max(0.0, before + shares[stage] * min(done / max(total, 1), 1.0) - bar.n))

            return step

        yield begin
