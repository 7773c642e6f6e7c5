"""Clouds as plain rows of numbers: text (one point per line), NPY, and the ``.bin`` of KITTI and nuScenes."""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Floats, Floats32

_PLAIN = (".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzi", ".xyzrgb")
TEXT_SUFFIXES = (*_PLAIN, *(f"{suffix}.gz" for suffix in _PLAIN))
"""Suffixes of text clouds, lower case."""

_LINES = 100_000  # read at a time
_MAX_LINE = 4096  # characters of a point
_MAX_UNPACKED = 30  # times a file's size: gzip packs the digits of points to between a third and a tenth
_MAX_HEAD = 100  # lines of titles and comments before the first point
_COMMENTS = ("#", "//", ";", "%")
_TITLES = {
    "x": 0, "easting": 0, "east": 0, "rechtswert": 0, "coordinatex": 0,
    "y": 1, "northing": 1, "north": 1, "hochwert": 1, "coordinatey": 1,
    "z": 2, "height": 2, "elevation": 2, "altitude": 2, "hoehe": 2, "coordinatez": 2,
}  # fmt: skip
_DECIMAL_COMMAS = re.compile(r"^\s*-?\d+,\d+(?:[\s;\t]+-?\d+,\d+)+\s*$")

_KITTI_COLUMNS, _NUSCENES_COLUMNS = 4, 5
_COLUMNS = (3, 4, 5, 6, 7, 8)  # of float32 rows
_COMMON_ROW = 840  # values, a multiple of each number of columns, so that the same values judge all of them
# tested with 3 to 8 columns on frames of three scanners (tests/clouds/test_rows.py)
_JUDGED, _MIN_JUDGED = 100_000, 3000  # values
_BINS = 64
_ALIKE = 0.9  # share of the most information; the least number of columns above it is taken, not a multiple of it
_CLEARLY, _LEAST = 1.4, 0.02  # factor and nats by which another number has to beat the expected one
_CHUNK = 1_000_000  # rows


def read_text(path: Path) -> Cloud:
    """Read x, y and z (metres) from text, in the first three columns or those that a title line names.

    Spaces, tabs, commas or semicolons separate the columns. Other columns, lines that begin with #, //, ; or %, and
    the numbers of points in a PTS file are skipped. CloudError names a line that is not a point.
    """
    builder = CloudBuilder()
    try:
        with _opened(path) as stream:
            separator, columns, rows, number = _begin(path, stream)
            while rows:
                builder.add(_numbers(path, rows, separator, columns, number))
                number += len(rows)
                rows = list(islice(stream, _LINES))
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise CloudError(f"{path}: damaged or truncated gzip ({error}); copy it again") from error
    return builder.finish(os.fspath(path))


def _opened(path: Path) -> TextIO:
    if path.suffix.lower() != ".gz":
        return path.open(encoding="utf-8-sig", errors="replace", newline=None)
    unpacked = io.BufferedReader(_Unpacked(path))
    return io.TextIOWrapper(unpacked, encoding="utf-8-sig", errors="replace", newline=None)


class _Unpacked(io.RawIOBase):
    """Bytes of a gzip file, no more than a text of points of its size can have."""

    def __init__(self, path: Path) -> None:
        self._file, self._path = gzip.GzipFile(path), path
        self._left = _MAX_UNPACKED * path.stat().st_size + _LINES

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(len(buffer))
        self._left -= len(data)
        if self._left < 0:
            raise CloudError(f"{self._path}: unpacks to more than {_MAX_UNPACKED} times its size: no text of points")
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def suffix_of(path: Path) -> str:
    """Return a cloud's suffix in lower case, with both parts of ``.xyz.gz``."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() + suffix if suffix == ".gz" else suffix


def _begin(path: Path, stream: TextIO) -> tuple[str | None, tuple[int, ...], list[str], int]:
    """Return the separator, the columns of x, y and z, the first line with a point, and its number."""
    columns: tuple[int, ...] = (0, 1, 2)
    for number, line in enumerate(islice(stream, _MAX_HEAD), start=1):
        if len(line) > _MAX_LINE:
            raise CloudError(
                f"{path}:{number}: a line of {len(line)} characters is not a point; write one point a line"
            )
        text = line.strip()
        if not text or text.startswith(_COMMENTS):
            columns = _titled_columns(text.lstrip("#/;% ")) or columns
            continue
        if _DECIMAL_COMMAS.match(text):
            raise CloudError(f"{path}:{number}: {text[:60]!r} has decimal commas; write decimal points")
        separator = next((mark for mark in (";", ",", "\t") if mark in text), None)
        cells = [cell.strip().strip('"') for cell in text.split(separator)]
        if all(map(_is_number, cells)):
            if len(cells) >= 3:
                return separator, columns, [line], number
            if len(cells) == 1 and suffix_of(path).startswith(".pts"):  # the number of points
                continue
            raise CloudError(f"{path}:{number}: {text[:60]!r} has {len(cells)} columns; a point needs x, y and z")
        titled = _titled_columns(text)
        if titled is None and any(map(_is_number, cells)):
            raise CloudError(f"{path}:{number}: {text[:60]!r} is not a point; write x y z, in metres")
        columns = titled or columns
    raise CloudError(f"{path}: no point in the first {_MAX_HEAD} lines; write one point a line: x y z")


def _numbers(path: Path, rows: list[str], separator: str | None, columns: tuple[int, ...], number: int) -> Floats:
    """Parse lines to points (N, 3), except blank lines, comments, and a PTS file's numbers of points."""
    counted = suffix_of(path).startswith(".pts")
    # rows are not stripped, as an empty first cell between tabs is a column too
    rows = [
        "" if (text := row.strip()).startswith(_COMMENTS) or (counted and text.isdecimal()) else row for row in rows
    ]
    points = [row for row in rows if row.strip()]
    try:
        if separator is None or not any("  " in row for row in points[:1]):
            out: Floats = np.loadtxt(
                points, delimiter=separator, usecols=columns, ndmin=2, comments=None, dtype=np.float64
            )
            return out
    except ValueError:
        pass
    cells = []
    for at, row in enumerate(rows):
        if not row.strip():
            continue
        words = [cell.strip().strip('"') for cell in row.strip("\r\n ").split(separator)]
        if len(words) <= max(columns) or not all(_is_number(words[k]) for k in columns):
            raise CloudError(f"{path}:{number + at}: {row.strip()[:60]!r} is not a point; write x y z, in metres")
        cells.append([float(words[k]) for k in columns])
    return np.array(cells, dtype=np.float64).reshape(-1, 3)


