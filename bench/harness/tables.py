"""Tables that read well in a terminal and paste as Markdown, and their places in a page."""

from __future__ import annotations

import datetime
import importlib.metadata
import math
import platform
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from bench.harness.rows import Row
from coview_stream.errors import InputError

NOTHING = "-"

HEAD = ("benchmark", "ours", "baseline", "unit", "ratio", "target", "verdict")
WIDTHS = (60, 9, 9, 7, 7, 12, 13)
_VERDICTS = {True: "holds", False: "DOES NOT HOLD", None: "informs"}
_PACKAGES = (
    "numpy", "scipy", "taichi", "quadrants", "open3d-cpu", "small-gicp", "kiss-matcher", "map-closures"
)  # fmt: skip
_PLACE = re.compile(r"(<!-- table: ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)


def line(cells: Sequence[str], widths: Sequence[int]) -> str:
    """One row; the first column to the left, the others to the right."""
    first, *rest = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
    return "| " + " | ".join([first.strip().ljust(widths[0]), *rest]) + " |"


def rule(widths: Sequence[int]) -> str:
    """Draw the line between a table's head and its body."""
    return "|" + "|".join(["-" * (widths[0] + 2), *("-" * (w + 1) + ":" for w in widths[1:])]) + "|"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lay out a whole table, its columns as wide as they need to be."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    return "\n".join([line(head, widths), rule(widths), *(line(row, widths) for row in rows)])


def number(value: float | None, digits: int) -> str:
    """Write a number, or a dash for none."""
    return NOTHING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def cells(row: Row) -> list[str]:
    """One line of the table that every benchmark has."""
    return [
        row.name, row.said or _figure(row.ours), _figure(row.baseline), row.unit, _figure(row.ratio), row.target,
        _VERDICTS[row.holds],
    ]  # fmt: skip


def _figure(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def benchmark_of(row: Row) -> str:
    """Name of the benchmark that a row is of: what stands first in its name."""
    return re.split(r"[/,:]", row.name, maxsplit=1)[0].strip()


def suite_tables(rows: Sequence[Row]) -> dict[str, str]:
    """One table per benchmark, as ``bench NAME``, without that name in front of every row."""
    out = {}
    for name in dict.fromkeys(map(benchmark_of, rows)):
        shown = [cells(row) for row in rows if benchmark_of(row) == name]
        short = [[first.removeprefix(name).lstrip("/,: ") or first, *rest] for first, *rest in shown]
        out[f"bench {name}"] = table(HEAD, short)
    return out


def missed(rows: Sequence[Row]) -> str:
    """List the rows whose targets do not hold."""
    found = [f"* {row.name}: {row.said or _figure(row.ours)} {row.unit}".rstrip() for row in rows if row.holds is False]
    held = sum(row.holds is True for row in rows)
    return "\n".join([f"{held} of {held + len(found)} targets hold.", *[""] * bool(found), *found])


def filled(page: str, tables: Mapping[str, str]) -> str:
    """Put tables into their places, ``<!-- table: NAME -->`` to ``<!-- end -->``; ``InputError`` without any place."""
    if not {match[2] for match in _PLACE.finditer(page)} & set(tables):
        raise InputError(f"no place for {', '.join(tables)}: '<!-- table: NAME -->' and '<!-- end -->'")

    def put(match: re.Match[str]) -> str:
        return f"{match[1]}{tables[match[2]]}\n{match[3]}" if match[2] in tables else match[0]

    return _PLACE.sub(put, page)


def machine() -> str:
    """Describe machine and environment in one line."""
    from coview_kernels.runtime import cores

    versions = []
    for package in _PACKAGES:
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.*)", info.read_text()) if info.is_file() else None
    processor = found[1].strip() if found else platform.processor() or platform.machine()
    day = datetime.date.today().isoformat()
    return f"Measured {day}: {cores()} cores of {processor}; Python {platform.python_version()}, {', '.join(versions)}."
