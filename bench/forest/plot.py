"""A real forest: one plot that was scanned from the ground and from the air, sought among real airborne tiles.

The airborne scan of the plot is put into the middle of each tile, thinned to the tile's density; the query is the
mobile scan of the plot at several headings: a check, no statistic (docs/forest.md).
"""

from __future__ import annotations

import tempfile
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.forest.methods import METHODS, Methods
from bench.forest.tables import EXACT_DEGREES, EXACT_METRES, medians, recall_cell, success
from bench.forest.worlds import Drive, noted
from bench.harness.rows import Row, informs
from bench.harness.tables import table
from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds import read_cloud
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform

TILES = ("bcts_2.laz", "bcts_3.laz")
HEADINGS = 4
_EYE = 1.5  # metres above the ground, where the robot is said to be
_VOXEL = 0.1  # metres: the mobile scan is as dense as no robot's
_RADIUS = 30.0


def measured(data: Path, name: str) -> list[dict[str, Any]]:
    """Ask all methods for the plot in a tile, at each heading."""
    air, ground = (_metres(data / "forest_plot" / name) for name in ("ALS_Clip.laz", "MLS_Clip.laz"))
    whole, shift = pasted(_metres(data / "forest_als" / name), air, np.random.default_rng(7))
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base.npy"
        np.save(base, (whole - whole.mean(axis=0)).astype(np.float32))
        methods = Methods(BaseMap.build(base, radius=_RADIUS, learned=True))
    moved, answers = ground + shift - whole.mean(axis=0), []
    for k in range(HEADINGS):
        drive = standing(moved, 0.4 + 2 * np.pi * k / HEADINGS)
        answers.append({"world": name, "kind": "real plot", "first": not k, **methods.ask(drive)})
    return answers


def pasted(tile: Floats, plot: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Put a plot (N, 3) into the middle of a tile (M, 3): the points of both, and the shift (3,) of the plot."""
    hole = (np.abs(tile[:, :2] - _middle(tile)) <= 0.5 * np.ptp(plot[:, :2], axis=0)).all(axis=1)
    shift = np.array([*(_middle(tile) - _middle(plot)), lowest(tile[hole]) - lowest(plot)])
    thin = plot[rng.random(len(plot)) < min(1.0, hole.sum() / len(plot))]
    return np.concatenate([tile[~hole], thin + shift]), shift


def _middle(points: Floats) -> Floats:
    return np.asarray(0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)))


def lowest(points: Floats) -> float:
    """Typical height of the ground in a cloud (N, 3): the median of the lowest points of cells of 4 m."""
    cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / 4.0).astype(np.int64)
    found, cell = np.unique(cells, axis=0, return_inverse=True)
    least = np.full(len(found), np.inf)
    np.minimum.at(least, cell.ravel(), points[:, 2])
    return float(np.median(least))


def standing(points: Floats, heading: float) -> Drive:
    """Return what a robot in the middle of a scan (N, 3) would have seen, if it saw all; its odometry is turned."""
    middle = _middle(points)
    near = np.hypot(*(points[:, :2] - middle).T) < 3.0
    truth = pose_from(rot_z(heading), np.array([*middle, lowest(points[near]) + _EYE]))
    seen = transform(inverse(truth), points)
    cells = np.floor(seen / _VOXEL).astype(np.int64)
    kept = seen[np.unique(cells, axis=0, return_index=True)[1]]
    return Drive("mls", 0.0, np.eye(4)[None], (kept.astype(np.float32),), truth)


def _metres(file: Path) -> Floats:
    cloud = read_cloud(file)
    return np.asarray(cloud.points.astype(np.float64) + cloud.origin)


def options(parser: ArgumentParser) -> None:
    """Add where the scans are."""
    parser.add_argument("data", type=Path, help="holds forest_plot/ and forest_als/")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per tile, with every answer."""
    for name in TILES[1:] if asked.quick else TILES:
        answers = measured(asked.data, name)
        share = 100 * success(answers, "after", EXACT_METRES, EXACT_DEGREES)
        yield informs(f"forest_plot/{name}: within 0.3 m and 1 deg", share, "%", {"answers": answers})


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """AR@1 / AR@5 by method over all tiles and headings, and how exactly the plot was registered."""
    answers = [answer for row in rows for answer in row.details["answers"]]
    shown = [[method, recall_cell(answers, method)] for method in METHODS]
    share = success(answers, "after", EXACT_METRES, EXACT_DEGREES)
    shown.append(["registered within 0.3 m and 1 deg, %", f"{100 * share:.0f}"])
    shown.append(["registered: median metres off, wrong places included", medians(answers, "after", (2, 2))[0]])
    chance = 100 * np.mean([answer["chance"] for answer in answers])
    head = (f"AR@1 / AR@5, %, {len(answers)} queries, chance {chance:.1f}", "")
    return {"": noted(table(head, shown), "forest_plot DATA")}
