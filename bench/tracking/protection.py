"""Protection levels by split-conformal prediction, on kinds of sites other than those that calibrate them.

Plain drives with odometry that drifts by 0.5 to 5 %, every other block on a map in which 30 % of the buildings and all
cars, poles and trees are others. One pose per ten metres counts, a block. Its score is error over level at a factor of
one, and the factor that the ``calibrated`` family needs is the k-th smallest of n scores, k = ceil((n + 1)(1 - risk)):
a further block that is exchangeable with those exceeds its level with at most that risk, for any distribution.
Below 999 blocks a risk of 1e-3 is out of reach: then the largest score holds for 1 / (n + 1), and the tail's shape
carries it on. The product's factors are judged on the ``reported`` family.

Blocks of one drive are alike: by whole drives the bound is 1 / (drives + 1). A share of errors above the level holds
where its upper bound is below the risk, which takes 2,995 blocks, and fails where its lower bound is above. Towns and
villages were seen while the covariance was made. Nothing is said of faulty sensors, of wrong surveys, or of kinds of
sites that are in neither family.
"""

from __future__ import annotations

import math
import shutil
from argparse import ArgumentParser, Namespace
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import fdtri

from bench.accuracy.scores import Errors, Track, errors, exposed, score
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, informs, interval, judged, number, table, upper
from bench.tracking.drives import follow, start
from bench.tracking.worlds import World, map_of, open_world
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES, RISK, TAILS, axes_of

EVERY = 10.0  # metres of driving of which one pose counts
TO_ALERT = (2.0, 2.0)  # seconds, and metres driven, after which a pose beyond the alert limit is withdrawn
PRODUCT = tuple(TAILS.values())  # tails of the product
PARTS = {"metres": slice(0, 3), "degrees": slice(3, 6), "horizontal": slice(0, 2), "vertical": slice(2, 3)}
"""Axes of each level, in the order of a track's levels."""
Tails = Sequence[tuple[float, float]]


class Sample(NamedTuple):
    """One pose per ten metres, (N, 4) arrays, a column for each of :data:`PARTS`.

    Errors are in metres and degrees, trace and axes of the covariance in m2 and rad2. ``doubt`` is the reported level
    over the level of the covariance alone, for trying other tails on the same drives.
    """

    error: Floats
    doubt: Floats
    trace: Floats
    axes: Floats

    @classmethod
    def of(cls, track: Track, error: Errors, rows: Sequence[int] | Floats) -> Sample:
        """Pick frames of a drive."""
        shape = [[axes_of(C[part, part]) for part in PARTS.values()] for C in track.covariances[rows]]
        spread = np.array(shape, dtype=np.float64).reshape(-1, len(PARTS), 2)
        found = np.column_stack([np.linalg.norm(error.twist[rows, part], axis=1) for part in PARTS.values()])
        found[:, 1] = np.degrees(found[:, 1])
        sample = cls(found, np.ones_like(found), spread[:, :, 0], spread[:, :, 1])
        return sample._replace(doubt=track.levels[rows] / sample.level(PRODUCT))

    def to_json(self) -> dict[str, list[list[float]]]:
        """Return the arrays as lists."""
        return {name: values.tolist() for name, values in self._asdict().items()}

    @classmethod
    def joined(cls, drives: Sequence[Mapping[str, Any]]) -> Sample:
        """Put those of several drives together, each as of :meth:`to_json`."""
        parts = [[np.reshape(drive[name], (-1, len(PARTS))) for drive in drives] for name in cls._fields]
        return cls(*(np.concatenate([np.empty((0, len(PARTS))), *part]) for part in parts))

    def level(self, tails: Tails, risk: float = RISK) -> Floats:
        """(N, 4) levels that tails of the errors give: factor and degrees of freedom of each part."""
        quantiles = [
            factor * np.sqrt(self.trace[:, k] * fdtri(self.axes[:, k], freedom, 1.0 - risk))
            for k, (factor, freedom) in enumerate(tails)
        ]
        quantiles[1] = np.degrees(quantiles[1])
        return np.asarray(self.doubt * np.column_stack(quantiles))

    def above(self, tails: Tails) -> list[int]:
        """Count the errors of each part that are larger than their level."""
        return [int(count) for count in (self.error > self.level(tails)).sum(axis=0)]


