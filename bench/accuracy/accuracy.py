"""Errors, runs localized and false fixes in held-out worlds, clean and with dirt.

Localizes a run in each held-out world, then runs on the map of another world of the same kind, where the only right
answer is no pose; then the same drives clean, with each kind of dirt, and with all of it. Beside it stands the first
paper's method on the same runs. Results stay in ``--work``.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy import paper
from bench.harness.files import fingerprint, folder, isolated, peak_megabytes, remembered
from bench.harness.rows import Row, bounded, informs, judged, listed
from bench.harness.worlds import KINDS, LIDARS, UTM, map_of, prepare, prepared_run, world_name
from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.localization.offline import RunResult, locate
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import evaluate
from coview_stream.sim import SimulationConfig, parse_dirt
from coview_stream.sim.dirt import KINDS_OF_DIRT, REAL

FIRST_SEED = 2001
"""Seeds from here on are for reporting only; lidar odometry was developed on some of them and is not judged here."""

_SIZES = (240.0, 300.0, 360.0, 420.0, 480.0, 600.0)
_LENGTHS = (40.0, 60.0, 80.0, 100.0, 120.0)
_CHANGED = (0.0, 0.2, 0.0, 0.3, 0.25)
MOST_TRANSLATION, MOST_ROTATION, MOST_FIRST_FIX, MOST_MEGABYTES = 0.08, 0.3, 10.0, 1536.0
"""Targets: metres, degrees, metres driven, MB."""

CLEAN = "none"
DIRTS = (CLEAN, *KINDS_OF_DIRT, REAL)  # no dirt, each kind with its default strength, all of them

DIRTY_WORLDS = (
    SimulationConfig("campus", "os64", seed=2401, length=160.0, speed=8.0),
    SimulationConfig("town", "vlp16", seed=2402, length=60.0),
    SimulationConfig("village", "mid360", seed=2403, length=60.0),
    SimulationConfig("industrial", "vlp16", seed=2404, length=160.0, speed=8.0),
)
"""Two drives at 8 m/s and two at walking pace, on seeds that nothing was tuned on; the first is the quick one."""

_OF_THE_MAP = frozenset(("strips", "density", "seasons", "years"))  # kinds that need a map of their own

Run = dict[str, Any]  # figures of ``evaluate`` and of the process


def held_out_worlds() -> list[SimulationConfig]:
    """Return 24 worlds: every kind with every lidar, twice, with alternating sizes, lengths, changes and offsets."""
    return [
        SimulationConfig(
            KINDS[k % 4], LIDARS[k // 4 % 3], FIRST_SEED + k, _SIZES[(k + k // 6) % 6], _LENGTHS[(k + k // 5) % 5],
            changed=_CHANGED[k % 5], origin=UTM if k % 3 == 1 else (0.0, 0.0, 0.0),
        )
        for k in range(24)
    ]  # fmt: skip


def pairs(quick: bool = False) -> list[tuple[SimulationConfig, SimulationConfig]]:
    """Return (run, map) of 24 worlds, then of 12 runs on the map of the next world of that kind; quick: 2 and 1."""
    worlds = held_out_worlds()
    inside = [worlds[k] for k in (0, 21)] if quick else worlds  # small ones
    strangers = [(0, 16)] if quick else [(k, k + 4) for k in range(12)]
    return [*((world, world) for world in inside), *((worlds[a], worlds[b]) for a, b in strangers)]


def measure(world: Path, site: Path, inside: bool) -> Run:
    """Localize a world's run on the map in a file; evaluate it by the truth if the run is inside the map."""
    base_map = BaseMap.load(site)
    begin = time.perf_counter()
    located = locate(base_map, open_run(world / "run"))
    run: Run = {
        "locate_s": round(time.perf_counter() - begin, 2),
        "p50_ms": round(1e3 * float(np.median(located.seconds)), 2),
        "megabytes": peak_megabytes(),
        "map_points": len(base_map.points),
        "frames": located.frames,
        "posed": len(located.posed),
    }
    if not inside:
        return run | {"false_frames": len(located.posed), "success": not located.posed}
    by_paper = paper.located(base_map, open_run(world / "run"), read_tum(world / "truth.tum")[1])
    return run | evaluated(located, world) | {"paper": by_paper}


