"""Tables that read well in a terminal and paste as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

NOTHING = "-"


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
    return NOTHING if value is None else f"{value:.{digits}f}"