def blocks(track: Track, driven: Floats) -> Floats:
    """Return the first frame with a pose of each ten metres, of (N,) metres ``driven`` at each frame."""
    posed = np.flatnonzero(track.tracking)
    return np.asarray(posed[np.unique(np.floor(driven[posed] / EVERY), return_index=True)[1]])


def conformal(sample: Sample, risk: float = RISK) -> tuple[list[float], float]:
    """Return the factor of each part that a sample calibrates, and the risk that it holds for.

    That is ``risk``, or the least that so few blocks can show.

    Raises:
        ValueError: an empty sample.
    """
    count = len(sample.error)
    if not count:
        raise ValueError("no block calibrates nothing")
    held = max(risk, 1.0 / (count + 1))
    rank = min(math.ceil((count + 1) * (1.0 - held) - 1e-9), count)
    scores = sample.error / sample.level([(1.0, freedom) for _, freedom in PRODUCT], held)
    return [float(factor) for factor in np.sort(scores, axis=0)[rank - 1]], held


def beyond_alert_limit(track: Track, error: Errors, driven: Floats) -> list[tuple[float, float]]:
    """Return for each time beyond the alert limit the seconds and metres until its poses were withdrawn or right.

    Of (N,) metres ``driven`` at each frame.
    """
    beyond = track.tracking & ((error.metres > ALERT_METRES) | (error.degrees > ALERT_DEGREES))
    edges = np.diff(np.r_[False, beyond, False].astype(int))
    out = []
    for begin, end in zip(*(np.flatnonzero(edges == sign).tolist() for sign in (1, -1)), strict=True):
        last = min(end, len(driven) - 1)  # where it is withdrawn, or the drive's end
        out.append((float(track.stamps[last] - track.stamps[begin]), float(driven[last] - driven[begin])))
    return out


def misleading(beyond: list[tuple[float, float]]) -> int:
    """Count the times that took longer, or led further, than :data:`TO_ALERT` allows."""
    return sum(seconds > TO_ALERT[0] or metres > TO_ALERT[1] for seconds, metres in beyond)


def level_table(samples: Mapping[str, Sample]) -> str:
    """Lay out, by name of the group: blocks, how many are above their level, the worst, and how wide the levels are."""
    lines = []
    for name, sample in samples.items():
        level = sample.level(PRODUCT)
        worst, wide = (sample.error / level).max(axis=0), np.median(level, axis=0)
        cells = [name, str(len(level)), " / ".join(map(str, sample.above(PRODUCT)))]
        lines.append([*cells, " / ".join(f"{part:.2f}" for part in worst), " / ".join(number(v, 2) for v in wide)])
    order = "m / deg / plane / height"
    return table(("poses", "one per 10 m", f"> level: {order}", "worst / level", "level, median"), lines)


def factor_table(samples: Mapping[str, tuple[Sample, int]]) -> str:
    """Lay out the factors that each family calibrates beside the product's, with number of blocks and drives."""
    lines = [["product", "", "", "", *(f"{factor:.2f}" for factor, _ in PRODUCT)]]
    for name, (sample, drives) in samples.items():
        factors, held = conformal(sample)
        cells = [name, str(len(sample.error)), f"{held:.2g}", f"{1 / (drives + 1):.2g}"]
        lines.append([*cells, *(f"{factor:.2f}" for factor in factors)])
    return table(("family", "blocks", "risk, by blocks", "by drives", *PARTS), lines)


WORLDS = 30  # of each family
_SPEEDS, _DRIFTS = (2.0, 3.0, 4.0, 5.0), (0.005, 0.01, 0.02, 0.03, 0.05)
_LIDARS = ("vlp16", "os64", "mid360")


class Family(NamedTuple):
    """Kinds of sites, the seed of the first world, and whether every other block is driven on an earlier map."""

    kinds: tuple[str, ...]
    seed: int
    changes: bool

    def worlds(self, count: int, metres: float = 400.0) -> Iterator[tuple[World, str]]:
        """Yield worlds with drives of so many metres, and which of their maps is used."""
        for k in range(count):
            block, kind = divmod(k, len(self.kinds))
            speed, drift = _SPEEDS[(k + block) % len(_SPEEDS)], _DRIFTS[k % len(_DRIFTS)]
            world = World(self.kinds[kind], _LIDARS[block % 3], self.seed + k, 260.0, metres, speed, drift)
            yield world, "changed" if self.changes and block % 2 else "plain"


