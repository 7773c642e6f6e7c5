"""What each kind of dirt costs: the same runs clean, with one kind at a time, and with all of them at once.

Part of ``python -m bench accuracy``. The drives, their truth and, but for faults of the survey and change since, the
maps are the same in all of them, so that differences are those of the dirt. Frames are false as everywhere on the page.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.world_runs import Run, measure
from bench.harness.files import fingerprint, folder, isolated, remembered
from bench.harness.rows import Row, informs, judged
from bench.harness.tables import number
from bench.harness.worlds import map_of, prepare, prepared_run, world_name
from coview_stream.sim import SimulationConfig, parse_dirt
from coview_stream.sim.dirt import KINDS_OF_DIRT, REAL

CLEAN = "none"
KINDS = (CLEAN, *KINDS_OF_DIRT, REAL)
"""What is measured: no dirt, each kind with its default strength, all of them."""

WORLDS = (
    SimulationConfig("campus", "os64", seed=2401, length=160.0, speed=8.0),
    SimulationConfig("town", "vlp16", seed=2402, length=60.0),
    SimulationConfig("village", "mid360", seed=2403, length=60.0),
    SimulationConfig("industrial", "vlp16", seed=2404, length=160.0, speed=8.0),
)
"""Two drives at 8 m/s and two at walking pace, on seeds that nothing was tuned on; the first is the quick one."""

HEAD = ("dirt", "found", "false", "posed %", "first m", "rmse t m", "rmse r deg", "last said of those not found")

_OF_THE_MAP = frozenset(("strips", "density", "seasons", "years"))  # kinds for which a map has to be made anew


def dirty(world: SimulationConfig, kind: str) -> SimulationConfig:
    """Return the world with a kind of dirt, with :data:`REAL` or with :data:`CLEAN`."""
    return replace(world, dirt=parse_dirt("" if kind == CLEAN else kind))


def run_one(below: Path, world: SimulationConfig, kind: str, call: Callable[..., Any] = isolated) -> Run:
    """Make a world and measure its run, each in a process of its own; a crash makes a run that has failed."""
    config = dirty(world, kind)
    own_map = bool(_OF_THE_MAP & set(config.dirt.kinds))
    site = config if own_map else world

    def make() -> Run:
        call(prepare, below, site)
        if not own_map:
            call(prepared_run, below, config)
        return dict(call(measure, below / world_name(config), map_of(below, site), True))

    code = {"code": fingerprint(), "bench": fingerprint("bench/accuracy/world_runs.py")}
    try:
        file = below / "results" / f"dirt-{world_name(config)}.json"
        found = remembered(file, {"run": config.to_dict(), "map": site.to_dict(), **code}, make)
    except Exception as error:  # the other runs are still worth having; the verdict counts this one as failed
        print(f"{world_name(config)}: {type(error).__name__}: {error}", file=sys.stderr)
        found = {"error": f"{type(error).__name__}: {error}", "success": False, "false_frames": 0, "posed": 0}
    return found | {"name": world_name(config)}


def total(kind: str, runs: Sequence[Run]) -> Row:
    """Row of one kind of dirt over all worlds: means over the runs; the median first fix counts no fix as endless."""
    posed = [100.0 * run["posed"] / run["frames"] if run.get("frames") else 0.0 for run in runs]
    first = [np.inf if run.get("first_fix_m") is None else run["first_fix_m"] for run in runs]
    rmse = {
        key: [run[key]["rmse"] for run in runs if run.get(key) and run[key].get("rmse") is not None]
        for key in ("translation", "rotation")
    }
    figures = {
        "dirt": kind,
        "found": sum(bool(run["success"]) for run in runs),
        "runs": len(runs),
        "false_frames": sum(run["false_frames"] for run in runs),
        "posed_share": float(np.mean(posed)),
        "first_fix_m": float(np.median(first)),
        "rmse_t": float(np.mean(rmse["translation"])) if rmse["translation"] else None,
        "rmse_r": float(np.mean(rmse["rotation"])) if rmse["rotation"] else None,
        "each": list(runs),
    }
    return informs(f"accuracy/dirt {kind}: posed", figures["posed_share"], "%", figures)


def cells(figures: Run) -> list[str]:
    """One line of the table."""
    first, lost = figures["first_fix_m"], [run for run in figures["each"] if not run["success"]]
    why = "; ".join(dict.fromkeys(str(run.get("error") or run.get("reason") or "-") for run in lost))
    return [
        figures["dirt"], f"{figures['found']} of {figures['runs']}", str(figures["false_frames"]),
        number(figures["posed_share"], 1), number(first if first is not None and np.isfinite(first) else None, 1),
        number(figures["rmse_t"], 3), number(figures["rmse_r"], 3), why,
    ]  # fmt: skip


def rows(drives: int, kinds: Sequence[str]) -> Iterator[Row]:
    """Yield a row per kind with all figures, over so many drives, then how many frames were false in all of them."""
    false = 0
    for kind in kinds:
        row = total(kind, [run_one(folder(), world, kind) for world in WORLDS[:drives]])
        false += row.details["false_frames"]
        yield row
    yield judged("accuracy/dirt: false frames", str(false), "0", false == 0, false)