def _titled_columns(text: str) -> tuple[int, ...] | None:
    """Return the columns of x, y and z in a title line; None if it does not name all three."""
    words = [re.sub(r"\(.*?\)|\[.*?\]|[^a-z]", "", word.lower()) for word in re.split(r"[\s,;]+", text.strip()) if word]
    columns: dict[int, int] = {}
    for column, word in enumerate(words):
        if word in _TITLES:
            columns.setdefault(_TITLES[word], column)
    return (columns[0], columns[1], columns[2]) if len(columns) == 3 else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_npy(path: Path) -> Cloud:
    """Read an array (N, 3 or more) with x, y and z in metres in the first three columns; CloudError if it is none."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:  # NumPy parses the header as Python: a damaged one may raise anything
        reason = " ".join(str(error).split())[:120]
        raise CloudError(f"{path}: damaged or truncated NPY ({reason}); save the array again") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise CloudError(f"{path}: NPY does not hold an array of numbers; save (N, 3) floats")
    if array.ndim != 2 or array.shape[1] < 3:
        raise CloudError(f"{path}: NPY array has shape {array.shape}; save (N, 3) floats with columns x, y, z")
    builder = CloudBuilder()
    wide = np.float32 if array.dtype == np.float32 else np.float64
    for start in range(0, len(array), _CHUNK):
        builder.add(np.array(array[start : start + _CHUNK, :3], dtype=wide))
    return builder.finish(os.fspath(path))


def read_bin(path: Path) -> Cloud:
    """Read rows of little-endian float32: KITTI's x, y, z, intensity, or nuScenes' ``.pcd.bin`` with a fifth column.

    Raises:
        CloudError: the size is not a multiple of a row, or the numbers look like rows of another length.
    """
    nuscenes = path.name.lower().endswith(".pcd.bin")
    columns = _NUSCENES_COLUMNS if nuscenes else _KITTI_COLUMNS
    size = path.stat().st_size
    if size % (4 * columns):
        dataset, names = ("nuScenes", "x, y, z, intensity, ring") if nuscenes else ("KITTI", "x, y, z, intensity")
        raise CloudError(
            f"{path}: {size} bytes are not a multiple of a {dataset} row ({4 * columns} bytes: float32 {names}); "
            "truncated, or of another layout: copy it again or convert it to PCD or PLY"
        )
    values = np.fromfile(path, dtype="<f4")
    likely = likely_columns(values, columns)
    if likely != columns:
        raise CloudError(
            f"{path}: looks like rows of {likely} float32, not of {columns}; "
            f"np.save('cloud.npy', np.fromfile(name, '<f4').reshape(-1, {likely})[:, :3]) makes a file that can be read"
        )
    builder = CloudBuilder()
    builder.add(values.reshape(-1, columns)[:, :3])
    return builder.finish(os.fspath(path))


def likely_columns(values: Floats32, expected: int) -> int:
    """Guess the number of columns in a file of float32 rows.

    The right number maximises the mutual information of column and value, because heights, intensities and rings have
    other distributions than x and y, and with a wrong row length every column mixes all of them. Returns ``expected``
    unless another number is clearly better.
    """
    values = values[:_JUDGED]
    values = values[: len(values) // _COMMON_ROW * _COMMON_ROW]
    if len(values) < _MIN_JUDGED:
        return expected
    edges = np.unique(np.quantile(values[np.isfinite(values)], np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    bins = np.searchsorted(edges, values, side="right")
    count, information = len(edges) + 1, {}
    for columns in _COLUMNS:  # nats
        at = np.arange(len(bins)) % columns * count + bins
        share = np.bincount(at, minlength=columns * count).reshape(columns, count) / len(bins)
        independent = share.sum(axis=1, keepdims=True) * share.sum(axis=0, keepdims=True)
        filled = share > 0
        information[columns] = float(np.sum(share[filled] * np.log(share[filled] / independent[filled])))
    best = min(columns for columns in _COLUMNS if information[columns] > _ALIKE * max(information.values()))
    return best if information[best] > _CLEARLY * information[expected] + _LEAST else expected
