"""What each choice of the method is worth: ``python -m bench.ablation [--seeds N ...] [--markdown F]``.

Every variant changes a choice (the last ones several of the paper's at once) and runs on the same simulated
worlds: Scan Context against co-view context, exhaustive retrieval against ring key, consensus against the
single minimum, with and without a common zero for the heights. Per variant: how often the search names the
right place (from one keyframe, from five), then the whole localizer on the same run. What is done stays in
``--worlds``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.stages import WINDOW, Bank, Variant, places
from bench.harness.tables import number, table
from bench.harness.worlds import (
    KINDS,
    LIDARS,
    TUNED_SEEDS,
    fingerprint,
    isolated,
    map_of,
    prepare,
    remembered,
    world_name,
)
from coview_stream.config import ConsensusConfig, DescriptorConfig, LocalizerConfig, RetrievalConfig
from coview_stream.sim import SimulationConfig

SEEDS = tuple(range(2101, 2109))
"""Held out: nobody tunes on them, nor on those of ``bench.accuracy``."""

_RING_KEY = RetrievalConfig(mode="ring_key")
_SINGLE = ConsensusConfig(mode="single")
_COC = partial(DescriptorConfig, channels=("coview",))
_STRICT = DescriptorConfig(channels=("coview_strict",))

VARIANTS = (
    Variant("default: both channels, exhaustive, consensus"),
    Variant("Scan Context alone", DescriptorConfig(channels=("scan_context",))),
    Variant("co-view context alone", _COC()),
    Variant("co-view alone, strict (eq. 2 only)", _STRICT),
    Variant("ring key retrieval, 200 candidates", retrieval=_RING_KEY),
    Variant("co-view alone, strict, ring key", _STRICT, _RING_KEY),
    Variant("single minimum, no consensus", consensus=_SINGLE),
    Variant("keyframe's zero at the sensor", DescriptorConfig(ground_zero=False)),
    Variant("co-view alone, zero at the sensor", _COC(ground_zero=False)),
    Variant("co-view alone, visibility from the eye", _COC(visibility="eye")),
    Variant("co-view alone, no visibility test", _COC(visibility="off")),
    Variant("all three: co-view, ring key, single", _COC(), _RING_KEY, _SINGLE),
    Variant("all three: strict, ring key, single", _STRICT, _RING_KEY, _SINGLE),
)

Measured = dict[str, dict[str, Any]]
"""Variant name -> its measures in one world."""

_HEAD = (
    "variant", "top-1", f"coarse ({WINDOW} kf)", "SLR", "false frames", "e_t m", "e_r deg", "first fix m"
)  # fmt: skip


def world_of(seed: int, length: float) -> SimulationConfig:
    """Return the world of a seed: kinds and lidars in turn, odd ones changed since the map was made."""
    size = (240.0, 270.0, 300.0)[seed // 2 % 3]
    changed = 0.25 if seed % 2 else 0.0
    return SimulationConfig(KINDS[seed % 4], LIDARS[seed % 3], seed, size, length, changed=changed)


def ablate(folder: Path, config: SimulationConfig, names: Sequence[str]) -> Measured:
    """Measure the named variants in one world."""
    world, variants = folder / world_name(config), [v for v in VARIANTS if v.name in names]
    bank = Bank(map_of(folder, config))
    found = places(world, variants, bank)
    return {v.name: asdict(found[v.name]) | _localize(world, bank, v) for v in variants}


def _localize(world: Path, bank: Bank, variant: Variant) -> dict[str, Any]:
    """Run the whole localizer on the world's run."""
    from coview_stream.clouds import open_run, read_tum
    from coview_stream.offline import locate
    from coview_stream.report.evaluation import evaluate

    config = LocalizerConfig(retrieval=variant.retrieval, consensus=variant.consensus)
    begin = time.perf_counter()
    posed = locate(bank.map(variant.descriptor), open_run(world / "run"), config).posed
    seconds = round(time.perf_counter() - begin, 2)
    poses = np.array([fix.T_map_body for fix in posed]).reshape(-1, 4, 4)
    verdict = evaluate((np.array([fix.stamp for fix in posed]), poses), read_tum(world / "truth.tum"))
    return {**json.loads(verdict.to_json()), "locate_s": seconds}


