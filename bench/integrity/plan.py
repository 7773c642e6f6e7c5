"""The plan: sites, the runs on each site's map, and the family of each run.

A site is drawn and mapped once and serves several runs, each with its own drive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Literal

import numpy as np

Group = Literal["calibration", "reported", "surveys", "runs"]
Class = Literal["ordinary", "outside", "near copies", "gap", "real run"]

LIDARS = ("vlp16", "mid360", "os64")
FIRST_SEED = {"calibration": 41_000, "reported": 261_000, "surveys": 401_000}  # new after a run has changed the product
STATED = (1e-1, 1e-2, 1e-3, 1e-4)
"""Stated errors; the first keyframe of a run below each counts, accepted or not."""

_CHOICES = 230  # random stream

STREETS: dict[str, tuple[str, ...]] = {
    "calibration": ("town", "campus"),
    "reported": ("village", "industrial", "suburb", "harbour", "forest"),
}
"""Kinds of sites for ordinary, outside and altered runs."""

COPIES: dict[str, tuple[str, ...]] = {
    "calibration": ("terraces", "plantation"),
    "reported": ("yard", "rows", "boxes", "avenue", "court"),
}
"""Kinds of sites that are near copies of themselves."""

ALTERED: dict[str, tuple[tuple[str, ...], ...]] = {
    "calibration": (("edge",),),
    "reported": (("mirrored", "shifted"), ("old", "scaled"), ("tilted", "edge")),
}
"""Families of near copies on maps of streets, one tuple per site."""

FAMILIES: dict[str, Class] = {
    **{f"ordinary {kind}": "ordinary" for kinds in STREETS.values() for kind in kinds},  # 0 to 40 % changed
    "outside, same kind": "outside",  # another site of the map's kind: every fix is false
    "outside, other kind": "outside",  # a site of another kind: every fix is false
    "terraces": "near copies",  # identical terraces; for half of the runs with other trees, cars and poles
    "plantation": "near copies",  # equal objects on a grid; for half of the runs on another grid now
    "yard": "near copies",  # container yard, every stack another: right by ground and masts
    "rows": "near copies",  # equal rows of houses, of which one is another house now
    "boxes": "near copies",  # 24 x 40 equal boxes, driven along or across
    "avenue": "near copies",  # facades, trees or walls that are the same all along
    "court": "near copies",  # court of 4-fold symmetry
    "mirrored": "outside",  # the map mirrored: every fix is false
    "shifted": "near copies",  # all buildings 4 m off: right by ground and trees
    "old": "near copies",  # 50 % of buildings, trees, cars and poles others
    "scaled": "near copies",  # the map 3-5 % too large or small: right under the same scaling
    "tilted": "near copies",  # the map tilted by 2-4 degrees: right where it fits
    "edge": "near copies",  # 10-40 m from the map's border, inside or outside
    "survey": "ordinary",  # the map is one half of a real survey, the world the other half
    "survey elsewhere": "outside",  # another square of the same survey, or another survey: every fix is false
    "survey shifted": "near copies",  # all that is solid 4 m off: right by ground and trees
    "survey gap": "gap",  # 40 m around the drive are not on the map, the rest of its rows of houses is
    "survey twice": "near copies",  # a block of 80 m around the drive is on the map twice
    "real run": "real run",  # a recorded run from any of its frames, forwards or back, on its map
}  # fmt: skip
"""Class of each family of runs."""


@dataclass(frozen=True)
class Run:
    """A drive up to its first fix."""

    group: Group
    family: str  # a key of FAMILIES
    kind: str  # kind of the mapped site
    seed: int  # seed of the mapped site
    number: int  # of the run among the runs on this map
    sensor: str
    changed: float = 0.0  # share of replaced trees, cars and poles; made-up kinds define their own
    rebuilt: float = 0.0  # share of replaced buildings
    driven: str = ""  # kind of the site of the drive, if it is another site
    beyond: bool = False  # a run at an edge is outside the border

    @property
    def key(self) -> str:
        """Unique name."""
        return f"{self.group}/{self.kind}-{self.seed}/{self.number}-{self.family}"

    @property
    def drive_seed(self) -> int:
        """Seed of the drive, and of its site if that is another one."""
        return 16 * self.seed + self.number


Site = tuple[Run, ...]
"""The runs on one map."""


def plan(group: Group, runs: int) -> list[Site]:
    """Return the sites of the first ``runs`` runs, in the proportions of all."""
    out: list[Site] = []
    for k in count():
        for site in _surveys(k) if group == "surveys" else _simulated(group, k):
            out.append(site[:runs])
            runs -= len(out[-1])
            if not runs:
                return out
    raise AssertionError("count() ended")


def real_runs(names: Iterable[str], starts: int = 8) -> list[Site]:
    """Return the drives on each set of real data: from so many of its frames, every other one backwards."""
    return [tuple(Run("runs", "real run", name, 0, k, "real") for k in range(starts)) for name in names]


def _surveys(k: int) -> Iterator[Site]:
    """Three maps of real surveys: as it is, with a gap, and with a block twice."""
    seed = FIRST_SEED["surveys"] + 3 * k
    for kind, families in (
        ("survey", ("survey", "survey", "survey elsewhere", "survey elsewhere", "survey elsewhere", "survey shifted")),
        ("gap", ("survey gap", "survey gap")),
        ("twice", ("survey twice", "survey twice")),
    ):
        sensor = _choices(seed)[1]
        yield tuple(
            Run("surveys", family, kind, seed, n, sensor(n), driven="survey" * (family == "survey elsewhere"))
            for n, family in enumerate(families)
        )
        seed += 1


def _simulated(group: Group, k: int) -> Iterator[Site]:
    """Streets and near copies in turn."""
    kinds, altered, copies, seed = STREETS[group], ALTERED[group], COPIES[group], FIRST_SEED[group] + 2 * k
    yield _street(group, kinds[k % len(kinds)], seed, altered[k % len(altered)], k // len(altered))
    yield _copy(group, copies[k % len(copies)], seed + 1, k // len(copies))


def _street(group: Group, kind: str, seed: int, altered: tuple[str, ...], turn: int) -> Site:
    """Three ordinary runs, three outside and near copies on the map of one site."""
    rng, sensor = _choices(seed)
    others = [each for each in STREETS[group] if each != kind]
    shares = (0.0, *rng.uniform((0.05, 0.2), (0.2, 0.4)))
    out = [
        Run(group, f"ordinary {kind}", kind, seed, k, sensor(k), round(share, 3), round(share, 3))
        for k, share in enumerate(shares)
    ]
    for k, other in enumerate((kind, *(str(each) for each in rng.choice(others, 2))), start=3):
        family = f"outside, {'same' if other == kind else 'other'} kind"
        share = round(float(rng.uniform(0.0, 0.4)), 3)
        out.append(Run(group, family, kind, seed, k, sensor(k), share, driven=other))
    for k, family in enumerate(altered, start=6):
        family = "mirrored" if family == "shifted" and kind == "forest" else family  # hardly a building to shift
        share = 0.5 if family == "old" else round(float(rng.uniform(0.0, 0.2)), 3)
        rebuilt, beyond = share if family == "old" else 0.0, family == "edge" and turn % 2 == 1
        out.append(Run(group, family, kind, seed, k, sensor(k), share, rebuilt, beyond=beyond))
    return tuple(out)


def _copy(group: Group, kind: str, seed: int, turn: int) -> Site:
    """Two runs on the map of one near copy of itself."""
    rng, sensor = _choices(seed)
    shares = {
        "terraces": (0.0, 1.0), "plantation": (float(turn % 2), 1.0 - turn % 2), "yard": (1.0, 1.0),
        "rows": tuple(rng.uniform(0.0, 0.3, 2).round(3)),
    }.get(kind, (0.0, 0.0))  # fmt: skip
    return tuple(Run(group, kind, kind, seed, k, sensor(k), float(share)) for k, share in enumerate(shares))


def _choices(seed: int) -> tuple[np.random.Generator, Callable[[int], str]]:
    rng = np.random.default_rng([seed, _CHOICES])
    order = rng.permutation(len(LIDARS))
    return rng, lambda k: LIDARS[order[k % len(LIDARS)]]
