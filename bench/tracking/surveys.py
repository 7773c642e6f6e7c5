"""How robots are found and tracked on real airborne surveys of few points, whose other half is their world.

The map is one half of a square of a survey of ``COVIEW_DATA``, the world is made of the other half
(:mod:`bench.integrity.surveys`), and a robot drives 150 m to and fro, whole map searched. Both halves are of one flight
and the world has stairs of 0.75 m, so errors below half a metre say little. A pose is false from 3 m or 5 degrees off.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bench.accuracy.scores import Track, errors, score, times
from bench.harness.files import data, fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged, listed
from bench.integrity import surveys
from bench.integrity.plan import Run, plan
from bench.integrity.run import NEAR_DEGREES, NEAR_METRES, drive_of, map_of
from coview_stream import Localizer
from coview_stream.errors import InputError

LENGTH, SPEED = 150.0, 4.0  # metres, metres per second

COLUMNS = (
    ("survey, seed, lidar", "name", None), ("first fix m", "first_fix_m", 1), ("posed after it %", "posed_percent", 1),
    ("mean m", "mean_m", 2), ("max m", "max_m", 2), ("max deg", "max_deg", 1), ("false", "false_poses", 0),
    ("level m, median", "level_m", 2), ("beyond level", "beyond", 0), ("of poses", "poses", 0),
)  # fmt: skip


def options(parser: ArgumentParser) -> None:
    """Add the number of drives."""
    parser.add_argument(
        "--drives", type=int, default=24, metavar="N", help="up to three on each square of a survey (24)"
    )


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive, then the targets; InputError without surveys."""
    if not surveys.files():
        raise InputError(f"no surveys/*.laz in {data()} (COVIEW_DATA)")
    drives, count = list[dict[str, Any]](), 1 if asked.quick else asked.drives
    for run in (run for site in plan("surveys", 20 * count + 20) for run in site if run.family == "survey"):
        if len(drives) < count and (figures := measure(run)) is not None:
            drives.append(figures | {"way": figures["name"]})
            yield informs(f"surveys/{figures['name']}: mean error", figures["mean_m"] or np.nan, "m", drives[-1])
    false, beyond, poses = (sum(drive[key] for drive in drives) for key in ("false_poses", "beyond", "poses"))
    found = [drive["first_fix_m"] for drive in drives if drive["first_fix_m"] is not None]
    early = sum(metres <= 26.0 for metres in found)
    yield judged("surveys/found, and within 26 m", f"{len(found)} and {early} of {len(drives)}", "", None)
    yield judged("surveys/false poses", f"{false} of {poses}", "0", false == 0, false)
    yield judged("surveys/beyond level", f"{beyond} of {poses}", "", None, beyond)  # poses of a drive are alike


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Lay out the drives."""
    return {"": listed(COLUMNS, [row.details for row in rows if "poses" in row.details])}


def measure(run: Run) -> dict[str, Any] | None:
    """Return the figures of a drive, kept until the code changes; None where a square has no way to drive."""

    def work() -> dict[str, Any]:
        drive = drive_of(run, LENGTH, SPEED)
        if drive is None or drive.truth is None:
            return {"name": ""}
        localizer = Localizer(map_of(run))
        fixes = [localizer.step(drive.frame(k), drive.odometry[k], float(at)) for k, at in enumerate(drive.stamps)]
        track = Track.of(fixes, drive.stamps)
        off, known = errors(track, drive.truth), track.tracking
        levels = track.levels[known]
        beyond = (off.metres[known] > levels[:, 0]) | (off.degrees[known] > levels[:, 1])
        return {
            "name": f"{surveys.place_of(run.seed).stem}, {run.seed}-{run.number}, {run.sensor}",
            **score(track, drive.truth, drive.driven, ()),
            "false_times": times(known & ((off.metres > NEAR_METRES) | (off.degrees > NEAR_DEGREES))),
            "poses": int(known.sum()),
            "posed_percent": 100.0 * float(known[known.argmax() :].mean()),
            "mean_m": float(off.metres[known].mean()) if known.any() else None,
            "false_poses": int(((off.metres > NEAR_METRES) | (off.degrees > NEAR_DEGREES))[known].sum()),
            "level_m": float(np.median(levels[:, 0])) if known.any() else None,
            "beyond": int(beyond.sum()),
        }

    spec = {
        "code": fingerprint(),
        "bench": fingerprint("bench/integrity", "bench/accuracy/scores.py", "bench/tracking/surveys.py"),
        "bytes": {file.name: file.stat().st_size for file in surveys.files()},
    }
    found = remembered(folder() / "surveys" / f"{run.seed}-{run.number}.json", spec, work)
    return found if found["name"] else None