def evaluated(located: RunResult, world: Path) -> Run:
    """Return the figures of ``evaluate`` for a world's run on its own map."""
    poses = np.array([fix.T_map_body for fix in located.posed]).reshape(-1, 4, 4)
    estimate = np.array([fix.stamp for fix in located.posed]), poses
    return dict(json.loads(evaluate(estimate, read_tum(world / "truth.tum")).to_json()))


def run_one(below: Path, run: SimulationConfig, site: SimulationConfig, call: Callable[..., Any] = isolated) -> Run:
    """Prepare the worlds and measure, each in its own process; a crash makes a failed run."""
    name = world_name(run) if run == site else f"{world_name(run)}-on-{site.seed}"
    outside = replace(run, dirt=site.dirt) != site
    own_map = run == site or outside

    def make() -> Run:
        for config in dict.fromkeys((run, site)) if own_map else (site,):
            call(prepare, below, config)
        if not own_map:
            call(prepared_run, below, run)
        return dict(call(measure, below / world_name(run), map_of(below, site), not outside))

    files = (f"bench/accuracy/{name}.py" for name in ("accuracy", "paper"))
    code = {"code": fingerprint(), "bench": fingerprint(*files)}
    try:
        spec = {"run": run.to_dict(), "map": site.to_dict(), **code}
        result = remembered(below / "results" / f"{name}.json", spec, make)
    except Exception as error:  # the other runs are still worth having; the verdict counts this one as failed
        result = {"error": f"{type(error).__name__}: {error}", "success": False, "false_frames": 0, "posed": 0}
        print(f"{name}: {result['error']}", file=sys.stderr)
    return result | {"name": name, "run": run.to_dict(), "outside": outside}


COLUMNS = (
    ("world", "name", None), ("size", "size", 0), ("changed", "changed", None), ("UTM", "utm", None),
    ("driven m", "length", 0), ("map Mpts", "map_mpts", 2), ("success", "success", None), ("false", "false_frames", 0),
    ("posed %", "share", 1), ("e_t m", "e_t", 3), ("e_r deg", "e_r", 3), ("first m", "first_fix_m", 1),
    ("p50 ms", "p50_ms", 0), ("locate s", "locate_s", 0), ("MB", "megabytes", 0),
)  # fmt: skip
DIRT_COLUMNS = (
    ("dirt", "dirt", None), ("found", "found", None), ("false", "false_frames", 0), ("posed %", "share", 1),
    ("first m", "first_fix_m", 1), ("rmse t m", "rmse_t", 3), ("rmse r deg", "rmse_r", 3),
    *((way, way, None) for way in paper.WAYS),
)  # fmt: skip


def figures(run: Run) -> Run:
    """Return the figures of a run for the table."""
    world, frames = run["run"], run.get("frames")
    means = [(run.get(key) or {}).get("mean") for key in ("translation", "rotation")]
    known: Run = dict.fromkeys(key for _, key, digits in COLUMNS if digits is not None)
    made: Run = known | world | run | {
        "name": run["name"] + "!" * ("error" in run), "changed": f"{world['changed']:.0%}",
        "utm": "yes" if any(world["origin"]) else "no", "map_mpts": run.get("map_points", np.nan) / 1e6,
        "success": "yes" if run["success"] else "NO", "share": 100 * run["posed"] / frames if frames else None,
        "e_t": means[0], "e_r": means[1],
    }  # fmt: skip
    return made


def verdicts(runs: Sequence[Run]) -> Iterator[Row]:
    """Judge all runs together; without a fix the first fix is infinite."""
    inside, outside = [r for r in runs if not r["outside"]], [r for r in runs if r["outside"]]
    succeeded, false = (sum(r[key] for r in inside) for key in ("success", "false_frames"))
    text = f"{succeeded} of {len(inside)}"
    yield judged("accuracy/runs localized", text, "all", succeeded == len(inside), succeeded)
    yield judged("accuracy/false frames", str(false), "0", false == 0, false)
    for key, unit, most in (("translation", "m", MOST_TRANSLATION), ("rotation", "deg", MOST_ROTATION)):
        means = [r[key]["mean"] for r in inside if r.get(key)] or [np.inf]
        mean = float(np.mean(means))
        text = f"{mean:.3f} (worst run {max(means):.3f})"
        yield judged(f"accuracy/mean {key} error, {unit}", text, f"<= {most}", mean <= most, mean)
    first = [np.inf if r.get("first_fix_m") is None else r["first_fix_m"] for r in inside]
    yield bounded("accuracy/median first fix", float(np.median(first or [np.inf])), "m", MOST_FIRST_FIX)
    strays, quiet = sum(r["posed"] for r in outside), all(r["success"] for r in outside)
    text = f"{strays} in {len(outside)} runs"
    yield judged("accuracy/outside: poses", text, "0", strays == 0 and quiet, strays)
    memory = max((r.get("megabytes", 0.0) for r in runs), default=0.0)
    yield bounded("accuracy/peak memory of locate", memory, "MB", MOST_MEGABYTES)


