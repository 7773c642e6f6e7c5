"""Errors, covariance, loss and recovery of a tracked robot.

Ten plain drives, and drives with an event (:mod:`bench.tracking.drives`). NAME picks the scenarios whose names
contain it; worlds, maps and answers stay in ``--work``, so a run can be made in portions.

Coverage is the share of poses whose error lies within 1, 2, 3 sigma of the reported covariance: of one axis by itself,
of several by their squared Mahalanobis distance. Protection levels are judged by one pose per ten metres.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.scores import Track, errors, score
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged, number, table
from bench.tracking.drives import QUICK, SEEDS, Drive, Scenario, drift_share, scenarios, seen
from bench.tracking.levels import (
    PARTS,
    TO_ALERT,
    WITHIN,
    Sample,
    Squares,
    beyond_alert_limit,
    coverage_table,
    honest,
    level_table,
    pooled,
    shares,
    spread,
)
from bench.tracking.worlds import Recorded, map_of, open_world
from coview_stream import BaseMap, Localizer
from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.localization.result import Fix

MAX_METRES, MAX_DEGREES, MAX_RECOVERY = 0.12, 0.35, 20.0
"""The targets: root mean squares over the plain drives, and metres driven after an event."""

_JUDGED = ("x", "y", "z", "yaw", "x,y", "x,y,z")
"""What the coverage target is about; roll, pitch and the whole pose only inform."""

_COLUMNS = {
    "drift %": ("drift_percent", 1), "driven m": ("driven_m", 0), "right %": ("right_percent", 1),
    "first m": ("first_fix_m", 1), "rmse m": ("rmse_m", 3), "max m": ("max_m", 2), "rmse deg": ("rmse_deg", 2),
    "max deg": ("max_deg", 1), "false": ("false_frames", 0), "false s": ("false_s", 1),
    "beyond": ("beyond", 0), "alert s": ("alert_s", 1), "alert m": ("alert_m", 1), "HMI": ("misleading", 0),
    "> 0.5 m": ("doubtful_frames", 0), "lost": ("losses", 0), "back m": ("recovery_m", 1),
    "back s": ("recovery_s", 1), "p50 ms": ("p50_ms", 1), "p99 ms": ("p99_ms", 0),
}  # fmt: skip
"""Of the table: a drive's figure, or one of its worst event, and its decimals."""

Figures = dict[str, Any]


