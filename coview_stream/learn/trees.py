"""The trees of a stand as columns, and how their sizes and species are drawn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coview_stream.learn.parts import Flags, Ints
from coview_stream.learn.recipe import Recipe
from coview_stream.learn.terrain import Terrain, waves
from coview_stream.sim.mesh import Floats

FAMILIES = ("lumpy", "cone", "storeys", "umbrella", "clumps", "column")
_EVERGREEN = {"cone": 0.9, "storeys": 0.95, "umbrella": 0.5, "column": 0.6}  # chance, else never


class Species(NamedTuple):
    """Its crowns' family, their width and base in shares of the height, stem thickness, and whether it keeps leaves."""

    family: str
    width: float
    base: float
    thick: float
    evergreen: bool


class Trees(NamedTuple):
    """(N,) each, metres: foot, height, stem radius, crown radius and base over the foot; family and species by index.

    ``lean`` (N, 2) metres per metre of height; ``offset`` (N, 2) of the crown's middle from the stem's axis.
    """

    x: Floats
    y: Floats
    z: Floats
    height: Floats
    radius: Floats
    crown: Floats
    base: Floats
    lean: Floats
    offset: Floats
    family: Ints
    evergreen: Flags
    dead: Flags

    def axis(self, up: Floats, of: Ints | slice = slice(None)) -> Floats:
        """Points (M, 3) of the stems' axes ``up`` (M,) metres over their feet; the crowns' weight bends them."""
        bent = self.offset[of] * (0.7 * np.clip(up / self.height[of], 0, 1) ** 1.5)[:, None]
        xy = np.column_stack([self.x[of], self.y[of]]) + self.lean[of] * up[:, None] + bent
        return np.column_stack([xy, self.z[of] + up])

    def crown_axis(self, up: Floats, of: Ints | slice = slice(None)) -> Floats:
        """Points (M, 3) in the middle of the crowns, ``up`` (M,) metres over their feet."""
        xy = np.column_stack([self.x[of], self.y[of]]) + self.lean[of] * up[:, None] + self.offset[of]
        return np.column_stack([xy, self.z[of] + up])


def draw_species(rng: np.random.Generator, recipe: Recipe) -> list[Species]:
    """Draw the one to four species of a stand."""
    species = []
    for _ in range(int(rng.choice([1, 2, 3, 4], p=[0.35, 0.3, 0.2, 0.15]))):
        family = str(rng.choice(FAMILIES))
        evergreen = bool(rng.random() < _EVERGREEN.get(family, 0.0))
        width, base = recipe.draw(rng, "crown_width"), recipe.draw(rng, "crown_base")
        species.append(Species(family, width, base, rng.uniform(0.006, 0.016), evergreen))
    return species


def draw_trees(
    rng: np.random.Generator, recipe: Recipe, terrain: Terrain, xy: Floats, species: list[Species]
) -> Trees:
    """Draw the sizes of trees that stand at (N, 2)."""
    count = len(xy)
    kind = _mixed(rng, xy, len(species))
    height = _heights(rng, recipe, xy)
    pick = {name: np.array([getattr(each, name) for each in species])[kind] for name in Species._fields}
    crown = _crowns(rng, recipe, pick["width"], height, (2 * terrain.half) ** 2)
    base = np.clip(pick["base"] + rng.normal(0, 0.06, count), *recipe.crown_base) * height
    radius = np.clip(pick["thick"] * height * rng.lognormal(0, 0.25, count), *recipe.stem_radius)
    far = recipe.draw(rng, "crown_offset") * np.sqrt(rng.random(count)) * np.minimum(1, crown / 1.5)
    angle = rng.uniform(0, 2 * np.pi, count)
    return Trees(
        x=xy[:, 0],
        y=xy[:, 1],
        z=terrain.z(*xy.T),
        height=height,
        radius=radius,
        crown=crown,
        base=base,
        lean=rng.normal(0, rng.uniform(0.0, 0.05), (count, 2)),
        offset=far[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]),
        family=np.array([FAMILIES.index(str(name)) for name in pick["family"]], dtype=np.int64),
        evergreen=pick["evergreen"].astype(bool),
        dead=rng.random(count) < recipe.draw(rng, "dead"),
    )


def _crowns(rng: np.random.Generator, recipe: Recipe, share: Floats, height: Floats, area: float) -> Floats:
    """Radii (N,) of crowns, metres, from their usual ``share`` of the height; half of the stands are closed."""
    low, high = (each * height / 2 for each in recipe.crown_width)
    wide = share * rng.lognormal(0, 0.15, len(height)) * height / 2
    if rng.random() < 0.5:
        wide = wide * np.sqrt(rng.uniform(0.7, 2.0) * area / max(float((np.pi * wide**2).sum()), 1.0))
    # where trees are dense their crowns stay narrow
    room = max(0.6, rng.uniform(0.8, 1.8) * float(np.sqrt(area / max(len(height), 1))) / 2)
    return np.minimum(np.clip(wide, low, high), room * rng.uniform(0.85, 1.15, len(height)))


def _mixed(rng: np.random.Generator, xy: Floats, kinds: int) -> npt.NDArray[np.intp]:
    """Species (N,) by index: in patches, or one here one there."""
    scores = [
        waves(rng, rng.uniform(30, 100))(*xy.T) * rng.uniform(0, 2) + rng.gumbel(size=len(xy)) + rng.normal()
        for _ in range(kinds)
    ]
    return np.asarray(np.argmax(np.array(scores), axis=0))


def _heights(rng: np.random.Generator, recipe: Recipe, xy: Floats) -> Floats:
    low, high = recipe.tree_height
    mean = rng.uniform(low + 0.05 * (high - low), low + 0.9 * (high - low))
    height = mean * (1 + rng.uniform(0, 0.2) * waves(rng, rng.uniform(40, 150))(*xy.T))
    if rng.random() < 0.4:  # uneven-aged
        height = height * (1 - rng.uniform(0.3, 0.8) * rng.beta(1.0, rng.uniform(1.0, 2.5), len(xy)))
    return np.clip(height * (1 + rng.normal(0, rng.uniform(0.03, 0.12), len(xy))), low, high)
