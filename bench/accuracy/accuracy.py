"""How accurate, how often right, and never falsely so.

Localizes a run in each held-out world; then runs on the map of another world of the same kind, where the only right
answer is no pose. Then the same runs clean, with each kind of dirt, and with all of it. One process per run, one at a
time; what is done stays in ``--work``, so that it can resume.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy import dirt
from bench.accuracy.world_runs import Run, measure
from bench.harness.files import code_line, fingerprint, folder, isolated, remembered
from bench.harness.rows import Row, bounded, informs, judged
from bench.harness.tables import number, table
from bench.harness.worlds import KINDS, LIDARS, UTM, map_of, prepare, world_name
from coview_stream.sim import SimulationConfig

FIRST_SEED = 2001
"""Nobody tunes on the seeds from here on: they are for reporting only.

Lidar odometry was made looking at some of them (docs/accuracy.md names them); it is not for these worlds to judge.
"""

_SIZES = (240.0, 300.0, 360.0, 420.0, 480.0, 600.0)
_LENGTHS = (40.0, 60.0, 80.0, 100.0, 120.0)
_CHANGED = (0.0, 0.2, 0.0, 0.3, 0.25)
MOST_TRANSLATION, MOST_ROTATION, MOST_FIRST_FIX, MOST_MEGABYTES = 0.08, 0.3, 10.0, 1536.0
"""The targets: metres, degrees, metres driven, MB."""

_HEAD = (
    "world", "size", "changed", "UTM", "driven m", "map Mpts", "success", "false", "posed %", "e_t m",
    "e_r deg", "first m", "p50 ms", "locate s", "MB",
)  # fmt: skip


def held_out_worlds() -> list[SimulationConfig]:
    """24 worlds: every kind with every lidar, twice; sizes, lengths, changes and offsets in turn."""
    return [
        SimulationConfig(
            KINDS[k % 4], LIDARS[k // 4 % 3], FIRST_SEED + k, _SIZES[(k + k // 6) % 6], _LENGTHS[(k + k // 5) % 5],
            changed=_CHANGED[k % 5], origin=UTM if k % 3 == 1 else (0.0, 0.0, 0.0),
        )
        for k in range(24)
    ]  # fmt: skip


def pairs(quick: bool = False) -> list[tuple[SimulationConfig, SimulationConfig]]:
    """(run, map) of all 24 worlds, then of 12 runs on the map of the next world of the same kind; or of 4 and 2."""
    worlds = held_out_worlds()
    inside = [worlds[k] for k in (0, 21, 6, 11)] if quick else worlds  # one of each kind, the small ones
    strangers = [(0, 16), (21, 17)] if quick else [(k, k + 4) for k in range(12)]
    return [*((world, world) for world in inside), *((worlds[a], worlds[b]) for a, b in strangers)]


def run_one(folder: Path, run: SimulationConfig, site: SimulationConfig, call: Callable[..., Any] = isolated) -> Run:
    """Prepare the worlds and measure, each in its own process; a crash makes a run that has failed."""
    code = {"code": fingerprint(), "bench": fingerprint("bench/accuracy/world_runs.py")}
    name = world_name(run) if run == site else f"{world_name(run)}-on-{site.seed}"

    def make() -> Run:
        for config in dict.fromkeys((run, site)):
            call(prepare, folder, config)
        return dict(call(measure, folder / world_name(run), map_of(folder, site), run == site))

    try:
        spec = {"run": run.to_dict(), "map": site.to_dict(), **code}
        found = remembered(folder / "results" / f"{name}.json", spec, make)
    except Exception as error:  # the other runs are still worth having; the verdict counts this one as failed
        found = {"error": f"{type(error).__name__}: {error}", "success": False, "false_frames": 0, "posed": 0}
        print(f"{name}: {found['error']}", file=sys.stderr)
    return found | {"name": name, "run": run.to_dict(), "outside": run != site}


def cells(run: Run) -> list[str]:
    """One line of the table."""
    world, frames, points = run["run"], run.get("frames"), run.get("map_points")
    means = [(run.get(key) or {}).get("mean") for key in ("translation", "rotation")]
    return [
        run["name"] + ("!" if "error" in run else ""), f"{world['size']:.0f}", f"{world['changed']:.0%}",
        "yes" if any(world["origin"]) else "no", f"{world['length']:.0f}",
        number(points / 1e6 if points else None, 2), "yes" if run["success"] else "NO", str(run["false_frames"]),
        number(100 * run["posed"] / frames if frames else None, 1), *(number(mean, 3) for mean in means),
        number(run.get("first_fix_m"), 1), number(run.get("p50_ms"), 0), number(run.get("locate_s"), 0),
        number(run.get("megabytes"), 0),
    ]  # fmt: skip


def verdicts(runs: Sequence[Run]) -> Iterator[Row]:
    """Judge all runs together; without a fix the first fix is endless."""
    inside, outside = [r for r in runs if not r["outside"]], [r for r in runs if r["outside"]]
    succeeded, false = (sum(r[key] for r in inside) for key in ("success", "false_frames"))
    said = f"{succeeded} of {len(inside)}"
    yield judged("accuracy/runs localised", said, "all", succeeded == len(inside), succeeded)
    yield judged("accuracy/false frames", str(false), "0", false == 0, false)
    for key, unit, most in (("translation", "m", MOST_TRANSLATION), ("rotation", "deg", MOST_ROTATION)):
        means = [r[key]["mean"] for r in inside if r.get(key)] or [np.inf]
        mean = float(np.mean(means))
        said = f"{mean:.3f} (worst run {max(means):.3f})"
        yield judged(f"accuracy/mean {key} error, {unit}", said, f"<= {most}", mean <= most, mean)
    first = [np.inf if r.get("first_fix_m") is None else r["first_fix_m"] for r in inside]
    yield bounded("accuracy/median first fix", float(np.median(first or [np.inf])), "m", MOST_FIRST_FIX)
    strays, quiet = sum(r["posed"] for r in outside), all(r["success"] for r in outside)
    said = f"{strays} in {len(outside)} runs"
    yield judged("accuracy/outside: poses", said, "0", strays == 0 and quiet, strays)
    memory = max((r.get("megabytes", 0.0) for r in runs), default=0.0)
    yield bounded("accuracy/peak memory of locate", memory, "MB", MOST_MEGABYTES)


def options(parser: ArgumentParser) -> None:
    """Add which part is measured, and with which dirt."""
    parser.add_argument("--only", choices=("worlds", "dirt"), help="one of the two parts")
    parser.add_argument("--kinds", nargs="+", default=list(dirt.KINDS), choices=dirt.KINDS, metavar="DIRT")
    drives = range(1, len(dirt.WORLDS) + 1)
    parser.add_argument("--drives", type=int, default=drives[-1], choices=drives, help="so many of the dirty drives")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per run with all its figures, then the targets; then a row per kind of dirt."""
    if asked.only != "dirt":
        yield from _worlds(asked)
    if asked.only != "worlds":
        yield from dirt.rows(1 if asked.quick else asked.drives, asked.kinds)


def _worlds(asked: Namespace) -> Iterator[Row]:
    runs = []
    for run, site in pairs(asked.quick):
        runs.append(run_one(folder(), run, site))
        mean = (runs[-1].get("translation") or {}).get("mean", np.nan)
        yield informs(f"accuracy/{runs[-1]['name']}", mean, "m", runs[-1])
    yield from verdicts(runs)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs, and all kinds of dirt, each with the code that was measured."""
    runs = [row.details for row in rows if row.details and "dirt" not in row.details]
    kinds = [row.details for row in rows if "dirt" in row.details]
    found = {"": table(_HEAD, [cells(run) for run in runs])} if runs else {}
    found |= {"dirt": table(dirt.HEAD, [dirt.cells(each) for each in kinds])} if kinds else {}
    return {name: f"{text}\n\n{code_line()}" for name, text in found.items()}
