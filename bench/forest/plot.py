"""A real forest: one plot that was scanned from the ground and from the air, sought among real airborne tiles.

The airborne scan of the plot is put into the middle of each tile, thinned to the tile's density; the query is the
mobile scan of the plot at several headings, and a virtual robot walks through that scan: a check, no statistic
(docs/forest.md). The mobile scan's own coordinates are wrong by 0.6 m and 1.4 degrees; those corrected are used.
"""

from __future__ import annotations

import tempfile
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.forest.methods import METHODS, Methods
from bench.forest.plot_walk import followed, walk
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
WRONG = 2.0  # metres: such a pose is a false one
_EYE = 1.5  # metres above the ground, where the robot is said to be
_VOXEL = 0.1  # metres: the mobile scan is as dense as no robot's
_RADIUS = 30.0
_CORNER = np.array([470600.0, 3810200.0, 2280.0])  # the corrected coordinates' origin
WALKS = ((1, 22.5), (2, 22.5), (3, 45.0), (7, 45.0), (8, 60.0), (6, 80.0))
"""Seed of each walk, and the degrees up and down that its lidar sees."""


def measured(data: Path, name: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Ask all methods for the plot in a tile, at each heading; let robots walk through it."""
    air, ground = _metres(data / "forest_plot" / "ALS_Clip.laz"), corrected(data)
    whole, shift = pasted(_metres(data / "forest_als" / name), air, np.random.default_rng(7))
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base.npy"
        np.save(base, (whole - whole.mean(axis=0)).astype(np.float32))
        base_map = BaseMap.build(base, radius=_RADIUS, learned=True)
    methods = Methods(base_map)
    moved, answers = ground + shift - whole.mean(axis=0), []
    for k in range(HEADINGS):
        drive = standing(moved, 0.4 + 2 * np.pi * k / HEADINGS)
        answers.append({"world": name, "kind": "real plot", "first": not k, **methods.ask(drive)})
    walks = [
        {"world": name, "seed": seed, "sees": sees, **followed(base_map, walk(moved, seed, np.radians(sees)), "auto")}
        for seed, sees in WALKS
    ]
    return answers, walks


def corrected(data: Path) -> Floats:
    """Return the mobile scan (N, 3) where it agrees with the airborne one, metres."""
    T = np.loadtxt(data / "forest_plot" / "T_als_mls.txt")
    return np.asarray(transform(T, _metres(data / "forest_plot" / "MLS_Clip.laz") - _CORNER) + _CORNER)


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
        answers, walks = measured(asked.data, name)
        share = 100 * success(answers, "after", EXACT_METRES, EXACT_DEGREES)
        yield informs(f"forest_plot/{name}: within 0.3 m and 1 deg", share, "%", {"answers": answers, "walks": walks})


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """AR@1 / AR@5 by method over all tiles and headings, and how exactly the plot was registered."""
    answers = [answer for row in rows for answer in row.details["answers"]]
    shown = [[method, recall_cell(answers, method)] for method in METHODS]
    share = success(answers, "after", EXACT_METRES, EXACT_DEGREES)
    shown.append(["registered within 0.3 m and 1 deg, %", f"{100 * share:.0f}"])
    shown.append(["registered: median metres off, wrong places included", medians(answers, "after", (2, 2))[0]])
    given = [each["found"] for each in answers if each["found"] is not None]
    off = sorted(metres for metres, _ in given)
    shown.append(["search: poses given by one keyframe, false ones", f"{len(given)}, {sum(m > WRONG for m in off)}"])
    shown.append(["search: median and largest metres off", f"{np.median(off):.2f}, {off[-1]:.2f}" if off else "-"])
    chance = 100 * np.mean([answer["chance"] for answer in answers])
    head = (f"AR@1 / AR@5, %, {len(answers)} queries, chance {chance:.1f}", "")
    walks = [each for row in rows for each in row.details["walks"]]
    return {
        "": noted(table(head, shown), "forest_plot DATA"),
        "walks": noted(table(WALKED, [walked(each) for each in walks]), "forest_plot DATA"),
    }


WALKED = ("tile", "sees, deg", "first fix m", "off m", "deg", "after that: posed %", "off m", "deg", "up m", "false")


def walked(way: dict[str, Any]) -> list[str]:
    """Return a row of the walks' table."""
    about = [str(way["world"]), f"+-{way['sees']:g}"]
    if way["first_fix_m"] is None:
        return [*about, *["-"] * 7, "0"]
    keys = ("first_off_m", "first_off_deg", "posed_after", "median_m", "median_deg", "median_up_m")
    digits = (2, 2, 0, 2, 2, 2)
    values = [way[key] * (100 if key == "posed_after" else 1) for key in keys]
    shown = [f"{value:.{digit}f}" for value, digit in zip(values, digits, strict=True)]
    return [*about, f"{way['first_fix_m']:.1f}", *shown, str(way["false"])]
