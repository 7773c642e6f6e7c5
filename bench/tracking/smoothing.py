"""``locate --smooth`` against live poses and the truth: simulated drives, and the real sets of ``--data``.

Live and smoothed errors are over the same frames, those with a live pose; *only smoothed* are frames that had none
live. A pose is false more than 1 m or 5 degrees off; *beyond* counts smoothed poses outside their protection level.
NAME picks the runs whose names contain it; results stay in ``--work``.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
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


def options(parser: ArgumentParser) -> None:
    """Add the runs."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a run's name (all)")
    of_sets(parser)


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per run, then the targets."""
    found = []
    for name in (*DRIVES, *SETS):
        if any(part in name for part in asked.names or ("",)) and not (asked.quick and name in DRIVES):
            found.append({"name": name, **measure(folder(), name, asked.data)})
            rmse = found[-1]["smoothed_m"]
            yield informs(f"smooth/{name}", np.nan if rmse is None else rmse, "m", found[-1])
    worse = [run["name"] for run in found if (run["smoothed_m"] or 0.0) > 1.02 * (run["live_m"] or 0.0)]
    yield judged("smooth/runs with a greater rmse than live", ", ".join(worse) or "none", "none", not worse)
    for key, text in (("false", "false poses of frames without a live one"), ("beyond", "poses beyond their level")):
        count = sum(run[key] for run in found)
        allowed = 1e-3 * sum(run["poses"] for run in found) if key == "beyond" else 0.0
        yield judged(f"smooth/{text}", str(count), f"<= {allowed:.1f}", count <= allowed, count)


def measure(below: Path, name: str, data: Path) -> dict[str, Any]:
    """Return the figures of a run."""
    bench = fingerprint("bench/tracking", "bench/accuracy")
    spec = {"code": fingerprint(), "bench": bench, "run": repr(DRIVES.get(name, name))}

    def work() -> dict[str, Any]:
        if name in SETS:
            real = RealSet(data / name)
            site = built(real.survey, below / "conditions" / "maps" / f"{name}.coview")
            return figures(BaseMap.load(site), open_run(real.folder / "run"), read_tum(real.folder / "truth.tum")[1])
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
    levels = np.array([(np.inf, np.inf) if p is None else (p.protection.metres, p.protection.degrees) for p in answers])
    had, has = np.isfinite(live[:, 0, 0]), np.isfinite(smoothed[:, 0, 0])
    before, after = (_errors(poses, truth) for poses in (live, smoothed))
    common, only = had & has, has & ~had
    return {
        "frames": len(run),
        "live": int(had.sum()),
        "poses": int(has.sum()),
        **_statistics("live", before, common),
        **_statistics("smoothed", after, common),
        "only": int(only.sum()),
        **_statistics("only", after, only),
        "false": int((only & ((after[:, 0] > FALSE_METRES) | (after[:, 1] > FALSE_DEGREES))).sum()),
        "beyond": int((has & (after > levels).any(axis=1)).sum()),
        "kinds": {stretch.kind.value: stretch.frames for stretch in located.stretches},
    }


def _errors(poses: Floats, truth: Floats) -> Floats:
    """Errors (N, 2), metres and degrees; NaN without a pose."""
    count, states = len(truth), np.where(np.isnan(poses[:, 0, 0]), "LOST", "TRACKING").tolist()
    track = Track(np.arange(count), states, poses, np.full((count, 6, 6), np.nan), np.full((count, 2), np.nan))
    found = errors(track, truth)
    return np.column_stack([found.metres, found.degrees])


def _statistics(name: str, values: Floats, chosen: Bools) -> dict[str, float | None]:
    some = values[chosen]
    keys = ("m", "median_m", "max_m", "deg", "max_deg")
    if not len(some):
        return {f"{name}_{key}": None for key in keys}
    metres, degrees = some.T
    found = (rms(metres), float(np.median(metres)), float(metres.max()), rms(degrees), float(degrees.max()))
    return {f"{name}_{key}": value for key, value in zip(keys, found, strict=True)}


COLUMNS = (
    ("run", "name", None), ("frames", "frames", 0), ("live", "live", 0),
    ("live: rmse m", "live_m", 3), ("median", "live_median_m", 3), ("max", "live_max_m", 2),
    ("rmse deg", "live_deg", 2),
    ("smoothed: rmse m", "smoothed_m", 3), ("median", "smoothed_median_m", 3), ("max", "smoothed_max_m", 2),
    ("rmse deg", "smoothed_deg", 2),
    ("only smoothed: frames", "only", 0), ("rmse m", "only_m", 3), ("median", "only_median_m", 3),
    ("max", "only_max_m", 2), ("max deg", "only_max_deg", 2), ("false", "false", 0), ("beyond", "beyond", 0),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs."""
    return {"": listed(COLUMNS, [row.details for row in rows if row.details])}
