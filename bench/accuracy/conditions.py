"""Real runs under the conditions of real robots: a leaning sensor, bad odometry, fewer beams, gaps, another direction.

Each set of ``--data`` (``base.laz``, ``run/``, ``truth.tum``; these are no part of the repository) is spoilt as
``bench/accuracy/spoil.py`` says and localized by ``coview-stream locate``, one process per run, on the map that
``coview-stream build`` makes of ``base.laz``. ``--before COMMIT`` has an earlier commit do the same, with its own map,
and puts its figures before ours in every cell. What is done stays in ``--work``: an interrupted benchmark resumes.

A frame is false if its pose is more than 1 m or 5 degrees off; *share* is how many of the frames get a pose, per cent
of how many of the unspoilt run's do.
"""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.accuracy.real_runs import RealSet, located
from bench.harness.files import code_line, fingerprint, folder
from bench.harness.pinned import Code, pinned, today
from bench.harness.rows import Row, informs, judged
from bench.harness.suite import ROOT
from bench.harness.tables import NOTHING, number, table
from coview_stream.errors import InputError

SETS = ("riverside_a", "kitti04", "handheld_livox")
CONDITIONS = (
    *("base", "pitch:1", "pitch:2", "pitch:3", "roll:3", "odo:5:0.5", "odo:-5:0.5", "drift", "drift#2"),
    *("pitch:2+odo:5:0.5", "pitch:-3+roll:2+drift"),
    *("beams16", "near30", "sparse3", "back", "rev180"),
)
LEAST_SHARE = 85.0  # per cent of the unspoilt run's poses
MOST_METRES, MOST_DEGREES = 0.3, 1.0  # of every first fix
_ASKED = ("pitch", "roll", "odo", "drift")  # conditions that LEAST_SHARE is asked of
_ARROW = " > "

Runs = dict[str, dict[str, Any]]  # scores by code, "before" and "now"


def add_sets(parser: ArgumentParser, sets: Sequence[str]) -> None:
    """Add where the sets are, and which."""
    here = Path(os.environ.get("COVIEW_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=here, metavar="DIR", help="holds the sets (COVIEW_DATA)")
    parser.add_argument("--sets", nargs="+", default=list(sets), metavar="NAME", help=f"folders ({', '.join(sets)})")


def options(parser: ArgumentParser) -> None:
    """Add the sets, the conditions and the code that is compared with."""
    add_sets(parser, SETS)
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), metavar="NAME")
    parser.add_argument("--before", metavar="COMMIT", help="an earlier commit, measured on the same runs")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs at a time (1)")


def codes(asked: Namespace) -> dict[str, tuple[Code, str]]:
    """Return what is measured: the code with what its results depend on, the earlier one first."""
    now = {"now": (today(), fingerprint())}
    before = getattr(asked, "before", None)
    return {"before": (pinned(before), before), **now} if before else now


def map_of(code: Code, name: str) -> Path:
    """Return where a code's map of that name is kept."""
    return folder() / "conditions" / f"maps-{code.version[:10]}" / f"{name}.coview"


