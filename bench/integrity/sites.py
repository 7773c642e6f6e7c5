"""Building blocks of made-up sites and changes of scenes; metres, z up, origin in the middle, axes turned by a yaw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.tracking.worlds import earlier, owners
from coview_stream.geometry.arrays import Floats
from coview_stream.sim import furniture, vegetation
from coview_stream.sim.layout import Layout, Site, resample
from coview_stream.sim.mesh import Mesh, join, placed
from coview_stream.sim.scenes import Scene, SceneState
from coview_stream.sim.vegetation import TreeMix

MARGIN = 50.0
"""Metres of a scene beyond its map, as the simulator has it."""

_ROUTE_STEP, _STREET_STEP = 0.25, 1.0  # metres, the simulator's
_PARKING = 6.4  # metres, of a parking place


class Contents(NamedTuple):
    """Things of a site at one time."""

    solid: Sequence[Mesh] = ()
    foliage: Sequence[Mesh] = ()


def turned(points: Floats, yaw: float) -> Floats:
    """Turn (N, 2) points about the origin."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(np.asarray(points, dtype=np.float64) @ np.array([[c, s], [-s, c]]))


def loop(x: tuple[float, float], y: tuple[float, float], radius: float = 6.0) -> Floats:
    """Return a closed rectangle (N, 2) with round corners, counter-clockwise."""
    (x0, x1), (y0, y1) = x, y
    parts = []
    for cx, cy, begin in ((x1, y0, -0.5), (x1, y1, 0.0), (x0, y1, 0.5), (x0, y0, 1.0)):
        centre = np.array([cx - radius if cx == x1 else cx + radius, cy - radius if cy == y1 else cy + radius])
        arc = np.pi * (begin + np.linspace(0, 0.5, 16))
        parts.append(centre + radius * np.column_stack([np.cos(arc), np.sin(arc)]))
    return np.concatenate([*parts, parts[0][:1]])