def dirty(world: SimulationConfig, kind: str) -> SimulationConfig:
    """Return the world with a kind of dirt, with :data:`REAL` or with :data:`CLEAN`."""
    return replace(world, dirt=parse_dirt("" if kind == CLEAN else kind))


def dirty_run(below: Path, world: SimulationConfig, kind: str, call: Callable[..., Any] = isolated) -> Run:
    """Measure a world with a kind of dirt, on its own map only if the dirt concerns the map."""
    config = dirty(world, kind)
    run = run_one(below, config, config if _OF_THE_MAP & set(config.dirt.kinds) else world, call)
    if config != world:  # a hundred megabytes
        shutil.rmtree(below / world_name(config), ignore_errors=True)
    return run


def total(kind: str, runs: Sequence[Run]) -> Row:
    """Return the row of one kind of dirt: means over all runs; the median first fix counts no fix as infinite."""
    posed = [100.0 * run["posed"] / run["frames"] if run.get("frames") else 0.0 for run in runs]
    first = [np.inf if run.get("first_fix_m") is None else run["first_fix_m"] for run in runs]
    names = {"rmse_t": "translation", "rmse_r": "rotation"}
    rmse = {key: [run[key]["rmse"] for run in runs if run.get(key)] for key in names.values()}
    runs_found = sum(bool(run["success"]) for run in runs)
    by_paper = [run["paper"] for run in runs if "paper" in run]
    ways = {way: f"{sum(a[way]['success'] for a in by_paper)} of {len(by_paper)}" for way in paper.WAYS}
    about = {
        "dirt": kind, "found": f"{runs_found} of {len(runs)}", "false_frames": sum(run["false_frames"] for run in runs),
        "share": float(np.mean(posed)), "first_fix_m": float(np.median(first)), "runs": list(runs),
        **ways, **{name: float(np.mean(rmse[key])) if rmse[key] else None for name, key in names.items()},
    }  # fmt: skip
    return informs(f"accuracy/dirt {kind}: posed", about["share"], "%", about)


def options(parser: ArgumentParser) -> None:
    """Add the part that is measured, and the dirt."""
    parser.add_argument("--only", choices=("worlds", "dirt"), help="one of the two parts")
    drives = range(1, len(DIRTY_WORLDS) + 1)
    parser.add_argument("--drives", type=int, default=drives[-1], choices=drives, help="so many of the dirty drives")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per run with all its figures, then the targets; then a row per kind of dirt."""
    if asked.only != "dirt":
        runs = []
        for run, site in pairs(asked.quick):
            runs.append(run_one(folder(), run, site))
            mean = (runs[-1].get("translation") or {}).get("mean", np.nan)
            yield informs(f"accuracy/{runs[-1]['name']}", mean, "m", runs[-1])
        yield from verdicts(runs)
    if asked.only != "worlds":
        false = 0
        for kind in DIRTS[:: 6 if asked.quick else 1]:
            worlds = (replace(DIRTY_WORLDS[0], length=40.0),) if asked.quick else DIRTY_WORLDS[: asked.drives]
            row = total(kind, [dirty_run(folder(), world, kind) for world in worlds])
            false += row.details["false_frames"]
            yield row
        yield judged("accuracy/dirt: false frames", str(false), "0", false == 0, false)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return tables of all runs, of the runs beside the paper's, and of all kinds of dirt."""
    runs = [figures(row.details) for row in rows if row.details and "dirt" not in row.details]
    kinds = [row.details for row in rows if "dirt" in row.details]
    parts = {"": (COLUMNS, runs), "dirt": (DIRT_COLUMNS, kinds)}
    out = {name: listed(columns, found) for name, (columns, found) in parts.items() if found}
    inside = [run | {"success": run["success"] == "yes"} for run in runs if "paper" in run]
    if inside:
        out["beside the paper"] = paper.compared(inside, [run for run in runs if run["outside"]])
    return out
