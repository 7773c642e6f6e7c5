"""Protection levels, on kinds of sites other than those that the errors' tail is fitted on.

Plain drives with odometry that drifts by 0.5 to 5 %. The tail is fitted on campuses and sparse forests (``fitted``),
where the covariance is the most optimistic; the product's levels are judged on other kinds (``reported``), every other
block on a map in which 30 % of the buildings and all cars, poles and trees are others. One pose per ten metres counts.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import fdtri
from scipy.stats import f

from bench.accuracy.scores import Errors, Track, errors
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged, number, table, upper
from bench.tracking.drives import follow, start
from bench.tracking.worlds import World, map_of, open_world
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES, RISK, TAILS, axes_of

EVERY = 10.0  # metres of driving of which one pose counts
TO_ALERT = (2.0, 2.0)  # seconds, and metres driven, after which a pose beyond the alert limit is withdrawn
PRODUCT = tuple(TAILS.values())  # tails of the product
Tails = Sequence[tuple[float, float]]
_HEAVIEST, _LIGHTEST = 2.5, 200.0  # degrees of freedom of a tail: a finite variance; as good as a Gaussian


class Sample(NamedTuple):
    """One pose per ten metres: (N, 2) arrays for position and rotation.

    Errors are in metres and degrees, trace and axes of the covariance in m2 and rad2. ``doubt`` is the reported level
    over the level of the covariance alone, for trying other tails on the same drives.
    """

    error: Floats
    doubt: Floats
    trace: Floats
    axes: Floats

    @classmethod
    def of(cls, track: Track, error: Errors, driven: Floats) -> Sample:
        """Pick them from a drive; (N,) metres ``driven`` at each frame."""
        posed = np.flatnonzero(track.tracking)
        rows = posed[np.unique(np.floor(driven[posed] / EVERY), return_index=True)[1]]
        shape = [[axes_of(C[:3, :3]), axes_of(C[3:, 3:])] for C in track.covariances[rows]]
        spread = np.array(shape, dtype=np.float64).reshape(-1, 2, 2)
        errors = np.column_stack([error.metres[rows], error.degrees[rows]])
        sample = cls(errors, np.ones_like(errors), spread[:, :, 0], spread[:, :, 1])
        return sample._replace(doubt=track.levels[rows] / sample.level(PRODUCT))

    def to_json(self) -> dict[str, list[list[float]]]:
        """Return the arrays as lists."""
        return {name: values.tolist() for name, values in self._asdict().items()}

    @classmethod
    def joined(cls, drives: Sequence[Mapping[str, Any]]) -> Sample:
        """Put those of several drives together, each as of :meth:`to_json`."""
        parts = [[np.reshape(drive[name], (-1, 2)) for drive in drives] for name in cls._fields]
        return cls(*(np.concatenate([np.empty((0, 2)), *part]) for part in parts))

    def level(self, tails: Tails) -> Floats:
        """(N, 2) metres and degrees that tails of the errors give: factor and degrees of freedom of each."""
        quantiles = [
            factor * np.sqrt(self.trace[:, k] * fdtri(self.axes[:, k], freedom, 1.0 - RISK))
            for k, (factor, freedom) in enumerate(tails)
        ]
        return np.asarray(self.doubt * np.column_stack([quantiles[0], np.degrees(quantiles[1])]))

    def above(self, tails: Tails) -> list[int]:
        """Count the errors that are larger than their level: in metres, in degrees."""
        return [int(count) for count in (self.error > self.level(tails)).sum(axis=0)]


def tail(sample: Sample, part: int) -> tuple[float, float]:
    """Fit the tail of ``part`` (0: metres, 1: degrees): factor and degrees of freedom of the greatest likelihood.

    The model is that of :mod:`coview_stream.geometry.protection`: error^2 / trace, less the factor, is F distributed.
    """
    error = sample.error[:, part] if part == 0 else np.radians(sample.error[:, part])
    square, axes = error**2 / sample.trace[:, part], sample.axes[:, part]

    def unlikely(about: Floats) -> float:
        log_factor, freedom = float(about[0]), float(np.clip(np.exp(about[1]), _HEAVIEST, _LIGHTEST))
        return -float(np.sum(f.logpdf(square * np.exp(-2 * log_factor), axes, freedom) - 2 * log_factor))

    found = [minimize(unlikely, (0.0, np.log(freedom)), method="Nelder-Mead") for freedom in (4.0, 10.0, 40.0)]
    best = min(found, key=lambda each: float(each.fun)).x
    return float(np.exp(best[0])), float(np.clip(np.exp(best[1]), _HEAVIEST, _LIGHTEST))


def beyond_alert_limit(track: Track, error: Errors, driven: Floats) -> list[tuple[float, float]]:
    """Return for each time beyond the alert limit the seconds and metres until its poses were withdrawn or right.

    Of (N,) metres ``driven`` at each frame.
    """
    beyond = track.tracking & ((error.metres > ALERT_METRES) | (error.degrees > ALERT_DEGREES))
    edges = np.diff(np.r_[False, beyond, False].astype(int))
    out = []
    for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        last = min(end, len(driven) - 1)  # where it is withdrawn, or the drive's end
        out.append((float(track.stamps[last] - track.stamps[begin]), float(driven[last] - driven[begin])))
    return out


def misleading(beyond: list[tuple[float, float]]) -> int:
    """Count the times that took longer, or led further, than :data:`TO_ALERT` allows."""
    return sum(seconds > TO_ALERT[0] or metres > TO_ALERT[1] for seconds, metres in beyond)


def level_table(samples: Mapping[str, Sample]) -> str:
    """Lay out, by name of the group: poses, how many are above their level, and how wide the levels are."""
    head = ("poses", "one per 10 m", "> level, m", "> level, deg", "worst / level, m", "worst / level, deg")
    lines = []
    for name, sample in samples.items():
        level = sample.level(PRODUCT)
        worst, wide = (sample.error / level).max(axis=0), np.median(level, axis=0)
        cells = [name, str(len(level)), *map(str, sample.above(PRODUCT)), *(f"{part:.2f}" for part in worst)]
        lines.append([*cells, number(wide[0], 2), number(wide[1], 1)])
    return table((*head, "level m p50", "level deg p50"), lines)


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
}  # the verdict is on the last one


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--worlds", type=int, default=WORLDS, metavar="N", help=f"of each family ({WORLDS})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive, then the tails that fit, and the verdict on the reported ones."""
    for name, family in FAMILIES.items():
        drives = []
        for world, variant in family.worlds(min(2, asked.worlds) if asked.quick else asked.worlds):
            drives.append(measure(folder(), world, variant))
            worst = max((metres for metres, _ in drives[-1]["sample"]["error"]), default=0.0)
            about = {"family": name, **drives[-1]}
            yield informs(f"protection/{world.name.removeprefix('tracking-')}, {variant}: worst", worst, "m", about)
        sample = Sample.joined([drive["sample"] for drive in drives])
        fits = "; ".join("{:.2f}, {:.1f}".format(*tail(sample, part)) for part in (0, 1))
        yield judged(f"protection/tail that fits {name}: factor, freedom; m, deg", fits, "", None)
    of, kilometres = len(sample.error), sum(drive["driven_m"] for drive in drives) / 1000
    for hits, unit in zip(sample.above(PRODUCT), ("m", "degrees"), strict=True):
        text, holds = f"{hits} of {of}: below {100 * upper(hits, of):.2f} %", hits <= RISK * of
        yield judged(f"protection/error > level, {unit}", text, f"<= {100 * RISK:g} %", holds, hits / max(of, 1))
    count = sum(drive["misleading"] for drive in drives)
    yield judged("protection/beyond the alert limit", f"{count} in {kilometres:.1f} km", "0", not count, count)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Levels by kind of site and by family."""
    kinds, families = defaultdict(list), defaultdict(list)
    for drive in (row.details for row in rows if "family" in row.details):
        changed = ", 30 % changed" if drive["variant"] == "changed" else ""
        kinds[f"{drive['family']}: {drive['kind']}{changed}"].append(drive["sample"])
        families[f"{drive['family']}, all"].append(drive["sample"])
    groups = dict(sorted(kinds.items())) | families
    return {"": level_table({name: Sample.joined(some) for name, some in groups.items()})}


def measure(below: Path, world: World, variant: str) -> dict[str, Any]:
    """Return the sample of a plain drive, as lists; kept until the code changes."""
    bench = fingerprint("bench/tracking/drives.py", "bench/tracking/worlds.py", "bench/accuracy/scores.py")
    spec = {"code": fingerprint(*_MEASURED), "bench": bench, "world": repr(world), "variant": variant}

    def work() -> dict[str, Any]:
        recorded = open_world(below, world)
        drive = start(recorded.truth, world.drift, world.seed)
        track = follow(map_of(below, world, variant), recorded, drive)
        error = errors(track, drive.truth)
        sample = Sample.of(track, error, drive.driven)
        about = {"kind": world.kind, "variant": variant, "driven_m": float(drive.driven[-1])}
        about["misleading"] = misleading(beyond_alert_limit(track, error, drive.driven))
        return about | {"sample": sample.to_json()}

    return remembered(below / "protection-results" / f"{world.name}-{variant}.json", spec, work)