def there_and_back(line: Floats, radius: float = 1.5) -> Floats:
    """Return a closed way along a polyline (N, 2) and back beside it, with a half circle at either end."""
    line = resample(line, _STREET_STEP)
    along = np.gradient(line, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    ends = []
    for at, heading in ((-1, 1.0), (0, -1.0)):
        angle = np.linspace(-np.pi / 2, np.pi / 2, 9)[1:-1, None]
        forward = heading * np.array([normal[at, 1], -normal[at, 0]])
        ends.append(line[at] + radius * (np.sin(angle) * heading * normal[at] + np.cos(angle) * forward))
    way = [line - radius * normal, ends[0], (line + radius * normal)[::-1], ends[1], (line - radius * normal)[:1]]
    return np.concatenate(way)


def layout_of(route: Floats, streets: Sequence[Floats], half: float, half_width: float, yaw: float) -> Layout:
    """Return streets and a closed route, turned by ``yaw`` and cut at the scene's border."""
    inside = []
    for line in streets:
        line = resample(turned(line, yaw), _STREET_STEP)
        line = line[(np.abs(line) < half).all(axis=1)]
        if len(line) > 10:
            inside.append(line)
    return Layout(resample(turned(route, yaw), _ROUTE_STEP), tuple(inside), half_width)


def scene_of(kind: str, size: float, site: Site, mapped: Contents, now: Contents) -> Scene:
    """Put a scene together; no building of it is rebuilt or shifted, so it has no footprints."""
    states = [SceneState(join([site.mesh(), *each.solid]), join(each.foliage)) for each in (mapped, now)]
    return Scene(kind, size, states[0], states[1], site, site.layout.route, ())


def stand(mesh: Mesh, site: Site, xy: Floats, yaw: float) -> Mesh:
    """Put a mesh on the ground at ``xy``."""
    return placed(mesh, float(xy[0]), float(xy[1]), site.height(float(xy[0]), float(xy[1])), yaw)


class Movables(NamedTuple):
    """Objects that may change: rows of trees, cars and poles, first those of the survey, then equally many spares."""

    trees: Floats
    cars: Floats
    poles: Floats


def movables(
    rng: np.random.Generator, site: Site, trees: float, species: TreeMix, cars: float, poles: float
) -> Movables:
    """Draw ``trees`` per square metre, ``cars`` on that share of the parking places, poles so many metres apart.

    Of each there are spares: half of the trees and poles, and the other parking places.
    """
    rows = []
    for x, y in rng.uniform(-site.half + 2, site.half - 2, (int(2 * trees * (2 * site.half) ** 2), 2)):
        tree = vegetation.draw_tree(rng, x, y, species)
        if site.claim(x, y, 0.5, 0.5, 0.0, 0.6):
            rows.append(tree)
    parked = furniture.spots(rng, site.layout, _PARKING, site.layout.half_width - 0.6) if cars else np.zeros((0, 4))
    posts = furniture.spots(rng, site.layout, poles / 2, site.layout.half_width + 1.1) if poles else np.zeros((0, 4))
    planted = np.array(rows).reshape(-1, len(vegetation.TREE_COLUMNS))
    return Movables(planted, parked[: int(2 * cars * len(parked))], posts)


def furnished(things: Movables, site: Site, rng: np.random.Generator | None, changed: float) -> Contents:
    """Return the first halves; with ``rng`` a share of them, drawn by it, replaced by as many spare ones."""

    def pick(rows: Floats) -> Floats:
        first, spare = rows[: len(rows) // 2], rows[len(rows) // 2 :]
        if rng is None:
            return first
        count = round(changed * len(first))
        return np.concatenate([first[np.sort(rng.permutation(len(first))[count:])], spare[:count]])

    trees, cars, poles = map(pick, things)
    ground = site.z(trees[:, 0], trees[:, 1])
    solid = [furniture.cars(cars, site), furniture.poles(poles, site), vegetation.trunks(trees, ground)]
    return Contents(solid, [vegetation.crowns(trees, ground)])


NEAR, FAR = 10.0, 40.0  # metres from the border
_SHORTEST = 24.0  # metres, of a stretch that is worth driving to and fro


def beside_border(scene: Scene, seed: int, outside: bool) -> Floats | None:
    """Return a closed way (N, 2) on a street, 10 to 40 m inside or ``outside`` of the border; None without a street."""
    stretches, lengths = list[Floats](), list[float]()
    for line in (*scene.site.layout.streets, scene.route[::4]):
        depth = (scene.size / 2 - np.abs(line).max(axis=1)) * (-1.0 if outside else 1.0)
        fits = (depth >= NEAR) & (depth <= FAR)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], fits, [False]]).astype(np.int8)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            length = float(np.linalg.norm(np.diff(line[begin:end], axis=0), axis=1).sum())
            if end - begin > 3 and length >= _SHORTEST:
                stretches.append(line[begin:end])
                lengths.append(length)
    if not stretches:
        return None
    rng = np.random.default_rng([seed, 220])
    return there_and_back(stretches[int(rng.choice(len(stretches), p=np.divide(lengths, sum(lengths))))])


def lane(scene: Scene, seed: int, across: bool) -> Floats:
    """Return a closed way (N, 2) to and fro in a street along the scene's first one, or in one ``across``."""
    streets = scene.site.layout.streets
    headings = [(line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0]) for line in streets]
    chosen = [k for k, heading in enumerate(headings) if (abs(heading @ headings[0]) < 0.5) == across]
    return there_and_back(streets[int(np.random.default_rng([seed, 221]).choice(chosen))], 0.6)


def rebuilt(scene: Scene, seed: int, share: float) -> Scene:
    """Return the scene with a ``share`` of its buildings others now: ``earlier`` the other way round."""
    other = earlier(replace(scene, mapped=scene.now, now=scene.now), seed, share)
    return replace(scene, now=other.mapped)


def shifted(scene: Scene, shift: Floats) -> Scene:
    """Return the scene with all buildings moved by (2,) metres now; ground, trees, cars and poles stay."""
    solid = scene.now.solid
    vertices = solid.vertices.copy()
    vertices[owners(scene) >= 0, :2] += np.asarray(shift)
    return replace(scene, now=replace(scene.now, solid=solid._replace(vertices=vertices)))
