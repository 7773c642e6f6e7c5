"""A figure with its comparison and verdict, as every benchmark yields it; tables for a terminal and for Markdown.

A benchmark is a module with ``rows(asked) -> Iterator[Row]``; ``asked`` are its parsed options, always with ``quick``.
It may have ``options(parser)``, which adds options, and ``tables(rows, asked)``, which returns Markdown tables by name.
Times are medians of wall time; the sides of a comparison take turns in one process.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

REPEAT = 31  # runs behind every median; odd, so the median is one of them
NOTHING = "-"

HEAD = ("benchmark", "ours", "baseline", "unit", "ratio", "target", "verdict")
WIDTHS = (60, 9, 9, 7, 7, 12, 13)
_VERDICTS = {True: "holds", False: "DOES NOT HOLD", None: "informs"}


@dataclass(frozen=True)
class Row:
    """One figure of ours, the baseline's if there is one, and whether the target holds."""

    name: str  # the benchmark's name, then the figure: ``match/top-k, 9527 stations``
    ours: float = math.nan  # NaN where there is no figure
    baseline: float | None = None
    unit: str = ""  # ``ms``, ``s``, ``MB``, ``%``
    ratio: float | None = None  # how many times better ours is
    target: str = ""  # ``>= 3`` (a ratio), ``<= 8 ms``; empty where the row only informs
    holds: bool | None = None  # None where the row only informs
    text: str = ""  # shown in place of ``ours`` where one number is not enough
    details: dict[str, Any] = field(default_factory=dict)  # everything measured, for tables and ``--json``

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON; NaN becomes None."""
        return dict(_plain(asdict(self)))

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Row:
        """Undo :meth:`to_dict`; ``ValueError`` where the keys are not those of a row."""
        names = [entry.name for entry in fields(Row)]
        if list(values) != names:
            raise ValueError(f"a row has {', '.join(names)}, not {', '.join(values)}")
        return Row(**(values | {"ours": math.nan if values["ours"] is None else values["ours"]}))

    def cells(self) -> list[str]:
        """Return the cells of the table that every benchmark has."""
        return [
            self.name, self.text or _figure(self.ours), _figure(self.baseline), self.unit, _figure(self.ratio),
            self.target, _VERDICTS[self.holds],
        ]  # fmt: skip


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, type(None))) else str(value)


def medians(*sides: Callable[[], object], repeat: int = REPEAT, warm_up: int = 1) -> list[float]:
    """Median milliseconds of each side, taken in turns after ``warm_up`` runs each, without the garbage collector.

    Every other round goes backwards, so both neighbours of a side get its hot or cold caches.
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
    """Return the row of two figures, smaller is better; the target is ``least`` times better (None: informs)."""
    ratio = baseline / ours if ours > 0 else math.nan
    target, holds = ("", None) if least is None else (f">= {least:g}", bool(ratio >= least))
    return Row(name, ours, baseline, unit, ratio, target, holds)


def bounded(name: str, value: float, unit: str, most: float) -> Row:
    """Return the row of a figure that must be at most ``most``; NaN does not hold."""
    return Row(name, float(value), None, unit, None, f"<= {most:g} {unit}".rstrip(), bool(value <= most))


def reached(name: str, value: float, unit: str, least: float) -> Row:
    """Return the row of a figure that must be at least ``least``; NaN does not hold."""
    return Row(name, float(value), None, unit, None, f">= {least:g} {unit}".rstrip(), bool(value >= least))


def judged(name: str, text: str, target: str, holds: bool | None, value: float = math.nan) -> Row:
    """Return the row of a finding in words, with its number if there is one."""
    return Row(name, float(value), target=target, holds=holds, text=text)


def informs(name: str, value: float, unit: str, details: dict[str, Any] | None = None) -> Row:
    """Return the row of a figure without a target."""
    return Row(name, float(value), unit=unit, details=details or {})


def failed(name: str, why: str) -> Row:
    """Return the row of a benchmark without a figure; it does not hold."""
    return Row(f"{name}: {why}", target="runs", holds=False)


def line(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return a table row, the first column left-aligned, the others right-aligned."""
    first, *rest = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
    return "| " + " | ".join([first.strip().ljust(widths[0]), *rest]) + " |"


def rule(widths: Sequence[int]) -> str:
    """Return the line between a table's head and body."""
    return "|" + "|".join(["-" * (widths[0] + 2), *("-" * (w + 1) + ":" for w in widths[1:])]) + "|"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with columns as wide as needed."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    return "\n".join([line(head, widths), rule(widths), *(line(row, widths) for row in rows)])


def listed(columns: Sequence[tuple[str, str, int | None]], figures: Iterable[Mapping[str, Any]]) -> str:
    """Return a table of figures; columns are heading, key and decimals, None for a text."""
    rows = [[str(f[key]) if k is None else number(f[key], k) for _, key, k in columns] for f in figures]
    return table([head for head, *_ in columns], rows)


def number(value: float | None, digits: int) -> str:
    """Write a number, or a dash for none."""
    return NOTHING if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _figure(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def interval(events: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Clopper-Pearson's two-sided interval of a share."""
    one_sided = 0.5 * (1.0 + confidence)
    return 1.0 - upper(runs - events, runs, one_sided), upper(events, runs, one_sided)


def upper(events: int, runs: int, confidence: float = 0.95) -> float:
    """Return Clopper-Pearson's one-sided upper bound of a share; 1 without runs."""
    from scipy.stats import beta

    if not 0 <= events <= runs:
        raise ValueError(f"{events} events of {runs} runs: use 0 to {runs} events")
    return 1.0 if events == runs else float(beta.ppf(confidence, events + 1, runs - events))
