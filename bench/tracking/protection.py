"""Protection levels, on kinds of sites other than those that the errors' tail is fitted on.

Plain drives with odometry that drifts by 0.5 to 5 %. The tail of the errors is fitted on campuses and sparse forests
(``fitted``), where the covariance is the most optimistic; the levels as the product has them are judged on towns,
villages, industry and dense forests (``reported``), every other block of these on a map in which 30 % of the buildings
and all cars, poles and trees are others. One pose per ten metres counts. Worlds and answers stay in ``--work``.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.accuracy.scores import errors
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged, number, table
from bench.tracking.drives import start
from bench.tracking.levels import PRODUCT, Sample, beyond_alert_limit, level_table, tail, upper_bound
from bench.tracking.tracking import follow
from bench.tracking.worlds import World, map_of, open_world
from coview_stream.geometry.protection import RISK

WORLDS = 30  # of each family
_SPEEDS, _DRIFTS = (2.0, 3.0, 4.0, 5.0), (0.005, 0.01, 0.02, 0.03, 0.05)
_MEASURED = ("coview_kernels", "coview_stream/config", "coview_stream/localization", "coview_stream/sim")
_LIDARS = ("vlp16", "os64", "mid360")


class Family(NamedTuple):
    """Kinds of sites, the seed of the first world, and whether every other block is driven on an earlier map."""

    kinds: tuple[str, ...]
    seed: int
    changes: bool

    def worlds(self, count: int) -> Iterator[tuple[World, str]]:
        """Yield worlds, and which of their maps is used."""
        for k in range(count):
            block, kind = divmod(k, len(self.kinds))
            speed, drift = _SPEEDS[(k + block) % len(_SPEEDS)], _DRIFTS[k % len(_DRIFTS)]
            world = World(self.kinds[kind], _LIDARS[block % 3], self.seed + k, 260.0, 400.0, speed, drift)
            yield world, "changed" if self.changes and block % 2 else "plain"


FAMILIES = {
    "fitted": Family(("campus", "sparse-forest"), 5301, False),
    "reported": Family(("town", "village", "industrial", "forest"), 5201, True),
}


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--worlds", type=int, default=WORLDS, metavar="N", help=f"of each family ({WORLDS})")
    parser.add_argument("--family", choices=tuple(FAMILIES), help="this one alone")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive, then the tails that fit, and the verdict on the reported ones."""
    count = 2 if asked.quick else asked.worlds
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in FAMILIES}
    for name in [asked.family] if asked.family else FAMILIES:
        for world, variant in FAMILIES[name].worlds(count):
            drive = measure(folder(), world, variant)
            found[name].append(drive)
            worst = float(np.max(Sample.from_json(drive["sample"]).error[:, 0], initial=0.0))
            about = {"family": name, **drive}
            yield informs(f"protection/{world.name.removeprefix('tracking-')}, {variant}: worst", worst, "m", about)
    for name, some in found.items():
        if some:
            sample = Sample.joined([Sample.from_json(each["sample"]) for each in some])
            fits = [tail(sample, part) for part in (0, 1)]
            said = "; ".join(f"{factor:.2f}, {freedom:.1f}" for factor, freedom in fits)
            yield judged(f"protection/tail that fits {name}: factor, freedom; m, deg", said, "", None)
    if some := found["reported"]:
        sample, metres = (
            Sample.joined([Sample.from_json(each["sample"]) for each in some]),
            sum(each["driven_m"] for each in some),
        )
        for part, unit in enumerate(("m", "degrees")):
            hits, of = sample.above(PRODUCT)[part], len(sample.error)
            said = f"{hits} of {of}: below {100 * upper_bound(hits, of):.2f} %"
            holds = hits <= RISK * of
            yield judged(f"protection/error > level, {unit}", said, f"<= {100 * RISK:g} %", holds, hits / max(of, 1))
        count = sum(each["misleading"] for each in some)
        yield judged("protection/beyond the alert limit", f"{count} in {metres / 1000:.1f} km", "0", not count, count)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Levels by kind of site, and how the tails of either family would do on the other."""
    measured = [row.details for row in rows if "family" in row.details]
    groups: dict[str, list[Sample]] = {}
    by_family: dict[str, list[Sample]] = {}
    for each in measured:
        sample, map_of_it = Sample.from_json(each["sample"]), ", 30 % changed" if each["variant"] == "changed" else ""
        groups.setdefault(f"{each['family']}: {each['kind']}{map_of_it}", []).append(sample)
        by_family.setdefault(each["family"], []).append(sample)
    joined = {f"{name}, all": Sample.joined(some) for name, some in by_family.items()}
    out = {name: Sample.joined(some) for name, some in sorted(groups.items())} | joined
    return {"": f"{level_table(out)}", "tails": _tail_table(by_family)}


def measure(below: Path, world: World, variant: str) -> dict[str, Any]:
    """Return the sample of a plain drive, as lists, with what it was; kept until the code changes."""
    bench = fingerprint("bench/tracking/drives.py", "bench/tracking/worlds.py", "bench/accuracy/scores.py")
    spec = {"code": fingerprint(*_MEASURED), "bench": bench, "world": repr(world), "variant": variant}

    def work() -> dict[str, Any]:
        recorded = open_world(below, world)
        drive = start(recorded.truth, world.drift, world.seed)
        track = follow(map_of(below, world, variant), recorded, drive)
        error = errors(track, drive.truth)
        sample = Sample.of(track, error, drive.driven)
        about = {"kind": world.kind, "variant": variant, "driven_m": float(drive.driven[-1])}
        about["misleading"] = sum(each.misleading for each in beyond_alert_limit(track, error, drive.driven))
        return about | {"sample": sample.to_json()}

    return remembered(below / "protection-results" / f"{world.name}-{variant}.json", spec, work)


def _tail_table(families: dict[str, list[Sample]]) -> str:
    """Show the tails: the product's, and each family's own, and what they would have left above on each family."""
    joined = {name: Sample.joined(some) for name, some in families.items()}
    tails = {"product": list(PRODUCT)}
    tails |= {f"fits {name}": [tail(sample, part) for part in (0, 1)] for name, sample in joined.items()}
    head = ["tail", "factor m", "freedom", "factor deg", "freedom", *(f"> level, {name}: m, deg" for name in joined)]
    lines = []
    for name, pair in tails.items():
        cells = [name, *(number(value, 2) for each in pair for value in each)]
        for sample in joined.values():
            above = sample.above(pair)
            cells.append(f"{above[0]}, {above[1]} of {len(sample.error)}")
        lines.append(cells)
    return table(head, lines)
