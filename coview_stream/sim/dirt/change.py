"""Change since the survey: years in which buildings go and come, and seasons that bare the trees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_stream.geometry.arrays import Floats, Indices
from coview_stream.sim.dirt.ranges import within
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.mesh import EMPTY, Mesh, placed
from coview_stream.sim.scenes import Footprint, Parts, Scene

_GONE, _NEW, _REBUILT = 0.01, 0.01, 0.005  # share of the buildings a year; set by hand
_FELLED = 0.015  # share of the trees a year, and as many new ones; set by hand
_GROWTH = 0.12  # metres a year that a tree grows; set by hand
_SMALLEST = 0.6  # share of its height now that a tree had at least


@dataclass(frozen=True)
class Years:
    """Years between the survey and the run.

    Buildings were demolished, built, and replaced by others, at least one of each; trees were felled and planted and
    have grown; other cars are parked.

    Attributes:
        years: between survey and run.

    Raises:
        ConfigError: a value out of its range.
    """

    years: float = 10.0

    def __post_init__(self) -> None:
        within(self, years=(0.0, 60.0))


@dataclass(frozen=True)
class Seasons:
    """Seasons: the survey saw bare trees and bushes, the robot sees leaves. Conifers stay as they are.

    Attributes:
        bare: probability that a pulse passes one surface of a bare crown.

    Raises:
        ConfigError: a value out of its range.
    """

    bare: float = 0.88

    def __post_init__(self) -> None:
        within(self, bare=(0.0, 1.0))


@dataclass(frozen=True)
class Fate:
    """What became of the buildings, as indices of ``Scene.footprints``.

    Attributes:
        gone: those that the survey saw and the robot does not.
        new: those that the robot sees and the survey did not.
        rebuilt: those that were replaced by another building.
    """

    gone: Indices
    new: Indices
    rebuilt: Indices


def aged(scene: Scene, change: Years, rng: np.random.Generator) -> tuple[Scene, Fate]:
    """Return a scene that was mapped ``change.years`` ago, and what became of its buildings; needs ``Scene.parts``."""
    before, after = drawn_parts(scene)
    order, counts = rng.permutation(len(scene.footprints)), []
    for rate in (_GONE, _NEW, _REBUILT):
        share = 1.0 - (1.0 - rate) ** change.years
        counts.append(max(round(share * len(order)), int(change.years > 0)))
    gone, new, rebuilt, _ = np.split(order, np.cumsum(counts))
    mapped, now = list(before.built), list(after.built)
    for house in gone:
        now[scene.houses[house]] = EMPTY
    for house in new:
        mapped[scene.houses[house]] = EMPTY
    for house in rebuilt:
        now[scene.houses[house]] = _another(scene, scene.footprints[house], rng)
    old = replace(before, built=tuple(mapped), trees=_younger(before.trees, change, rng), cars=_half(before.cars, 0))
    new_parts = replace(after, built=tuple(now), trees=_kept(after.trees, change, rng), cars=_half(after.cars, 1))
    return with_parts(scene, old, new_parts), Fate(gone, new, rebuilt)


def drawn_parts(scene: Scene) -> tuple[Parts, Parts]:
    """Return what a scene was drawn from, when the map was made and now."""
    assert scene.parts is not None, "the scene was not drawn by build_scene"
    return scene.parts


def with_parts(scene: Scene, before: Parts, after: Parts) -> Scene:
    """Return the scene put together from other parts."""
    states = before.state(scene.site), after.state(scene.site)
    return replace(scene, parts=(before, after), mapped=states[0], now=states[1])


def _another(scene: Scene, plot: Footprint, rng: np.random.Generator) -> Mesh:
    plots = KINDS[scene.kind].plots
    drawn = plots[int(rng.integers(len(plots)))].draw(rng, plot.w, plot.d)
    return placed(drawn, plot.x, plot.y, plot.ground, plot.yaw)


def _younger(trees: Floats, change: Years, rng: np.random.Generator) -> Floats:
    """Return the trees (N, 8) of today as they were, less those that were planted since."""
    rows = _kept(trees, change, rng).copy()
    then = np.maximum(1.0 - _GROWTH * change.years / rows[:, 2], _SMALLEST)
    rows[:, 2:4] *= then[:, None]
    return rows


def _kept(trees: Floats, change: Years, rng: np.random.Generator) -> Floats:
    return np.asarray(trees[rng.random(len(trees)) < (1.0 - _FELLED) ** change.years])


def _half(cars: Floats, which: int) -> Floats:
    """Return every other vehicle: none of them stays for years."""
    return cars[which::2]
