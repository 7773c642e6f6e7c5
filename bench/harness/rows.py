"""A figure with what it is compared with and its verdict: what every benchmark yields.

A benchmark is a module with ``rows(asked) -> Iterator[Row]``, where ``asked`` are its parsed options (``quick`` always
among them), and, where it needs them, ``options(parser)``, which adds its own, and ``tables(rows, asked)``, which lays
out its rows more widely: Markdown by name. Times are medians of wall time of at least :data:`REPEAT` runs; the sides
of a comparison take turns in one process, so that both meet the same load.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

RUNS = "runs"
"""Target of a benchmark that came to no figure."""

REPEAT = 31  # runs behind every median; an odd number, so that the median is one of them


@dataclass(frozen=True)
class Row:
    """One figure of ours, the baseline's if there is one, and whether the target holds."""

    name: str  # what was measured, after the benchmark's name: ``match/top-k, 9527 stations``
    ours: float = math.nan  # our figure; NaN where there is none
    baseline: float | None = None
    unit: str = ""  # ``ms``, ``s``, ``MB``, ``%``
    ratio: float | None = None  # how many times better ours is; None where there is no baseline
    target: str = ""  # in words: ``>= 3`` (a ratio), ``<= 8 ms`` or ``>= 95 %``; empty where the row only informs
    holds: bool | None = None  # None where the row only informs
    said: str = ""  # shown in place of ``ours`` where one number does not say it
    details: dict[str, Any] = field(default_factory=dict)  # everything measured, for own tables and ``--json``

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, which knows no NaN: None stands for a figure that is none."""
        return dict(_plain(asdict(self)))

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Row:
        """Undo :meth:`to_dict`; ``ValueError`` where the keys are not those of a row."""
        names = [each.name for each in fields(Row)]
        if list(values) != names:
            raise ValueError(f"a row has {', '.join(names)}, not {', '.join(values)}")
        return Row(**(values | {"ours": math.nan if values["ours"] is None else values["ours"]}))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, type(None))) else str(value)


def medians(*sides: Callable[[], object], repeat: int = REPEAT, warm_up: int = 1) -> list[float]:
    """Median milliseconds of each side, taken in turns; each runs ``warm_up`` times before.

    Every other round goes backwards: a side that leaves the caches hot or cold does so for either neighbour.
    The garbage collector rests meanwhile, as it would hit the side whose turn it is.
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


def against(name: str, ours: float, baseline: float, unit: str, least: float | None) -> Row:
    """Row of two known figures of which the smaller is the better; ours ``least`` times better (None: informs)."""
    ratio = baseline / ours if ours > 0 else math.nan
    target, holds = ("", None) if least is None else (f">= {least:g}", bool(ratio >= least))
    return Row(name, ours, baseline, unit, ratio, target, holds)


def bounded(name: str, value: float, unit: str, most: float) -> Row:
    """Row of one figure that may be ``most`` at most; NaN does not hold."""
    return Row(name, float(value), None, unit, None, f"<= {most:g} {unit}".rstrip(), bool(value <= most))


def reached(name: str, value: float, unit: str, least: float) -> Row:
    """Row of one figure that has to be ``least`` at least; NaN does not hold."""
    return Row(name, float(value), None, unit, None, f">= {least:g} {unit}".rstrip(), bool(value >= least))


def judged(name: str, said: str, target: str, holds: bool | None, value: float = math.nan) -> Row:
    """Row of a finding in words, with the number behind it if there is one."""
    return Row(name, float(value), target=target, holds=holds, said=said)


def informs(name: str, value: float, unit: str, details: dict[str, Any] | None = None) -> Row:
    """Row of one figure without a target."""
    return Row(name, float(value), unit=unit, details=details or {})


def failed(name: str, why: str) -> Row:
    """Row of a benchmark that came to no figure: it does not hold."""
    return Row(f"{name}: {why}", target=RUNS, holds=False)
