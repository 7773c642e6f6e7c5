"""Whole runs in forests, searched by the paper's descriptors, by learned features, and by both; and outside the map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest.common import WORLDS, code, on_disk, say, weights
from bench.forest.drives import RUNS, shortened, world_of
from bench.forest.tables import NEAR_DEGREES, NEAR_METRES
from bench.forest.worlds import base_of
from bench.harness.tables import number, table
from bench.harness.trajectory_scores import Told, errors
from bench.harness.worlds import fingerprint, remembered
from coview_stream.config import LocalizerConfig, Reloc

Floats = npt.NDArray[np.float64]
Row = dict[str, Any]

MODES: tuple[Reloc, ...] = ("coview", "learned", "auto")
_HEAD = (
    "run", "reloc", "driven m", "first fix m", "posed %", "after first %", "RMSE m", "RMSE deg", "false",
    "searching ms",
)  # fmt: skip


def map_of(world: Path) -> Path:
    """Return the map of a world on disk with learned features, built now unless it is there."""
    from coview_stream import BaseMap

    out = world.with_name(f"{world.name}.coview")
    base = base_of(world)
    spec = {"code": code(), "weights": weights(), **on_disk(world)}

    def make() -> dict[str, Any]:
        BaseMap.build(base, learned=True).save(out)
        return {}

    remembered(out.with_suffix(".built.json"), spec, make)
    return out


def followed(world: Path, site: Path, reloc: Reloc) -> tuple[Told, Floats]:
    """Localize the run of a world on a map: what was said of each frame, and the true poses (N, 4, 4)."""
    from coview_stream import BaseMap
    from coview_stream.clouds import open_run, read_tum
    from coview_stream.offline import locate

    run = open_run(world / "run")
    stamps, truth = read_tum(world / "truth.tum")
    located = locate(BaseMap.load(site), run, LocalizerConfig(reloc=reloc))
    said = np.array([fix.stamp for fix in located.fixes])
    nearest = np.abs(stamps[:, None] - said[None]).argmin(axis=0)
    known = np.full((len(said), 4, 4), np.nan)
    for k, fix in enumerate(located.fixes):
        if fix.T_map_body is not None:
            known[k] = fix.T_map_body
    states = [fix.state.value for fix in located.fixes]
    reasons = [fix.evidence.reason if fix.evidence else "" for fix in located.fixes]
    told = Told(said, states, reasons, known, np.full((len(said), 6, 6), np.nan), np.array(located.seconds))
    return told, truth[nearest]


def scored(told: Told, truth: Floats, outside: bool) -> Row:
    """Figures of one run; outside the map every pose is a false one."""
    error = errors(told, truth)
    known = told.tracking
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    wrong = known & ((error.metres > NEAR_METRES) | (error.degrees > NEAR_DEGREES) | outside)
    first = int(np.argmax(known)) if known.any() else None
    right = known & ~wrong
    searching = told.seconds[~np.r_[False, known[:-1]]]
    return {
        "driven_m": float(way[-1]),
        "first_fix_m": None if first is None else float(way[first]),
        "posed": float(known.mean()),
        "posed_after": None if first is None else float(known[first:].mean()),
        "rmse_m": _rms(error.metres[right]),
        "rmse_deg": _rms(error.degrees[right]),
        "false": int(wrong.sum()),
        "searching_ms": float(1e3 * np.percentile(searching, 95)) if len(searching) else None,
        "reason": told.reasons[-1] if told.reasons else "",
    }


def _rms(values: Floats) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def all_runs(folder: Path, quick: bool, worlds: Sequence[Path]) -> tuple[list[Row], list[str]]:
    """Rows of all runs in all modes, each also on the map of the next, and what went wrong.

    ``worlds`` are directories on disk, in place of the usual runs; a single one has no other map to be outside of.
    """
    folder.mkdir(parents=True, exist_ok=True)
    few = [shortened(run, 40.0) for run in RUNS[1:4:2]] if quick else list(RUNS)
    openers = [lambda path=path: path for path in worlds] or [
        lambda run=run: world_of(folder, run) for run in few
    ]
    names = [path.name for path in worlds] or [run.name for run in few]
    specs: list[Any] = [on_disk(path) for path in worlds] or [asdict(run) for run in few]
    rows, troubles = [], []
    for k, name in enumerate(names):
        other = (k + 1) % len(names)
        sites = [(k, False)] + ([(other, True)] if other != k else [])
        for site, outside in sites:
            for reloc in MODES:
                label = name if not outside else f"{name} on {names[site]}"
                try:
                    rows.append(
                        _row(
                            folder, label, reloc, openers[k], openers[site], outside, [specs[k], specs[site]]
                        )
                    )
                except Exception as error:  # the other runs are still worth having; the exit code tells
                    troubles.append(f"{label}, {reloc}: {type(error).__name__}: {error}")
                    say(troubles[-1])
    return rows, troubles


def _row(folder: Path, label: str, reloc: Reloc, world: Any, site: Any, outside: bool, spec: Any) -> Row:

    def make() -> Row:
        return scored(*followed(world(), map_of(_kept(folder, site())), reloc), outside)

    begin = time.perf_counter()
    wanted = {
        "runs": spec,
        "reloc": reloc,
        "weights": weights(),
        "code": fingerprint(),
        "bench": fingerprint(*WORLDS, "bench/forest/runs.py", "bench/harness/trajectory_scores.py"),
    }
    row = remembered(folder / "runs" / f"{label.replace(' ', '-')}-{reloc}.json", wanted, make)
    say(
        f"{label}, {reloc}: {time.perf_counter() - begin:.0f} s, {row['false']} false, first {row['first_fix_m']}"
    )
    return {"run": label, "reloc": reloc, "outside": outside, **row}


def _kept(folder: Path, world: Path) -> Path:
    """Give a world on disk a place in ``folder`` beside which its map may be written."""
    if world.parent.resolve() == folder.resolve():
        return world
    link = folder / f"{world.resolve().parent.name}-{world.name}"
    if not link.is_symlink():
        link.symlink_to(world.resolve(), target_is_directory=True)
    return link


def runs_table(rows: Sequence[Row]) -> str:
    """One line per run, map and mode."""
    shown = [
        [
            row["run"], row["reloc"], number(row["driven_m"], 0), number(row["first_fix_m"], 1),
            number(100 * row["posed"], 0), number(_share(row["posed_after"]), 0), number(row["rmse_m"], 3),
            number(row["rmse_deg"], 2), str(row["false"]), number(row["searching_ms"], 0),
        ]
        for row in rows
    ]  # fmt: skip
    return table(_HEAD, shown)


def _share(value: float | None) -> float | None:
    return None if value is None else 100 * value
