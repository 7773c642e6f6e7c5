"""``locate --smooth`` against live poses and the truth: simulated drives, and the real sets of ``--data``.

Live and smoothed errors are over the same frames, those with a live pose; *only smoothed* are frames that had none
live. A pose is false more than 1 m or 5 degrees off; *beyond* counts poses outside their protection level.
NAME picks the runs whose names contain it; results stay in ``--work``.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.conditions import SETS, RealSet
from bench.accuracy.conditions import options as of_sets
from bench.accuracy.scores import FALSE_DEGREES, FALSE_METRES, Track, errors, rms
from bench.harness.files import built, fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged, listed
from bench.tracking.drives import CLOTH, FOG, SEEDS, Drive, kidnapped, run_of, slipped, start
from bench.tracking.worlds import World, map_of, open_world
from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.localization.offline import locate
from coview_stream.localization.result import Fix
from coview_stream.localization.smoothing import SmoothedPose
from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Run

_TOWN = World("town", "vlp16", SEEDS + 21, 240.0, 200.0, 4.0, 0.05)
_FOREST = World("sparse-forest", "os64", SEEDS + 22, 240.0, 160.0, 4.0, 0.02)
_CAMPUS = World("campus", "mid360", SEEDS + 23, 240.0, 200.0, 4.0, 0.02)


def covered(drive: Drive, cover: int, begin: float, end: float) -> Drive:
    """Lay something over the sensor between two distances, metres; the robot drives on."""
    over = drive.cover.copy()
    over[drive.at(begin) : drive.at(end)] = cover
    return replace(drive, cover=over)


DRIVES: Mapping[str, tuple[World, Callable[[Drive], Drive]]] = {
    "town, odometry drifts by 5 %": (_TOWN, partial(Drive.until, metres=200.0)),
    "forest": (_FOREST, partial(Drive.until, metres=160.0)),
    "campus, covered for 40 m": (_CAMPUS, partial(covered, cover=CLOTH, begin=80.0, end=120.0)),
    "town, fog for the first 60 m": (_TOWN, partial(covered, cover=FOG, begin=0.0, end=60.0)),
    "forest, fog for the first 40 m": (_FOREST, partial(covered, cover=FOG, begin=0.0, end=40.0)),
    "town, kidnapped": (_TOWN, partial(kidnapped, to=140.0, until=200.0)),
    "campus, slips every 30 m": (_CAMPUS, slipped),
}
"""World, and the change of its drive."""

REAL = tuple(f"{name}, {condition}" for name in SETS for condition in ("base", "drift", "near30", "back"))
"""Sets under conditions of ``python -m bench conditions``."""


def options(parser: ArgumentParser) -> None:
    """Add the runs."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a run's name (all)")
    of_sets(parser)


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per run, then the targets."""
    found = []
    for name in (*DRIVES, *REAL):
        if any(part in name for part in asked.names or ("",)) and not (asked.quick and not name.endswith(", base")):
            found.append({"name": name, **measure(folder(), name, asked.data)})
            rmse = found[-1]["smoothed_m"]
            yield informs(f"smooth/{name}", np.nan if rmse is None else rmse, "m", found[-1])
    yield from verdicts(found)


def verdicts(found: Sequence[Mapping[str, Any]]) -> Iterator[Row]:
    """Yield the targets of runs by their figures."""
    worse = [run["name"] for run in found if (run["smoothed_m"] or 0.0) > 1.02 * (run["live_m"] or 0.0)]
    yield judged("smooth/runs with a greater rmse than live", ", ".join(worse) or "none", "none", not worse)
    keys = ("only_false", "smoothed_beyond", "live_beyond", "live", "only_beyond", "only")
    false, beyond, live, poses, others, only = (sum(run[key] for run in found) for key in keys)
    yield judged("smooth/false poses of frames without a live one", str(false), "0", not false, false)
    allowed = live + 1e-3 * poses
    text = f"{beyond}, live {live}, of {poses}"
    yield judged("smooth/poses beyond their level, same frames", text, f"<= {allowed:.0f}", beyond <= allowed, beyond)
    name, allowed = "smooth/poses beyond their level, frames without a live one", 1e-3 * only
    yield judged(name, f"{others} of {only}", f"<= {allowed:.0f}", others <= allowed, others)


def measure(below: Path, name: str, data: Path) -> dict[str, Any]:
    """Return the figures of a run."""
    spec = {
        "code": fingerprint(),
        "bench": fingerprint("bench/tracking", "bench/accuracy"),
        "run": name,
        "world": repr(DRIVES[name][0] if name in DRIVES else ""),
    }

    def work() -> dict[str, Any]:
        if name in REAL:
            place, condition = name.split(", ")
            real, out = RealSet(data / place), below / "smoothing-runs" / place / condition
            real.spoil(condition, out)
            site = built(real.survey, below / "conditions" / "maps" / f"{place}.coview")
            return figures(BaseMap.load(site), open_run(out / "run"), read_tum(out / "truth.tum")[1])
        world, change = DRIVES[name]
        recorded = open_world(below, world)
        drive = change(start(recorded.truth, world.drift, world.seed))
        return figures(BaseMap.load(map_of(below, world)), run_of(recorded, drive), drive.truth)

    return remembered(below / "smoothing-results" / f"{name.replace(' ', '-')}.json", spec, work)


def figures(base_map: BaseMap, run: Run, truth: Floats) -> dict[str, Any]:
    """Locate and smooth a run with true poses (N, 4, 4); return its errors."""
    located = locate(base_map, run, smooth=True)
    frame = {float(stamp): k for k, stamp in enumerate(run.stamps)}
    answers: list[SmoothedPose | None] = [None] * len(run)
    for pose in located.smoothed or ():
        answers[frame[pose.stamp]] = pose
    live = np.full((len(run), 4, 4), np.nan)
    for stamp, T in zip(*located.filtered, strict=True):
        live[frame[float(stamp)]] = T
    smoothed = np.array([live[0] * np.nan if pose is None else pose.T_map_body for pose in answers])
    had, has = np.isfinite(live[:, 0, 0]), np.isfinite(smoothed[:, 0, 0])
    before, after = (_errors(poses, truth) for poses in (live, smoothed))
    fixes: list[Fix | None] = [None] * len(run)
    for fix in located.posed:
        fixes[frame[fix.stamp]] = fix
    return {
        "frames": len(run),
        "live": int(had.sum()),
        "without": int((~had).sum()),
        "only": int((has & ~had).sum()),
        **_statistics("live", before, _levels(fixes), had & has),
        **_statistics("smoothed", after, _levels(answers), had & has),
        **_statistics("only", after, _levels(answers), has & ~had),
        "kinds": Counter(pose.kind.value for pose in located.smoothed or ()),
    }


def _levels(poses: Sequence[SmoothedPose | Fix | None]) -> Floats:
    """Protection levels (N, 2), metres and degrees; NaN without a pose."""
    levels = [None if pose is None else pose.protection for pose in poses]
    return np.array([(np.nan, np.nan) if level is None else (level.metres, level.degrees) for level in levels])


def _errors(poses: Floats, truth: Floats) -> Floats:
    """Errors (N, 2), metres and degrees; NaN without a pose."""
    found = errors(Track.of_poses(np.arange(len(truth), dtype=np.float64), poses), truth)
    return np.column_stack([found.metres, found.degrees])


def _statistics(name: str, values: Floats, levels: Floats, chosen: Bools) -> dict[str, float | None]:
    """Figures of the chosen frames, whose keys begin with ``name``; None of no frame."""
    some = values[chosen]
    false = (some > (FALSE_METRES, FALSE_DEGREES)).any(axis=1).sum()
    out: dict[str, float | None] = {"false": int(false), "beyond": int((some > levels[chosen]).any(axis=1).sum())}
    for unit, column in zip(("m", "deg"), some.T, strict=True):
        found = (float(np.median(column)), float(column.max())) if len(column) else (None, None)
        out |= {unit: rms(column), f"median_{unit}": found[0], f"max_{unit}": found[1]}
    return {f"{name}_{key}": value for key, value in out.items()}


def _columns(title: str, name: str) -> tuple[tuple[str, str, int | None], ...]:
    keys = (("rmse m", "m", 3), ("median m", "median_m", 3), ("max m", "max_m", 2), ("rmse deg", "deg", 2),
            ("max deg", "max_deg", 2), ("beyond level", "beyond", 0))  # fmt: skip
    return tuple((f"{title}{text}", f"{name}_{key}", digits) for text, key, digits in keys)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Live and smoothed poses of the same frames, and poses of the other frames."""
    runs = [row.details for row in rows if row.details]
    same = (("run", "name", None), ("frames", "frames", 0), ("live", "live", 0))
    other = (
        ("run", "name", None),
        ("frames", "frames", 0),
        ("without a live pose", "without", 0),
        ("smoothed", "only", 0),
    )
    return {
        "same frames": listed((*same, *_columns("live: ", "live"), *_columns("smoothed: ", "smoothed")), runs),
        "frames without a live pose": listed(
            (*other, *_columns("", "only"), ("false", "only_false", 0)), [run for run in runs if run["without"]]
        ),
    }
