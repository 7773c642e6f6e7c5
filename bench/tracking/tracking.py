"""Errors, covariance, loss and recovery of a tracked robot.

Ten plain drives, and drives with an event (:mod:`bench.tracking.drives`). NAME picks the scenarios whose names contain
it; results stay in ``--work``, so a run can be made in portions.

Coverage is the share of poses whose error lies within 1, 2, 3 sigma of the reported covariance: of one axis by itself,
of several by their squared Mahalanobis distance.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from bench.accuracy.scores import Errors, Track, errors, exposed, score
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import NOTHING, Row, informs, judged, listed, number, table
from bench.tracking.drives import SEEDS, Scenario, follow, scenarios, start
from bench.tracking.protection import TO_ALERT, beyond_alert_limit, misleading
from bench.tracking.worlds import map_of, open_world
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats

MAX_METRES, MAX_DEGREES, MAX_RECOVERY = 0.12, 0.35, 20.0
"""The targets: root mean squares over the plain drives, and metres driven after an event."""

_JUDGED = ("x", "y", "z", "yaw", "x,y", "x,y,z")
"""What the coverage target is about; roll, pitch and the whole pose only inform."""

COLUMNS = (
    ("scenario", "name", None), ("driven m", "driven_m", 0), ("right %", "right_percent", 1), ("rmse m", "rmse_m", 3),
    ("max m", "max_m", 2), ("rmse deg", "rmse_deg", 2), ("false", "false_frames", 0), ("lost", "losses", 0),
    ("back m", "back_m", None),
)  # fmt: skip

FIRST_MINUTE = 60.0  # seconds after a fix in which its covariance is judged apart
PARTS = ("first minute", "later")

NOMINAL = tuple(float(p) for p in chi2.cdf([1.0, 4.0, 9.0], 1))  # shares that 1, 2 and 3 sigma promise

AXES: dict[str, tuple[int, ...]] = {
    "x": (0,), "y": (1,), "z": (2,), "roll": (3,), "pitch": (4,), "yaw": (5,),
    "x,y": (0, 1), "x,y,z": (0, 1, 2), "pose": (0, 1, 2, 3, 4, 5),
}  # fmt: skip
"""One axis alone, or several by their squared Mahalanobis distance."""

WITHIN = 0.05  # share by which an observed coverage may differ from the nominal one

Squares = dict[str, dict[str, Floats]]
"""Squared Mahalanobis distances of poses, by part of the time since a fix and by name of the axes."""


def since_fix(track: Track) -> Floats:
    """(N,) seconds since the fix that each pose goes back to, NaN where there is none.

    A fix is the first pose after a search (SEARCHING or LOST); a doubt in between does not end it.
    """
    out = np.full(len(track.stamps), np.nan)
    fixed: float | None = None
    for k, (state, known) in enumerate(zip(track.states, track.tracking, strict=True)):
        if state in ("SEARCHING", "LOST"):
            fixed = None
        elif known:
            fixed = float(track.stamps[k]) if fixed is None else fixed
            out[k] = track.stamps[k] - fixed
    return out


def squares(twist: Floats, covariances: Floats, axes: Sequence[int]) -> Floats:
    """(N,) squared Mahalanobis distances over some axes; infinite where a covariance is none."""
    pick = np.asarray(axes)
    error, cov = twist[:, pick], covariances[:, pick[:, None], pick]
    sane: Bools = np.asarray(np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(error).all(axis=1))
    cov = np.where(sane[:, None, None], cov, np.eye(len(pick)))
    # metres stand beside radians: compare each by its own size
    scale = np.sqrt(np.abs(np.einsum("nii->ni", cov)))
    scale = np.where(scale > 0, scale, 1.0)
    level = cov / (scale[:, :, None] * scale[:, None, :])
    sane &= np.linalg.eigvalsh(level)[:, 0] > 1e-12
    unit, out = (error / scale)[sane], np.full(len(twist), np.inf)
    out[sane] = np.einsum("ni,ni->n", unit, np.linalg.solve(level[sane], unit[:, :, None])[:, :, 0])
    return out


def spread(track: Track, error: Errors) -> Squares:
    """Squared distances of all poses in the ``first minute`` after a fix and ``later``."""
    age = since_fix(track)
    return {
        part: {name: squares(error.twist[mask], track.covariances[mask], axes) for name, axes in AXES.items()}
        for part, mask in zip(PARTS, (age < FIRST_MINUTE, age >= FIRST_MINUTE), strict=True)
    }


def pooled(drives: Sequence[Squares]) -> Squares:
    """Put those of several drives together, and add ``all``, which is both parts."""
    out = {part: {name: np.concatenate([[], *(d[part][name] for d in drives)]) for name in AXES} for part in PARTS}
    return out | {"all": {name: np.concatenate([out[part][name] for part in PARTS]) for name in AXES}}


def coverage(squared: Floats, count: int) -> dict[str, Any]:
    """Shares within 1, 2 and 3 sigma (of ``count`` axes: within the chi-square quantiles of the same shares)."""
    inside = [float((squared <= limit).mean()) for limit in chi2.ppf(NOMINAL, count)] if len(squared) else None
    return {"frames": len(squared), "inside": inside}


def shares(squared: Squares) -> dict[str, dict[str, Any]]:
    """Coverage by part and axes."""
    return {
        part: {name: coverage(values, len(AXES[name])) for name, values in by_axes.items()}
        for part, by_axes in squared.items()
    }


def honest(part: dict[str, Any]) -> bool:
    """Whether shares are within :data:`WITHIN` of the promised ones."""
    inside = part["inside"]
    return inside is not None and bool(np.all(np.abs(np.subtract(inside, NOMINAL)) <= WITHIN))


def coverage_table(parts: dict[str, dict[str, Any]]) -> str:
    """Lay out shares in per cent, marked where out of their band."""

    def percent(inside: Sequence[float] | None) -> str:
        return NOTHING if inside is None else " / ".join(f"{100 * share:.1f}" for share in inside)

    columns, lines = (*PARTS, "all"), []
    for name in AXES:
        entries = [parts[part][name] for part in columns]
        cells = [percent(of["inside"]) + " !" * (of["inside"] is not None and not honest(of)) for of in entries]
        lines.append([name, percent(NOMINAL), *cells])
    lines.append(["poses", "", *(str(parts[part]["yaw"]["frames"]) for part in columns)])
    return table(["coverage, %", "promised", *columns], lines)


Figures = dict[str, Any]


def options(parser: ArgumentParser) -> None:
    """Add the scenarios."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a scenario's name (all)")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help=f"ten worlds after N ({SEEDS})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive with all its figures, then the targets."""
    known = scenarios(asked.seeds, asked.quick)
    chosen = [scenario for scenario in known if any(name in scenario.name for name in asked.names or ("",))]
    if not chosen:
        raise InputError(f"no scenario like {' or '.join(asked.names)}; there are {', '.join(s.name for s in known)}")
    drives, parts = [], []
    for scenario in chosen:
        figures, squared = measure(folder(), scenario)
        drives.append(figures)
        parts.append(squared)
        rmse = np.nan if figures["rmse_m"] is None else figures["rmse_m"]
        yield informs(f"tracking/{scenario.name}", rmse, "m", figures | {"way": scenario.world.name})
    found = shares(pooled(parts))
    yaw = 100 * (found["all"]["yaw"]["inside"] or [np.nan])[0]
    yield informs("tracking/poses whose yaw is within one sigma", yaw, "%", {"coverage": found})
    yield from verdicts(drives, found, asked.quick)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Drives, and coverage."""
    drives = [row.details for row in rows if "rmse_m" in row.details]
    coverage = next(row.details["coverage"] for row in rows if "coverage" in row.details)
    for figures in drives:  # of several events the latest recovery
        back = figures["recoveries_m"]
        figures["back_m"] = "" if not back else "never" if None in back else number(max(back), 1)
    return {"": listed(COLUMNS, drives), "coverage": coverage_table(coverage)}


def measure(folder: Path, scenario: Scenario) -> tuple[Figures, Squares]:
    """Return the figures of a scenario, and the squared distances of its coverage."""
    bench = fingerprint("bench/tracking", "bench/accuracy/scores.py")
    spec = {"code": fingerprint(), "bench": bench, "scenario": repr(scenario.world)}

    def work() -> dict[str, Any]:
        recorded = open_world(folder, scenario.world)
        drive = scenario.change(start(recorded.truth, scenario.drift, scenario.world.seed))
        track = follow(map_of(folder, scenario.world, scenario.variant), recorded, drive)
        error = errors(track, drive.truth)
        parts, beyond = spread(track, error), beyond_alert_limit(track, error, drive.driven)
        about = {
            "name": scenario.name,
            "plain": scenario.name.startswith("plain/"),
            "misleading": misleading(beyond),
            "beyond": beyond,
        }
        lists = {part: {name: values.tolist() for name, values in axes.items()} for part, axes in parts.items()}
        return {"figures": about | score(track, drive.truth, drive.driven, drive.events), "squares": lists}

    kept = remembered(folder / "tracking-results" / f"{scenario.name.replace('/', '-')}.json", spec, work)
    squares = {part: {n: np.array(each, float) for n, each in axes.items()} for part, axes in kept["squares"].items()}
    return kept["figures"], squares


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
    yield exposed("tracking", "false poses", sum(figures["false_times"] for figures in drives), drives)
    count = sum(figures["misleading"] for figures in drives)
    beyond = [time for figures in drives for time in figures["beyond"]]
    longest, furthest = np.max([(0.0, 0.0), *beyond], axis=0)
    text = f"{len(beyond)} times, {longest:.1f} s and {furthest:.1f} m at most"
    allowed = f"<= {TO_ALERT[0]:.0f} s and {TO_ALERT[1]:.0f} m"
    yield judged("tracking/beyond the alert limit, to the alert", text, allowed, not count, count)
    if quick:
        return
    if back := [metres for figures in drives for metres in figures["recoveries_m"]]:
        metres = [np.inf if m is None else m for m in back]
        late = sum(m > MAX_RECOVERY for m in metres)
        said = f"{np.median(metres):.1f} median, {max(metres):.1f} worst; {late} of {len(metres)} later"
        yield judged("tracking/recovery, m driven", said, f"<= {MAX_RECOVERY:.0f}", not late, max(metres))
    for part in PARTS:
        if found[part]["yaw"]["frames"]:
            wrong = [name for name in _JUDGED if not honest(found[part][name])]
            said = f"out of it: {'; '.join(wrong)}" if wrong else "all within"
            yield judged(f"tracking/coverage, {part}", said, f"+-{100 * WITHIN:.0f} points", not wrong)
