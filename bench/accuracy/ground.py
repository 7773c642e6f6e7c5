"""The ground filter against labelled LAS files: ``python -m bench ground FILE.laz ...``.

Per file: type I, II and total error, the height error at labelled ground, seconds and peak memory.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.harness.files import peak_megabytes
from bench.harness.rows import Row, informs
from bench.harness.tables import number, table

_GROUND_CLASS = 2
_HEAD = (
    "file", "points", "type I %", "type II %", "total %", "|dz| p50 m", "p95 m", "ground %", "s", "MB"
)  # fmt: skip


def options(parser: ArgumentParser) -> None:
    """Add the files and the filter's settings."""
    parser.add_argument("files", nargs="+", type=Path, help="LAS or LAZ with ground labelled as class 2")
    parser.add_argument("--method", default="auto", choices=["auto", "cloth", "morphological"])
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE", help="fields of GroundConfig")


def rows(asked: Namespace) -> Iterator[Row]:
    """Filter each file and compare with its labels."""
    from coview_stream.basemap.ground import GroundConfig, ground_mask, ground_surface
    from coview_stream.clouds import read_cloud

    usual, fields = GroundConfig(), dict(item.split("=") for item in asked.set)
    config = GroundConfig(method=asked.method, **{k: type(getattr(usual, k))(float(v)) for k, v in fields.items()})
    for file in asked.files:
        cloud = read_cloud(file)
        start = time.perf_counter()
        mask = ground_mask(cloud.points, config)
        about = {"s": time.perf_counter() - start, "MB": peak_megabytes(), "points": len(mask)}
        about |= {"file": file.name, "ground": 100 * mask.mean(), "errors": [np.nan] * 3, "dz": [np.nan] * 2}
        if cloud.classification is not None and (cloud.classification == _GROUND_CLASS).any():
            label = cloud.classification == _GROUND_CLASS
            ground, surface = cloud.points[label], ground_surface(cloud.points, config)
            apart = np.abs(ground[:, 2] - surface.height_at(ground[:, :2]))
            first, second = (label & ~mask).sum() / label.sum(), (~label & mask).sum() / (~label).sum()
            about["errors"] = [100 * first, 100 * second, 100 * (label != mask).mean()]
            about["dz"] = np.percentile(apart, [50, 95]).tolist()
        yield informs(f"ground/{file.name}: total error", about["errors"][2], "%", about)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per file."""
    shown = [
        [
            of["file"], str(of["points"]), *(number(each, 2) for each in of["errors"]),
            *(number(each, 3) for each in of["dz"]), number(of["ground"], 1), number(of["s"], 1),
            number(of["MB"], 0),
        ]
        for of in (row.details for row in rows)
    ]  # fmt: skip
    return {"": table(_HEAD, shown)}
