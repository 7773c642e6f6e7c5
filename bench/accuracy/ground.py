"""The ground filter against labelled LAS files: ``python -m bench ground FILE.laz ...``.

Per file and method, in per cent: type I (ground taken for something else), type II (something else taken for ground),
and both over all points.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.harness.rows import Row, informs, number, table
from coview_stream.basemap.ground import GroundConfig, ground_mask
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
            mask = ground_mask(cloud.points, GroundConfig(method=method))
            errors = [100 * each.mean() for each in (~mask[label], mask[~label], label != mask)]
            about = {"file": file.name, "errors": errors}
            yield informs(f"ground/{file.name}, {method}: total error", errors[2], "%", about)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per file, both methods side by side."""
    shown: dict[str, list[str]] = {}
    for row in rows:
        errors = " / ".join(number(each, 2) for each in row.details["errors"])
        shown.setdefault(row.details["file"], []).append(errors)
    head = ("file", *(f"{method} I / II / total" for method in METHODS))
    return {"": table(head, [[file, *cells] for file, cells in shown.items()])}