def measured(real: RealSet, condition: str, asked: Namespace) -> Runs:
    """Localize a set under a condition with each code."""
    name = condition.replace(":", "_")
    run = real.variant(condition, folder() / "conditions" / "runs" / real.name / name)
    found: Runs = {}
    for label, (code, version) in codes(asked).items():
        out = folder() / "conditions" / f"runs-{version[:10]}" / real.name / name
        found[label] = located(code, version, map_of(code, real.name), run, out)
    return found


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per set and condition, then the targets."""
    sets = [RealSet(asked.data / name).checked() for name in (asked.sets[-1:] if asked.quick else asked.sets)]
    conditions = list(dict.fromkeys(("base", *(asked.conditions[:2] if asked.quick else asked.conditions))))
    for real in sets:
        for code, _ in codes(asked).values():
            code.built([real.survey], map_of(code, real.name))
    every = [(real, condition) for real in sets for condition in conditions]
    unspoilt: dict[str, Runs] = {}
    yielded = []
    with ThreadPoolExecutor(max(asked.jobs, 1)) as pool:
        waiting = [pool.submit(measured, real, condition, asked) for real, condition in every]
        try:
            for (real, condition), each in zip(every, waiting, strict=True):
                found = each.result()
                base = unspoilt.setdefault(real.name, found)
                for label, scores in found.items():
                    scores["share"] = share(scores, base[label])
                details = {"set": real.name, "condition": condition, "runs": found}
                yielded.append(details)
                percent = 100.0 * found["now"]["posed"] / found["now"]["frames"]
                yield informs(f"conditions/{real.name}, {condition}: posed", percent, "%", details)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    yield from verdicts(yielded)


def share(scores: dict[str, Any], base: dict[str, Any]) -> float | None:
    """Return how many of the frames have a pose, per cent of how many the unspoilt run gave one."""
    if not base["posed"]:
        return None
    return float(100.0 * (scores["posed"] / scores["frames"]) / (base["posed"] / base["frames"]))


def verdicts(found: Sequence[dict[str, Any]]) -> Iterator[Row]:
    """Judge the code of today on all runs together."""
    now = [(each["set"], each["condition"], each["runs"]["now"]) for each in found]
    asked = [(f"{name}, {what}", scores["share"]) for name, what, scores in now if what.startswith(_ASKED)]
    if asked:
        name, least = min(asked, key=lambda each: -1.0 if each[1] is None else each[1])
        holds = least is not None and least >= LEAST_SHARE
        said = f"{number(least, 1)} ({name})"
        yield judged("conditions/least share, tilt and odometry, %", said, f">= {LEAST_SHARE:g}", holds)
    for key, most, unit in (("first_m", MOST_METRES, "m"), ("first_deg", MOST_DEGREES, "deg")):
        first = [(scores[key], f"{name}, {what}") for name, what, scores in now if scores[key] is not None]
        worst, where = max(first, default=(float("nan"), "none"))
        said = f"{number(worst, 2)} ({where})"
        yield judged(f"conditions/worst first fix, {unit}", said, f"<= {most:g}", bool(worst <= most), worst)
    false = sum(scores["false_frames"] for _, _, scores in now)
    yield judged("conditions/false frames", str(false), "0", false == 0, false)


_HEAD = (
    *("set", "condition", "frames", "posed", "share %", "first fix m", "its error m", "deg", "rmse m", "deg"),
    *("max m", "deg", "false"),
)
_COLUMNS = (
    *(("posed", 0), ("share", 0), ("first_fix_m", 1), ("first_m", 2), ("first_deg", 2), ("rmse_m", 3)),
    *(("rmse_deg", 2), ("max_m", 2), ("max_deg", 2), ("false_frames", 0)),
)


def cells(details: dict[str, Any]) -> list[str]:
    """One line of the table: in each cell the earlier code's figure, if there is one, and ours."""
    runs = list(details["runs"].values())
    shown = [details["set"], details["condition"], str(runs[-1]["frames"])]
    for key, digits in _COLUMNS:
        figures = [number(scores[key], digits) for scores in runs]
        shown.append(NOTHING if set(figures) == {NOTHING} else _ARROW.join(figures))
    return shown


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs, what was asked of them, and the code that was measured."""
    shown = [cells(row.details) for row in rows if row.details]
    if not shown:
        raise InputError("no run was measured")
    targets = [
        [row.name.removeprefix("conditions/"), row.target, row.said, "met" if row.holds else "missed"]
        for row in rows
        if row.target
    ]
    judged_now = table(("target", "asked", "measured", "verdict"), targets)
    before = f"Before the arrow: commit {asked.before[:7]}. " if asked.before else ""
    return {"": f"{table(_HEAD, shown)}\n\n{judged_now}\n\n{before}{code_line()}"}