def measure(
    folder: Path, config: SimulationConfig, names: Sequence[str], call: Any = isolated
) -> tuple[Measured, str]:
    """Measures of the variants in one world, each in a process of its own, and the code they are of."""
    spec = {
        "world": config.to_dict(),
        "variants": list(names),
        "code": fingerprint(),
        "bench": fingerprint("bench/accuracy/ablation.py", "bench/accuracy/stages.py"),
    }

    def make() -> Measured:
        call(prepare, folder, config)
        return dict(call(ablate, folder, config, names))

    file = folder / "results" / f"ablation-{world_name(config)}.json"
    return remembered(file, spec, make), str(spec["code"])


def aggregate(worlds: Sequence[Measured], names: Sequence[str]) -> list[list[str]]:
    """One row per variant, over all worlds; a run without a fix counts as an endless first fix."""
    rows = []
    for name in names:
        got = [world[name] for world in worlds]
        total = {key: sum(g[key] for g in got) for key in ("keyframes", "top1", "windows", "coarse")}
        means = [g["translation"]["mean"] for g in got if g["translation"]]
        turns = [g["rotation"]["mean"] for g in got if g["rotation"]]
        first = np.median([np.inf if g["first_fix_m"] is None else g["first_fix_m"] for g in got])
        rows.append([
            name,
            _share(total["top1"], total["keyframes"]),
            _share(total["coarse"], total["windows"]),
            f"{sum(g['success'] for g in got)} of {len(got)}",
            f"{sum(g['false_frames'] for g in got)} of {sum(g['posed'] for g in got)}",
            number(float(np.mean(means)) if means else None, 3),
            number(float(np.mean(turns)) if turns else None, 3),
            number(float(first) if np.isfinite(first) else None, 1),
        ])  # fmt: skip
    return rows


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.2f}" if whole else "-"


def report(measured: dict[int, Measured], names: Sequence[str], length: float, code: str) -> str:
    """Return the tables, held-out seeds and tuned-on seeds apart."""
    parts = []
    for title, tuned in (("Held-out seeds", False), ("Seeds that were TUNED on", True)):
        seeds = [seed for seed in measured if (seed in TUNED_SEEDS) is tuned]
        if not seeds:
            continue
        votes = sum(measured[seed][names[0]]["keyframes"] for seed in seeds)
        what = ", ".join(world_name(world_of(seed, length)) for seed in seeds)
        parts += [
            f"{title}: {len(seeds)} worlds, {length:.0f} m driven in each: {what}. {votes} keyframes vote.",
            "",
            table(_HEAD, aggregate([measured[seed] for seed in seeds], names)),
            "",
        ]
    return "\n".join([*parts, f"Code {code}, {time.strftime('%Y-%m-%d')}."])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ablation."""
    parser = argparse.ArgumentParser(prog="python -m bench.ablation", description=__doc__)
    parser.add_argument(
        "--worlds", type=Path, default=Path("out/worlds"), help="worlds, maps, results (out/worlds)"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=list(SEEDS), help=f"({SEEDS[0]} to {SEEDS[-1]})"
    )
    parser.add_argument("--length", type=float, default=24.0, help="metres driven in each world (24)")
    parser.add_argument("--markdown", type=Path, metavar="F", help="write the table there too")
    options = parser.parse_args(arguments)
    names = [variant.name for variant in VARIANTS]
    measured, codes = {}, set()
    for seed in dict.fromkeys(options.seeds):
        begin = time.perf_counter()
        config = world_of(seed, options.length)
        measured[seed], code = measure(options.worlds, config, names)
        codes.add(code)
        seconds = time.perf_counter() - begin
        print(f"{world_name(config)}: {seconds:.0f} s", file=sys.stderr, flush=True)
    text = report(measured, names, options.length, " and ".join(sorted(codes)))
    print(text)
    if options.markdown:
        options.markdown.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
