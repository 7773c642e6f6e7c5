"""What each choice of the method is worth.

Every variant changes a choice (the last ones several of the paper's at once) and runs on the same simulated worlds: how
often the search names the right place (from one keyframe, from five), then the whole localizer on the same run. What is
done stays in ``--work``.
"""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.accuracy import evaluated
from bench.accuracy.paper import Modes
from bench.accuracy.stages import WINDOW, Bank, Variant, places
from bench.harness.files import fingerprint, folder, isolated, remembered
from bench.harness.rows import Row, informs, number, table
from bench.harness.worlds import KINDS, LIDARS, TUNED_SEEDS, map_of, prepare, world_name
from coview_stream.config import DescriptorConfig
from coview_stream.localization.offline import locate
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

SEEDS = tuple(range(2101, 2109))
"""Held out: not for tuning, as those of ``python -m bench accuracy``."""

_LENGTH = 24.0  # metres driven in each world
_COC = partial(DescriptorConfig, channels=("coview",))

VARIANTS = (
    Variant("default: both channels, exhaustive, consensus"),
    Variant("Scan Context alone", DescriptorConfig(channels=("scan_context",))),
    Variant("co-view context alone", _COC()),
    Variant("co-view alone, strict (eq. 2 only)", _COC(), Modes(strict=True)),
    Variant("ring key retrieval, 200 candidates", modes=Modes(ring_key=True)),
    Variant("co-view alone, strict, ring key", _COC(), Modes(ring_key=True, strict=True)),
    Variant("single minimum, no consensus", modes=Modes(single=True)),
    Variant("keyframe's zero at the sensor", DescriptorConfig(ground_zero=False)),
    Variant("co-view alone, zero at the sensor", _COC(ground_zero=False)),
    Variant("all three: co-view, ring key, single", _COC(), Modes(ring_key=True, single=True)),
    Variant("all three: strict, ring key, single", _COC(), Modes(ring_key=True, single=True, strict=True)),
)
"""The last one is the paper's own method."""

Measured = dict[str, dict[str, Any]]  # variant name -> its measures in one world

_HEAD = (
    "variant", "top-1", f"coarse ({WINDOW} kf)", "SLR", "false frames", "e_t m", "e_r deg", "first fix m"
)  # fmt: skip


def world_of(seed: int) -> SimulationConfig:
    """Return the world of a seed: kinds and lidars in turn, odd ones changed since the map was made."""
    size = (240.0, 270.0, 300.0)[seed // 2 % 3]
    changed = 0.25 if seed % 2 else 0.0
    return SimulationConfig(KINDS[seed % 4], LIDARS[seed % 3], seed, size, _LENGTH, changed=changed)


def ablate(folder: Path, config: SimulationConfig, names: Sequence[str]) -> Measured:
    """Measure the named variants in one world: the search alone, then the whole localizer on the world's run."""
    world, variants = folder / world_name(config), [v for v in VARIANTS if v.name in names]
    bank = Bank(map_of(folder, config))
    found = places(world, variants, bank)
    return {v.name: asdict(found[v.name]) | _localize(world, bank, v) for v in variants}


def _localize(world: Path, bank: Bank, variant: Variant) -> dict[str, Any]:
    with variant.modes.localizer():
        return evaluated(locate(bank.map(variant.descriptor, variant.modes), open_run(world / "run")), world)


def measure(
    folder: Path, config: SimulationConfig, names: Sequence[str], call: Callable[..., Any] = isolated
) -> Measured:
    """Measures of the variants in one world, each in a process of its own."""
    code = {"code": fingerprint(), "bench": fingerprint("bench/accuracy")}
    spec = {"world": config.to_dict(), "variants": list(names), **code}

    def make() -> Measured:
        call(prepare, folder, config)
        return dict(call(ablate, folder, config, names))

    return remembered(folder / "results" / f"ablation-{world_name(config)}.json", spec, make)


def total(name: str, got: Sequence[dict[str, Any]]) -> Row:
    """Row of a variant over all its worlds; a run without a fix counts as an endless first fix."""

    def count(key: str) -> int:
        return sum(each[key] for each in got)

    def error(key: str) -> float:
        return float(np.mean([each[key]["mean"] for each in got if each[key]] or [np.nan]))

    top1 = count("top1") / count("keyframes") if count("keyframes") else np.nan
    coarse = count("coarse") / count("windows") if count("windows") else np.nan
    first = float(np.median([np.inf if each["first_fix_m"] is None else each["first_fix_m"] for each in got]))
    shown = [
        number(top1, 2), number(coarse, 2), f"{count('success')} of {len(got)}",
        f"{count('false_frames')} of {count('posed')}", number(error("translation"), 3),
        number(error("rotation"), 3), number(first if np.isfinite(first) else None, 1),
    ]  # fmt: skip
    details = {"variant": name, "cells": shown, "keyframes": count("keyframes"), "worlds": got}
    return informs(f"ablation/{name}: top-1", 100 * top1, "%", details)


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, help=f"({SEEDS[0]} to {SEEDS[-1]})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per variant."""
    names, measured = [variant.name for variant in VARIANTS], {}
    for seed in dict.fromkeys(asked.seeds[:1] if asked.quick else asked.seeds):
        begin, config = time.perf_counter(), world_of(seed)
        measured[seed] = measure(folder(), config, names)
        print(f"{world_name(config)}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
    for name in names:
        row = total(name, [world[name] for world in measured.values()])
        row.details["seeds"] = list(measured)
        yield row


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per variant; above it, the seeds, and which of them were tuned on."""
    shown = table(_HEAD, [[row.details["variant"], *row.details["cells"]] for row in rows])
    seeds, votes = rows[0].details["seeds"], rows[0].details["keyframes"]
    named = ", ".join(f"{seed} (tuned on)" if seed in TUNED_SEEDS else str(seed) for seed in seeds)
    return {"": f"Worlds of the seeds {named}; {votes} keyframes vote.\n\n{shown}"}
