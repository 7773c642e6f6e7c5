"""The ground filter against labelled LAS files: ``python -m bench ground FILE.laz ...``.

Per file and method, in per cent: type I (ground taken for something else), type II (something else taken for ground),
and both over all points.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.harness.rows import Row, informs, listed
from coview_stream.basemap.ground import ground_mask
from coview_stream.clouds import read_cloud
from coview_stream.errors import InputError

METHODS = ("cloth", "morphological")
_GROUND_CLASS = 2


def options(parser: ArgumentParser) -> None:
    """Add the files."""
    parser.add_argument("files", nargs="+", type=Path, help="LAS or LAZ with ground labelled as class 2")


def rows(asked: Namespace) -> Iterator[Row]:
    """Filter each file and compare with its labels."""
    for file in asked.files:
        cloud = read_cloud(file)
        if cloud.classification is None or not (cloud.classification == _GROUND_CLASS).any():
            raise InputError(f"{file}: no point is labelled as ground (class 2)")
        label = cloud.classification == _GROUND_CLASS
        for method in METHODS:
            mask = ground_mask(cloud.points, method)
            errors = [100 * each.mean() for each in (~mask[label], mask[~label], label != mask)]
            about = {"file": file.name, "method": method, "I": errors[0], "II": errors[1], "total": errors[2]}
            yield informs(f"ground/{file.name}, {method}: total error", errors[2], "%", about)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per file and method."""
    heads = (("file", "file", None), ("method", "method", None), ("I", "I", 2), ("II", "II", 2), ("total", "total", 2))
    return {"": listed(heads, [row.details for row in rows])}
