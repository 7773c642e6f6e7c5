"""Faults of sensors, drivers and clocks: how long poses go on, whether they are false, and when the cause is named.

Each drive is localized undisturbed and with each fault of :mod:`bench.faults.faults`, frame by frame, in this process:
simulated ones, and the real runs of ``--data`` (``base.laz``, ``run/``, ``truth.tum``; not part of the repository). A
pose is false if it is more than 3 m or 5 degrees off. A cause is named by the reason of a frame without a pose, by a
clause about the calibration, or by the error of a frame that is refused, if it was not said before the fault. Results
stay in ``--work``, so a run can be made in portions.
"""

from __future__ import annotations

import re
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.conditions import SETS, set_of
from bench.accuracy.scores import Track, errors
from bench.faults.faults import FAULTS, UNDISTURBED, Fault, Feed
from bench.harness.files import add_data, built, fingerprint, folder, remembered
from bench.harness.rows import NOTHING, Row, judged, listed
from bench.harness.worlds import prepared_run, world_name
from coview_stream import BaseMap, Localizer
from coview_stream.clouds import read_tum
from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.localization.result import Fix, calibration_says
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

FALSE_METRES, FALSE_DEGREES = 3.0, 5.0
RISK = 1e-3  # share of poses that may exceed their protection level
NAMED_S = 5.0  # seconds of driving within which bad input is named

_SIMULATED = {
    world_name(config): config
    for config in (
        SimulationConfig("town", "vlp16", seed=6111, length=50.0, speed=2.0),
        SimulationConfig("campus", "mid360", seed=6112, length=50.0, speed=2.0),
        SimulationConfig("forest", "os64", seed=6113, length=50.0, speed=2.0),
    )
}
WORLDS = (*_SIMULATED, *SETS)


def options(parser: ArgumentParser) -> None:
    """Add faults, worlds and the folder of the real runs."""
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="FAULT", help="faults whose names contain one of these"
    )
    parser.add_argument(
        "--worlds", nargs="+", default=[], metavar="NAME", help=f"of {', '.join(WORLDS)}; or their parts"
    )
    add_data(parser)


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive and fault with all its figures, then the targets."""
    there = [name for name in WORLDS if name in _SIMULATED or (asked.data / name).exists()]
    worlds = [name for name in there if any(part in name for part in asked.worlds or ("",))][
        : 1 if asked.quick else None
    ]
    faults = [fault for fault in FAULTS if any(part in fault.name for part in asked.only or ("",))]
    if not worlds or not faults:
        raise InputError(f"nothing to do; worlds are {', '.join(there)}; faults: {', '.join(f.name for f in FAULTS)}")
    found: list[dict[str, Any]] = []
    for world in worlds:
        for fault in (UNDISTURBED, *(faults[:2] if asked.quick else faults)):
            found.append(measure(world, fault, asked.data))
            text, false = _short(found[-1]), found[-1]["false"]
            yield Row(f"faults/{world}, {fault.name}", false, text=text, details=found[-1])
    yield from verdicts(found)


def measure(world: str, fault: Fault, data: Path) -> dict[str, Any]:
    """Return the figures of a drive with a fault, unless they are there."""
    file = folder() / "faults" / world / f"{re.sub('[^a-z0-9]+', '-', fault.name.lower())}.json"
    spec = {"code": fingerprint(), "bench": fingerprint("bench/faults", "bench/accuracy/scores.py")}

    def work() -> dict[str, Any]:
        site, feed = _opened(world, data)
        return {"world": world, "fault": fault.name, **scored(fault, fault.of(feed, world), site)}

    return remembered(file, spec, work)


def _short(figures: dict[str, Any]) -> str:
    """Return the figures of a drive in a line."""
    words = [f"posed {figures['posed']}/{figures['frames']}", f"false {figures['false']}", f"beyond {figures['over']}"]
    if not figures["goes_on"] and figures["last_s"] is not None:
        words.append(f"ends after {figures['last_s']:.1f} s")
    if figures["to_name"]:
        words.append("not named" if figures["named_s"] is None else f"named after {figures['named_s']:.1f} s")
    return ", ".join(words)


@lru_cache(1)
def _opened(world: str, data: Path) -> tuple[BaseMap, Feed]:
    """Return the map of a world and its drive, which are made unless they are there."""
    config = _SIMULATED.get(world)
    at = set_of(world, data).folder if config is None else prepared_run(folder(), config)
    site = built(at / "base.laz", folder() / "faults" / "maps" / f"{world}.coview")
    run, (_, truth) = open_run(at / "run"), read_tum(at / "truth.tum")
    return BaseMap.load(site), Feed.of([frame.points for frame in run], run.stamps, run.poses, truth)


def scored(fault: Fault, feed: Feed, site: BaseMap) -> dict[str, Any]:
    """Localize a drive from its first frame on; score it. Seconds and metres count from the fault's beginning."""
    localizer, fixes = Localizer(site), list[Fix | None]()
    named: tuple[int, str] | None = None
    before: set[str] = set()  # clauses of the time before the fault
    for k in range(len(feed)):
        try:
            fix = localizer.step(feed.clouds[k], feed.odometry[k], float(feed.stamps[k]))
            said = _said(fix)
        except (CloudError, RunError) as error:
            fix, said = None, [str(error)]
        fixes.append(fix)
        if k < feed.begins:
            before = {_without_numbers(clause) for clause in said}
        elif named is None and fault.named:
            new = (clause for clause in said if _without_numbers(clause) not in before)
            named = next(((k, clause) for clause in new if re.search(fault.named, clause)), None)
    track = Track.of(fixes, feed.stamps)
    off, known = errors(track, feed.truth), track.tracking
    false = known & ((off.metres > FALSE_METRES) | (off.degrees > FALSE_DEGREES))
    over = known & ((off.metres > track.levels[:, 0]) | (off.degrees > track.levels[:, 1]))
    since, metres = feed.clock - feed.clock[feed.begins], feed.way - feed.way[feed.begins]
    after = known.copy()
    after[: feed.begins] = False
    last = int(np.flatnonzero(after)[-1]) if after.any() else None
    return {
        "bad_input": fault.bad_input, "to_name": bool(fault.named), "frames": len(feed), "posed": int(known.sum()),
        "posed_after": int(after.sum()), "frames_after": len(feed) - feed.begins,
        "first_fix_m": float(feed.way[known.argmax()]) if known.any() else None,
        "false": int(false.sum()), "over": int(over.sum()),
        "worst_m": float(off.metres[known].max()) if known.any() else None,
        "worst_deg": float(off.degrees[known].max()) if known.any() else None,
        "goes_on": last is not None and bool(since[-1] - since[last] < 1.0),
        "last_s": None if last is None else float(since[last]), "last_m": None if last is None else float(metres[last]),
        "named_s": None if named is None else float(since[named[0]]),
        "named_m": None if named is None else float(metres[named[0]]),
        "name": "" if named is None else named[1],
    }  # fmt: skip


