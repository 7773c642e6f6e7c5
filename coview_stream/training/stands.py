"""Forest stands at two times: when the map is flown, and when the robot drives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.sim.mesh import Mesh, join
from coview_stream.sim.scenes import SceneState
from coview_stream.training import tree_meshes
from coview_stream.training.recipe import Recipe
from coview_stream.training.tree_meshes import MeshCopies, join_standing
from coview_stream.training.trees import PATTERNS, Terrain, Trees, draw_species, draw_stems, draw_trees, opened

_STEEPNESS = ((0.0, 0.1), (0.1, 0.4), (0.4, 1.0))  # flat, hilly, steep: shares of the range


class Stand(NamedTuple):
    """A forest.

    Attributes:
        mapped: geometry when the map is flown.
        now: geometry when the robot drives.
        terrain: the ground.
        trees: all trees of either time.
        obstacles: (N, 3) x, y and radius of obstacles for the robot, metres.
        drawn: values that were drawn for the stand, for JSON.
    """

    mapped: SceneState
    now: SceneState
    terrain: Terrain
    trees: Trees
    obstacles: Floats
    drawn: dict[str, Any]


def draw_stand(rng: np.random.Generator, recipe: Recipe, half: float) -> Stand:
    """Draw a forest of +-``half`` metres."""
    land = _STEEPNESS[int(rng.integers(len(_STEEPNESS)))]
    low, high = recipe.slope
    slope = low + (high - low) * rng.uniform(*land)
    terrain = Terrain(rng, half + 10.0, slope, recipe.draw(rng, "roughness"))
    pattern = str(rng.choice(PATTERNS))
    density = float(rng.uniform(*np.sqrt(recipe.stems)) ** 2)
    xy = draw_stems(rng, pattern, density, half)
    xy = xy[opened(rng, xy, half)]
    species = draw_species(rng, recipe)
    trees = draw_trees(rng, recipe, terrain, xy, species)
    winters = _winters(rng, recipe)
    mortality, wind = recipe.draw(rng, "mortality"), recipe.draw(rng, "wind")
    understory = recipe.draw(rng, "understory") * float(rng.random() < 0.8)
    leaves = tree_meshes.crowns(rng, trees)
    bushes = tree_meshes.bushes(rng, terrain, understory)
    solid = [terrain.mesh(), *_litter(rng, terrain)]
    woody = [tree_meshes.stems(trees), tree_meshes.branches(rng, trees, _branch_counts(rng, trees, any(winters)))]
    there, leafed = _fates(rng, len(xy), mortality)
    shifts = (None, rng.normal(0, wind, (len(xy), 2)))
    states = [
        _state(rng, solid, woody, leaves, bushes, there[k], leafed[k] & tree_meshes.leafy(trees, winters[k]), shifts[k])
        for k in range(2)
    ]
    drawn = {
        "pattern": pattern,
        "stems": round(1e4 * len(xy) / (2 * half) ** 2),
        "height": round(float(trees.height.mean()), 1) if len(xy) else 0.0,
        "species": [kind._asdict() for kind in species],
        "slope": round(slope, 1),
        "winter": [bool(winter) for winter in winters],
        "mortality": mortality,
        "understory": understory,
        "wind": wind,
    }
    return Stand(states[0], states[1], terrain, trees, _obstacles(trees, there[1]), drawn)


def tags(drawn: dict[str, Any]) -> str:
    """Describe a stand in a few words, for tables by forest type."""
    families = sorted({species["family"] for species in drawn["species"]})
    season = "leaf-off" if any(drawn["winter"]) else "leaf-on"
    land = "flat" if drawn["slope"] < 3 else "hilly" if drawn["slope"] < 12 else "steep"
    stems = "sparse" if drawn["stems"] < 300 else "medium" if drawn["stems"] < 700 else "dense"
    return " ".join(["forest", drawn["pattern"], stems, land, season, "+".join(families)])


def _winters(rng: np.random.Generator, recipe: Recipe) -> tuple[bool, bool]:
    """Draw whether it is winter at the two times: the same season in half of the cases."""
    first, second = (bool(winter) for winter in rng.random(2) < recipe.leaf_off)
    return (first, first) if rng.random() < 0.5 else (first, second)


def _fates(rng: np.random.Generator, count: int, mortality: float) -> tuple[tuple[Bools, Bools], tuple[Bools, Bools]]:
    """Draw masks of the trees that stand and of those with leaves, at each time; a share of ``mortality`` differs."""
    fate = np.where(rng.random(count) < mortality, rng.integers(1, 4, count), 0)
    everyone = np.ones(count, dtype=bool)
    return (fate != 2, fate != 1), (everyone, fate != 3)


def _branch_counts(rng: np.random.Generator, trees: Trees, winter: bool) -> Ints:
    """Draw the number of branches (N,) of each tree."""
    living, bare = rng.integers(0, 7), rng.integers(8, 22)
    leafless = trees.dead | (winter & ~trees.evergreen)
    return rng.poisson(np.where(leafless, bare, living))


def _litter(rng: np.random.Generator, terrain: Terrain) -> list[Mesh]:
    area, everything = (2 * terrain.half) ** 2, np.ones(1, dtype=bool)
    many = rng.random(2) < 0.6
    logs = tree_meshes.logs(rng, terrain, int(area * rng.uniform(0, 0.006) * many[0]))
    rocks = tree_meshes.rocks(rng, terrain, int(area * rng.uniform(0, 0.006) * many[1]))
    return [join_standing([logs, rocks], everything)]


def _state(
    rng: np.random.Generator,
    solid: list[Mesh],
    woody: list[MeshCopies],
    leaves: list[MeshCopies],
    bushes: MeshCopies,
    there: Bools,
    leafed: Bools,
    shift: Floats | None,
) -> SceneState:
    grown = rng.random(len(bushes.owner)) < 0.85  # the understory changes most
    foliage = [join_standing(leaves, there & leafed, shift), join_standing([bushes], grown)]
    return SceneState(join([*solid, join_standing(woody, there)]), join(foliage))


def _obstacles(trees: Trees, there: Bools) -> Floats:
    # leaves that hang to the ground block the robot as well
    low = trees.base < 1.6
    radius = np.where(low & ~trees.dead, np.maximum(0.6 * trees.crown, trees.radius), trees.radius)
    return np.column_stack([trees.x, trees.y, radius])[there]