FAMILIES = {
    "calibrated": Family(("campus", "sparse-forest"), 5301, True),
    "reported": Family(("town", "village", "industrial", "forest"), 5201, True),
}  # the verdict is on the last one


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--worlds", type=int, default=WORLDS, metavar="N", help=f"of each family ({WORLDS})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive, then the factors of each family, and the verdict on the reported one."""
    for name, family in FAMILIES.items():
        drives = []
        for world, variant in family.worlds(*((1, 80.0) if asked.quick else (asked.worlds,))):
            drives.append(measure(folder(), world, variant))
            worst = max((error[0] for error in drives[-1]["sample"]["error"]), default=0.0)
            about = {"family": name, "way": world.name, **drives[-1]}
            yield informs(f"protection/{world.name.removeprefix('tracking-')}, {variant}: worst", worst, "m", about)
        sample = Sample.joined([drive["sample"] for drive in drives])
        factors, held = conformal(sample)
        text = ", ".join(f"{factor:.2f}" for factor in factors)
        yield judged(f"protection/factors that {name} drives need at {held:.2g}: {', '.join(PARTS)}", text, "", None)
    of = len(sample.error)
    for hits, unit in zip(sample.above(PRODUCT), PARTS, strict=True):
        low, high = interval(hits, of)[0], upper(hits, of)
        text, holds = (
            f"{hits} of {of}: below {100 * high:.2f} %",
            True if high <= RISK else False if low > RISK else None,
        )
        target = "" if holds is None else f"<= {100 * RISK:g} %"
        yield judged(f"protection/error > level, {unit}", text, target, holds, hits / max(of, 1))
    count = sum(drive["misleading"] for drive in drives)
    yield judged("protection/hazardously misleading", str(count), "0", not count, count)
    yield exposed("protection", "hazardously misleading", count, drives)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Factors by family; levels by kind of site and by family."""
    kinds, families = defaultdict(list), defaultdict(list)
    for drive in (row.details for row in rows if "family" in row.details):
        changed = ", 30 % changed" if drive["variant"] == "changed" else ""
        kinds[f"{drive['family']}: {drive['kind']}{changed}"].append(drive["sample"])
        families[drive["family"]].append(drive["sample"])
    groups = dict(sorted(kinds.items())) | {f"{name}, all": some for name, some in families.items()}
    return {
        "factors": factor_table({name: (Sample.joined(some), len(some)) for name, some in families.items()}),
        "": level_table({name: Sample.joined(some) for name, some in groups.items()}),
    }


def measure(below: Path, world: World, variant: str) -> dict[str, Any]:
    """Return the sample of a plain drive, as lists, with errors and covariances; kept until the code changes."""
    parts = "tracking/drives", "tracking/worlds", "tracking/protection", "accuracy/scores"
    bench = fingerprint(*(f"bench/{part}.py" for part in parts))
    spec = {"code": fingerprint(), "bench": bench, "world": repr(world), "variant": variant}

    def work() -> dict[str, Any]:
        recorded = open_world(below, world)
        drive = start(recorded.truth, world.drift, world.seed)
        track = follow(map_of(below, world, variant), recorded, drive)
        error = errors(track, drive.truth)
        chosen = blocks(track, drive.driven)
        return {
            "kind": world.kind,
            "variant": variant,
            **score(track, drive.truth, drive.driven, ()),
            "misleading": misleading(beyond_alert_limit(track, error, drive.driven)),
            "sample": Sample.of(track, error, chosen).to_json(),
            "twist": error.twist[chosen].tolist(),
            "covariances": track.covariances[chosen].tolist(),
        }

    figures = remembered(below / "protection-results" / f"{world.name}-{variant}.json", spec, work)
    shutil.rmtree(below / world.name, ignore_errors=True)  # half a gigabyte
    return figures