def options(parser: ArgumentParser) -> None:
    """Add the scenarios."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a scenario's name (all)")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"ten worlds after N ({SEEDS})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive with all its figures, then the targets."""
    every = QUICK if asked.quick else scenarios(asked.seeds)
    chosen = [each for each in every if not asked.names or any(name in each.name for name in asked.names)]
    if not chosen:
        raise InputError(f"no scenario like {' or '.join(asked.names)}; there are {', '.join(s.name for s in every)}")
    drives, parts = [], []
    samples: dict[str, list[Sample]] = {}
    for scenario in chosen:
        figures, squared, sample = measure(folder(), scenario)
        drives.append(figures)
        parts.append(squared)
        samples.setdefault(f"plain: {scenario.world.kind}" if scenario.plain else "events", []).append(sample)
        rmse = np.nan if figures["rmse_m"] is None else figures["rmse_m"]
        yield informs(f"tracking/{scenario.name}", rmse, "m", figures)
    together = pooled(parts)
    found = shares(together)
    yaw = 100 * (found["all"]["yaw"]["inside"] or [np.nan])[0]
    levels = level_table({name: Sample.joined(some) for name, some in samples.items()})
    details = {"coverage": found, "protection": levels}
    yield informs("tracking/poses whose yaw is within one sigma", yaw, "%", details)
    yield from verdicts(drives, found, asked.quick)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Drives, coverage, protection levels, and what was lost and found again."""
    drives = [row.details for row in rows if "rmse_m" in row.details]
    together = next(row.details for row in rows if "coverage" in row.details)
    return {
        "": table(("scenario", *_COLUMNS), [cells(figures) for figures in drives]),
        "coverage": coverage_table(together["coverage"]),
        "protection": together["protection"],
        "events": "\n".join(_events(drives)),
    }


def measure(folder: Path, scenario: Scenario) -> tuple[Figures, Squares, Sample]:
    """Return the figures of a scenario, the squared distances of its coverage, and poses of its protection levels.

    They are kept until the code changes.
    """
    bench = fingerprint("bench/tracking", "bench/accuracy/scores.py")
    spec = {"code": fingerprint(), "bench": bench, "scenario": repr(scenario.world)}

    def work() -> dict[str, Any]:
        recorded = open_world(folder, scenario.world)
        drive = scenario.drive(recorded.truth)
        track = follow(map_of(folder, scenario.world, scenario.variant), recorded, drive)
        drift = scenario.drift if drive.events else drift_share(drive.truth, drive.odometry)
        about = {"name": scenario.name, "plain": scenario.plain, "drift_percent": 100 * drift}
        error = errors(track, drive.truth)
        parts, sample = spread(track, error), Sample.of(track, error, drive.driven)
        beyond = beyond_alert_limit(track, error, drive.driven)
        about |= {
            "misleading": sum(each.misleading for each in beyond),
            "beyond": len(beyond),
            "alert_s": max((each.seconds for each in beyond), default=None),
            "alert_m": max((each.metres for each in beyond), default=None),
        }
        lists = {part: {name: values.tolist() for name, values in axes.items()} for part, axes in parts.items()}
        figures = about | score(track, drive.truth, drive.driven, drive.events)
        return {"figures": figures, "squares": lists, "sample": sample.to_json()}

    kept = remembered(folder / "tracking-results" / f"{scenario.name.replace('/', '-')}.json", spec, work)
    squares = {part: {n: np.array(each, float) for n, each in axes.items()} for part, axes in kept["squares"].items()}
    return kept["figures"], squares, Sample.from_json(kept["sample"])


def follow(site: Path, recorded: Recorded, drive: Drive) -> Track:
    """Feed frames and odometry of a drive to a new localizer, and nothing else; collect its answers."""
    localizer, seconds = Localizer(BaseMap.load(site)), np.zeros(len(drive))
    fixes: list[Fix | str] = []
    for k in range(len(drive)):
        cloud = seen(recorded.read(int(drive.frames[k])), int(drive.cover[k]), int(drive.frames[k]))
        begin = time.perf_counter()
        try:
            fixes.append(localizer.step(cloud, drive.odometry[k], float(drive.stamps[k])))
            seconds[k] = time.perf_counter() - begin
        except (CloudError, RunError) as error:
            fixes.append(str(error))
    return Track.of(fixes, drive.stamps, seconds)


def cells(figures: Figures) -> list[str]:
    """One line of the table; of several events the worst."""
    line = [figures["name"]]
    for key, digits in _COLUMNS.values():
        if key in figures:
            line.append(number(figures[key], digits))
        else:
            back = [event[key] for event in figures["events"]]
            line.append("" if not back else "never" if None in back else number(max(back), digits))
    return line


def verdicts(drives: Sequence[Figures], found: dict[str, dict[str, Any]], quick: bool = False) -> Iterator[Row]:
    """Judge all drives together; ``quick`` ones are too short for recovery and for ``found``, the coverage."""
    plain = [figures for figures in drives if figures["plain"]]
    for unit, key, most in (("m", "rmse_m", MAX_METRES), ("deg", "rmse_deg", MAX_DEGREES)):
        if plain:
            each = [np.inf if figures[key] is None else figures[key] for figures in plain]
            mean = float(np.sqrt(np.mean(np.square(each))))
            said = f"{mean:.3f} (worst drive {max(each):.3f})"
            yield judged(f"tracking/rmse of plain drives, {unit}", said, f"<= {most}", mean <= most, mean)
    false, seconds = (sum(figures[key] for figures in drives) for key in ("false_frames", "false_s"))
    yield judged("tracking/false frames", f"{false} ({seconds:.1f} s)", "0", false == 0, false)
    count = sum(figures["misleading"] for figures in drives)
    times, asked = sum(figures["beyond"] for figures in drives), f"<= {TO_ALERT[0]:.0f} s and {TO_ALERT[1]:.0f} m"
    longest = (max((figures[key] or 0.0 for figures in drives), default=0.0) for key in ("alert_s", "alert_m"))
    said = f"{times} times, {next(longest):.1f} s and {next(longest):.1f} m at most"
    yield judged("tracking/beyond the alert limit, to the alert", said, asked, not count, count)
    if quick:
        return
    if events := [event for figures in drives for event in figures["events"]]:
        metres = [np.inf if e["recovery_m"] is None else e["recovery_m"] for e in events]
        late = sum(m > MAX_RECOVERY for m in metres)
        said = f"{np.median(metres):.1f} median, {max(metres):.1f} worst; {late} of {len(metres)} later"
        yield judged("tracking/recovery, m driven", said, f"<= {MAX_RECOVERY:.0f}", not late, max(metres))
    for part in PARTS:
        if found[part]["yaw"]["frames"]:
            wrong = [name for name in _JUDGED if not honest(found[part][name])]
            said = f"out of it: {'; '.join(wrong)}" if wrong else "all within"
            yield judged(f"tracking/coverage, {part}", said, f"+-{100 * WITHIN:.0f} points", not wrong)


def _events(drives: Sequence[Figures]) -> list[str]:
    """List the losses by reason, and what each event came to."""
    lines: list[str] = []
    ends: list[str] = []
    for figures in drives:
        name = figures["name"]
        lines += [f"- {name}: lost {n} x, {reason}" for reason, n in Counter(figures["reasons"]).most_common()]
        for event in figures["events"]:
            m, s = event["recovery_m"], event["recovery_s"]
            back = "never right again" if m is None else f"right after {m:.1f} m, {s:.1f} s"
            ends.append(f"- {name}: {event['what']}: {event['false_s']:.1f} s false, {back}")
    return lines + ends
