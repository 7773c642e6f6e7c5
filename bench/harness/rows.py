"""What every benchmark of the suite yields: one figure each, beside what it is compared with, and a verdict.

A module ``bench/NAME.py`` of the suite has ``rows(quick: bool = False) -> Iterator[Row]``; ``python -m bench``
runs it in a process of its own. Times are medians of wall time of at least :data:`REPEAT` runs; the sides of a
comparison take turns in one process, so that both meet the same load.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

REPEAT = 31
"""Runs behind every median; an odd number, so that the median is one of them."""


@dataclass(frozen=True)
class Row:
    """One figure of ours, the baseline's if there is one, and whether the target holds."""

    name: str
    """What was measured, e.g. ``match/top-k, 9527 stations``."""
    ours: float
    """Our figure, a median; NaN where none could be measured."""
    baseline: float | None
    unit: str
    """``ms``, ``s``, ``MB``, ``%``."""
    ratio: float | None
    """How many times better ours is; None where there is no baseline."""
    target: str
    """In words, e.g. ``>= 3`` (a ratio), ``<= 8 ms`` or ``>= 95 %``; empty where the row only informs."""
    holds: bool | None
    """Whether the target holds; None where the row only informs."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, which knows no NaN: None stands for a figure that is none."""
        return {
            k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(self).items()
        }

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Row:
        """Undo :meth:`to_dict`.

        Raises:
            ValueError: the keys are not those of a row.
        """
        names = [field.name for field in fields(Row)]
        if list(values) != names:
            raise ValueError(f"a row has {', '.join(names)}, not {', '.join(values)}")
        return Row(**(values | {"ours": math.nan if values["ours"] is None else values["ours"]}))


Benchmark = Callable[[bool], Iterator[Row]]
"""``rows`` of a module: takes ``quick``."""


def medians(*sides: Callable[[], object], repeat: int = REPEAT, warm_up: int = 1) -> list[float]:
    """Median milliseconds of each side, taken in turns; each runs ``warm_up`` times before.

    Every other round goes backwards: a side that leaves the caches hot or cold does so for either neighbour.
    The garbage collector rests meanwhile, as it would hit whichever side has its turn.
    """
    if not sides or repeat < 1:
        raise ValueError(f"medians of {len(sides)} sides and {repeat} rounds: at least one of each is needed")
    for side in sides:
        for _ in range(warm_up):
            side()
    order = list(range(len(sides)))
    times = np.empty((repeat, len(sides)))
    collecting = gc.isenabled()
    gc.disable()
    try:
        for row in times:
            for k in order:
                start = time.perf_counter()
                sides[k]()
                row[k] = time.perf_counter() - start
            order.reverse()
    finally:
        if collecting:
            gc.enable()
    return [float(t) for t in np.median(times, axis=0) * 1e3]


def compared(
    name: str,
    ours: Callable[[], object],
    baseline: Callable[[], object],
    least: float | None,
    repeat: int = REPEAT,
) -> Row:
    """Median milliseconds of both sides, in turns; ours has to be ``least`` times faster (None: informs)."""
    first, second = medians(ours, baseline, repeat=repeat)
    return against(name, first, second, "ms", least)


def against(name: str, ours: float, baseline: float, unit: str, least: float | None) -> Row:
    """Row of two known figures of which the smaller is the better; ``least`` as in :func:`compared`."""
    ratio = baseline / ours if ours > 0 else math.nan
    holds = None if least is None else bool(ratio >= least)
    target = "" if least is None else f">= {least:g}"
    return Row(name, ours, baseline, unit, ratio, target, holds)


def bounded(name: str, value: float, unit: str, most: float) -> Row:
    """Row of one figure that may be ``most`` at most; NaN does not hold."""
    return Row(name, float(value), None, unit, None, f"<= {most:g} {unit}".rstrip(), bool(value <= most))


def reached(name: str, value: float, unit: str, least: float) -> Row:
    """Row of one figure that has to be ``least`` at least; NaN does not hold."""
    return Row(name, float(value), None, unit, None, f">= {least:g} {unit}".rstrip(), bool(value >= least))


def informs(name: str, value: float, unit: str) -> Row:
    """Row of one figure without a target."""
    return Row(name, float(value), None, unit, None, "", None)


def failed(name: str, why: str) -> Row:
    """Row of a benchmark that came to no figure: it does not hold."""
    return Row(f"{name}: {why}", math.nan, None, "", None, "runs", False)
