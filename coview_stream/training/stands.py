"""Forest stands at two times: when the map is flown, and when the robot drives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.sim.mesh import join
from coview_stream.sim.scenes import SceneState
from coview_stream.training import tree_meshes
from coview_stream.training.recipe import Recipe
from coview_stream.training.tree_meshes import join_standing
from coview_stream.training.trees import PATTERNS, Terrain, Trees, draw_species, draw_stems, draw_trees, opened

_STEEPNESS = ((0.0, 0.1), (0.1, 0.4), (0.4, 1.0))  # flat, hilly, steep, as shares of the range


class Stand(NamedTuple):
    """A forest."""

    mapped: SceneState  # geometry when the map is flown
    now: SceneState  # geometry when the robot drives
    terrain: Terrain  # the ground
    trees: Trees  # all trees of both times
    obstacles: Floats  # (N, 3) x, y and radius of obstacles for the robot, metres
    drawn: dict[str, Any]  # values that were drawn for the stand, for JSON


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
    first, second = (bool(winter) for winter in rng.random(2) < recipe.leaf_off)
    winters = (first, first if rng.random() < 0.5 else second)  # in half or more of the cases both are in one season
    mortality, wind = recipe.draw(rng, "mortality"), recipe.draw(rng, "wind")
    understory = recipe.draw(rng, "understory") * float(rng.random() < 0.8)
    leaves = tree_meshes.crowns(rng, trees)
    bushes = tree_meshes.bushes(rng, terrain, understory)
    many, area = rng.random(2) < 0.6, (2 * terrain.half) ** 2
    logs = tree_meshes.logs(rng, terrain, int(area * rng.uniform(0, 0.006) * many[0]))
    rocks = tree_meshes.rocks(rng, terrain, int(area * rng.uniform(0, 0.006) * many[1]))
    solid = [terrain.mesh(), join_standing([logs, rocks], np.ones(1, dtype=bool))]
    living, bare = rng.integers(0, 7), rng.integers(8, 22)  # branches of a tree
    leafless = trees.dead | (any(winters) & ~trees.evergreen)
    branches = tree_meshes.branches(rng, trees, rng.poisson(np.where(leafless, bare, living)))
    woody = [tree_meshes.stems(trees), branches]
    # a share of the trees stands, or has leaves, at only one of the two times
    fate = np.where(rng.random(len(xy)) < mortality, rng.integers(1, 4, len(xy)), 0)
    there, leafed = (fate != 2, fate != 1), (fate >= 0, fate != 3)
    shifts = (None, rng.normal(0, wind, (len(xy), 2)))
    states = []
    for k in range(2):
        green = there[k] & leafed[k] & ~trees.dead & (trees.evergreen | (not winters[k]))
        grown = rng.random(len(bushes.owner)) < 0.85  # the understory changes most
        foliage = join([join_standing(leaves, green, shifts[k]), join_standing([bushes], grown)])
        states.append(SceneState(join([*solid, join_standing(woody, there[k])]), foliage))
    # leaves that hang to the ground block the robot too
    hanging = (trees.base < 1.6) & ~trees.dead
    radius = np.where(hanging, np.maximum(0.6 * trees.crown, trees.radius), trees.radius)
    obstacles = np.column_stack([trees.x, trees.y, radius])[there[1]]
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
    return Stand(states[0], states[1], terrain, trees, obstacles, drawn)


def tags(drawn: dict[str, Any]) -> str:
    """Describe a stand in a few words, for tables by forest type."""
    families = sorted({species["family"] for species in drawn["species"]})
    season = "leaf-off" if any(drawn["winter"]) else "leaf-on"
    land = "flat" if drawn["slope"] < 3 else "hilly" if drawn["slope"] < 12 else "steep"
    stems = "sparse" if drawn["stems"] < 300 else "medium" if drawn["stems"] < 700 else "dense"
    return " ".join(["forest", drawn["pattern"], stems, land, season, "+".join(families)])