def _without_numbers(clause: str) -> str:
    return re.sub(r"[\d.]+", "", clause)


def _said(fix: Fix) -> list[str]:
    """Return the clauses that status, ``watch`` and ``locate`` print of a fix."""
    reason = [fix.evidence.reason] if fix.evidence is not None and fix.T_map_body is None else []
    return reason + ([] if fix.calibration is None else calibration_says(fix.calibration, fix.evidence))


def verdicts(found: Sequence[dict[str, Any]]) -> Iterator[Row]:
    """Judge all drives together."""
    false = sum(each["false"] for each in found)
    runs = sum(each["false"] > 0 for each in found)
    yield judged("faults/false frames", f"{false} (in {runs} of {len(found)} runs)", "0", false == 0, false)
    over, posed = (sum(each[key] for each in found) for key in ("over", "posed"))
    target = f"<= {RISK:g} of them"
    yield judged("faults/beyond protection level", f"{over} of {posed} poses", target, over <= RISK * posed, over)
    if bad := [each for each in found if each["bad_input"]]:
        late = [each for each in bad if each["named_s"] is None or each["named_s"] > NAMED_S]
        text = f"{len(bad) - len(late)} of {len(bad)} runs"
        yield judged(f"faults/bad input named within {NAMED_S:g} s", text, "all", not late, len(late))


COLUMNS = (
    ("fault", "fault", None), ("runs", "runs", 0), ("posed %", "posed", 1), ("after it %", "after", 1),
    ("first fix m", "first_m", 1), ("false", "false", 0), ("in runs", "false_runs", 0), ("beyond level", "over", 0),
    ("worst m", "worst_m", 2), ("deg", "worst_deg", 1), ("goes on in", "goes_on", 0),
    ("else ends after s", "last_s", 1), ("m", "last_m", 1), ("named in", "named", None),
    ("after s", "named_s", 1),
)  # fmt: skip


def _of_fault(name: str, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all runs with a fault: sums, shares, medians of first fixes, and the worst of the rest."""

    def worst(key: str, among: Sequence[dict[str, Any]]) -> float:
        return max((each[key] for each in among if each[key] is not None), default=float("nan"))

    ended = [each for each in runs if not each["goes_on"]]
    named = [each for each in runs if each["named_s"] is not None]
    return {
        "fault": name, "runs": len(runs),
        "posed": 100.0 * np.mean([each["posed"] / each["frames"] for each in runs]),
        "after": 100.0 * np.mean([each["posed_after"] / max(1, each["frames_after"]) for each in runs]),
        "first_m": np.median([each["first_fix_m"] for each in runs if each["first_fix_m"] is not None] or [np.nan]),
        **{key: sum(each[key] for each in runs) for key in ("false", "over", "goes_on")},
        "false_runs": sum(each["false"] > 0 for each in runs),
        **{key: worst(key, runs) for key in ("worst_m", "worst_deg")},
        **{key: worst(key, ended) for key in ("last_s", "last_m")},
        "named": str(len(named)) if runs[0]["to_name"] else NOTHING,
        "named_s": worst("named_s", named),
    }  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All faults, each over all worlds; and the undisturbed runs."""
    found = [row.details for row in rows if "fault" in row.details]
    names = dict.fromkeys(each["fault"] for each in found)
    every = [_of_fault(name, [each for each in found if each["fault"] == name]) for name in names]
    plain = [
        each | {"share": 100.0 * each["posed"] / each["frames"]} for each in found if each["fault"] == "undisturbed"
    ]
    columns = (
        ("world", "world", None), ("frames", "frames", 0), ("posed %", "share", 1), ("first fix m", "first_fix_m", 1),
        ("false", "false", 0), ("beyond level", "over", 0), ("worst m", "worst_m", 2), ("deg", "worst_deg", 1),
    )  # fmt: skip
    return {"": listed(COLUMNS, every), "undisturbed": listed(columns, plain)}
