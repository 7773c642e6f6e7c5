"""Clouds as text: XYZ, TXT, CSV, ASC and PTS, one point a line, in bounded memory."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Floats

TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzi", ".xyzrgb")
"""Suffixes, lower case, of text that is read as points."""

_LINES = 100_000  # that are read at a time; set by hand
_MAX_LINE = 4096  # characters; a longer one is no point
_MAX_HEAD = 100  # lines of titles and comments before the first point
_COMMENTS = ("#", "//", ";", "%")
_NAMES = {
    "x": 0, "easting": 0, "east": 0, "rechtswert": 0, "coordinatex": 0,
    "y": 1, "northing": 1, "north": 1, "hochwert": 1, "coordinatey": 1,
    "z": 2, "height": 2, "elevation": 2, "altitude": 2, "hoehe": 2, "coordinatez": 2,
}  # fmt: skip
_DECIMAL_COMMAS = re.compile(r"^\s*-?\d+,\d+(?:[\s;\t]+-?\d+,\d+)+\s*$")


def read_text(path: Path) -> Cloud:
    """Read points from text: x, y and z, metres, in the first three columns or those that a line of titles names.

    Columns are parted by spaces, tabs, commas or semicolons. Lines that begin with #, // or ; and the number of points
    with which a PTS file begins are skipped, and what further columns hold.

    Raises:
        CloudError: a line is no point; the message names it. Decimal commas, or no points at all.
    """
    builder = CloudBuilder()
    with path.open(encoding="utf-8-sig", errors="replace", newline=None) as stream:
        parting, columns, first, number = _begin(path, stream)
        rows = first
        while rows:
            builder.add(_numbers(path, rows, parting, columns, number))
            number += len(rows)
            rows = list(islice(stream, _LINES))
    return builder.finish(os.fspath(path))


_Begin = tuple[str | None, tuple[int, ...], list[str], int]


def _begin(path: Path, stream: TextIO) -> _Begin:
    """Return what parts columns, the columns of x, y and z, the first line with a point, and its number."""
    columns: tuple[int, ...] = (0, 1, 2)
    for number, line in enumerate(_short_lines(path, islice(stream, _MAX_HEAD)), start=1):
        text = line.strip()
        if not text or text.startswith(_COMMENTS):
            named = _titles(text.lstrip("#/;% "))
            columns = named or columns
            continue
        if _DECIMAL_COMMAS.match(text):
            raise CloudError(f"{path}:{number}: {text[:60]!r} has decimal commas; write decimal points")
        parting = next((mark for mark in (";", ",", "\t") if mark in text), None)
        cells = _cells(text, parting)
        if all(map(_is_number, cells)):
            if len(cells) < 3:  # a count of points
                if len(cells) == 1 and path.suffix.lower() == ".pts":
                    continue
                raise CloudError(f"{path}:{number}: {text[:60]!r} has {len(cells)} columns; a point needs x, y and z")
            return parting, columns, [line], number
        named = _titles(text)
        if named is None and any(map(_is_number, cells)):
            raise CloudError(f"{path}:{number}: {text[:60]!r} is no point; write x y z, in metres")
        columns = named or columns
    raise CloudError(f"{path}: no point in the first {_MAX_HEAD} lines; write one point a line: x y z")


def _numbers(path: Path, rows: list[str], parting: str | None, columns: tuple[int, ...], number: int) -> Floats:
    """Return (N, 3) of lines, of which blank ones and comments are left out."""
    counts = path.suffix.lower() == ".pts"  # before each of its scans
    rows = ["" if _is_nothing(row, counts) else row for row in rows]
    kept = [row for row in rows if row]
    try:
        if parting is None or not any("  " in row for row in kept[:1]):
            out: Floats = np.loadtxt(kept, delimiter=parting, usecols=columns, ndmin=2, comments=None, dtype=np.float64)
            return out
    except ValueError:
        pass
    cells = []
    for at, row in enumerate(rows):
        if not row:
            continue
        words = _cells(row, parting)
        if len(words) <= max(columns) or not all(_is_number(words[k]) for k in columns):
            raise CloudError(f"{path}:{number + at}: {row.strip()[:60]!r} is no point; write x y z, in metres")
        cells.append([float(words[k]) for k in columns])
    return np.array(cells, dtype=np.float64).reshape(-1, 3)


def _is_nothing(row: str, counts: bool) -> bool:
    """Tell whether a line has no point: blank, a comment, or the count of the points that follow."""
    text = row.strip()
    return not text or text.startswith(_COMMENTS) or (counts and text.isdecimal())


def _titles(text: str) -> tuple[int, ...] | None:
    """Return the columns of x, y and z in a line of titles; None if it names none of them."""
    words = [re.sub(r"\(.*?\)|\[.*?\]|[^a-z]", "", word.lower()) for word in re.split(r"[\s,;]+", text.strip()) if word]
    found: dict[int, int] = {}
    for column, word in enumerate(words):
        if word in _NAMES:
            found.setdefault(_NAMES[word], column)
    return (found[0], found[1], found[2]) if len(found) == 3 else None


def _cells(line: str, parting: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in line.strip().split(parting)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _short_lines(path: Path, lines: Iterator[str]) -> Iterator[str]:
    for number, line in enumerate(lines, start=1):
        if len(line) > _MAX_LINE:
            raise CloudError(f"{path}:{number}: a line of {len(line)} characters is no point; write one point a line")
        yield line
