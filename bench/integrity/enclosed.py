"""Sites that look alike along a line or from several sides: an avenue, a court, a storey between others.

All sizes are set by hand.
"""

from __future__ import annotations

import numpy as np

from bench.integrity.sites import MARGIN, Contents, layout_of, loop, scene_of, stand, there_and_back, turned
from coview_stream.geometry.arrays import Floats
from coview_stream.sim import buildings, vegetation
from coview_stream.sim.layout import Layout, Site
from coview_stream.sim.mesh import Mesh, box, cylinder, frustum, join, placed
from coview_stream.sim.scenes import Scene
from coview_stream.sim.vegetation import TreeMix

_DRAWN, _NOW, _THEN, _ROUND = range(4)  # random streams
_SHELL = (54.0, 36.0)  # metres, of a storey
_CEILING = 3.0  # metres above its floor


def _rng(kind: str, seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, sum(kind.encode()), stream])


def _flat(layout: Layout, half: float) -> Site:
    return Site(np.random.default_rng(0), layout, half, relief=0.0, roughness=0.0, ditch=0.0)


def avenue(seed: int, size: float, changed: float) -> Scene:
    """Draw a straight street that looks the same all along; nothing changes (``changed``).

    By seed: facades with pilasters and a row of trees on either side, two rows of trees in fields, walls with posts.
    """
    del changed
    rng = _rng("avenue", seed, _DRAWN)
    half, yaw = size / 2 + MARGIN, rng.uniform(0, np.pi)
    line = np.array([[-1.5 * half, 0.0], [1.5 * half, 0.0]])
    site = _flat(layout_of(there_and_back(line * (0.2 * size / (1.5 * half))), [line], half, 3.5, yaw), half)
    step, height, off = rng.uniform(6.0, 11.0), rng.uniform(6.0, 12.0), rng.uniform(10.0, 16.0)
    at = np.arange(-1.4 * half, 1.4 * half, step)
    solid, foliage = [], []
    for side in (1.0, -1.0):
        if seed % 3 != 1:
            deep, high, reach = (8.0, height, off) if seed % 3 == 0 else (0.4, 5.0, 6.0)
            wall = placed(box(2.8 * half, deep, high), 0.0, side * (reach + deep / 2))
            posts = [placed(box(0.7, 0.7, high), x, side * reach) for x in at]
            solid += [placed(join([wall, *posts]), 0.0, 0.0, 0.0, yaw)]
        if seed % 3 != 2:
            xy = turned(np.column_stack([at + step / 2, np.full(len(at), side * 6.5)]), yaw)
            tree = np.array([0.8 * height, 0.2 * height, 0.0, 0.0, 0.0, 3.0])
            trees, ground = np.column_stack([xy, np.tile(tree, (len(xy), 1))]), site.z(*xy.T)
            solid.append(vegetation.trunks(trees, ground))
            foliage.append(vegetation.crowns(trees, ground))
    same = Contents(solid, foliage)
    return scene_of("avenue", size, site, same, same, ())


def court(seed: int, size: float, changed: float) -> Scene:
    """Draw a closed court that looks the same from four sides, and a suburb's houses about it (``changed``: nothing).

    The drive is inside, the same to all four sides, too.
    """
    del changed
    rng = _rng("court", seed, _DRAWN)
    half, yaw, inner, deep = size / 2 + MARGIN, rng.uniform(0, np.pi / 2), rng.uniform(36.0, 56.0), rng.uniform(9, 14)
    side, high = inner / 4, rng.uniform(7.0, 14.0)
    route = loop((-side, side), (-side, side), radius=0.5 * side)
    site = _flat(layout_of(route, [route], half, 2.5, yaw), half)
    wing = [placed(box(inner + 2 * deep, deep, high), 0.0, inner / 2 + deep / 2)]
    wing.append(placed(frustum(inner + 2 * deep, deep, 4.0, inner + 2 * deep, 1.0), 0.0, inner / 2 + deep / 2, high))
    pillars = np.arange(rng.uniform(1.0, 2.5), inner / 2, rng.uniform(3.0, 6.0))
    wing += [placed(box(0.6, 0.8, high), s * x, inner / 2 - 0.2) for x in pillars for s in (1.0, -1.0)]
    wing.append(placed(box(3.0, 1.6, 3.2), rng.uniform(-0.3, 0.3) * inner, inner / 2 - 0.8))  # a porch
    corner = rng.uniform(0.28, 0.36, 2) * inner
    tree = np.array([[*corner, rng.uniform(5, 8), rng.uniform(1.2, 2.0), 0.0, 0.0, 0.0, 5.0]])
    quarters = [yaw + k * np.pi / 2 for k in range(4)]
    solid = [placed(join([*wing, vegetation.trunks(tree, np.zeros(1))]), 0, 0, 0, angle) for angle in quarters]
    foliage = [placed(vegetation.crowns(tree, np.zeros(1)), 0, 0, 0, angle) for angle in quarters]
    solid.append(cylinder(0.12 * inner, 0.7, 24))  # a basin in the middle
    around = rng.uniform(-half, half, (400, 2))
    around = around[np.abs(turned(around, -yaw)).max(axis=1) > inner / 2 + deep + 8.0]
    for x, y in around:
        w, d, turn = rng.uniform(8, 14), rng.uniform(8, 12), rng.uniform(0, np.pi)
        if site.claim(x, y, w, d, turn, 4.0):
            solid.append(stand(buildings.house(rng, w, d), site, np.array([x, y]), turn))
    free = [xy for xy in around[:150] if site.claim(xy[0], xy[1], 1.0, 1.0)]
    trees = np.array([vegetation.draw_tree(rng, xy[0], xy[1], TreeMix((4.0, 10.0))) for xy in free])
    solid.append(vegetation.trunks(trees, np.zeros(len(trees))))
    same = Contents(solid, [*foliage, vegetation.crowns(trees, np.zeros(len(trees)))])
    return scene_of("court", size, site, same, same, ())


def storey(seed: int, size: float, changed: float) -> Scene:
    """Draw two storeys of one building: the same shell, columns and stairs, other partitions.

    The map is of the lower. With ``changed`` the robot is on the upper one; heights are above each one's own floor.
    """
    rng = _rng("storey", seed, _DRAWN)
    half, yaw = size / 2 + MARGIN, rng.uniform(0, np.pi / 2)
    w, d = _SHELL[0] * rng.uniform(0.8, 1.2), _SHELL[1] * rng.uniform(0.8, 1.2)
    shell = [_wall((x0, y0), (x1, y1)) for (x0, y0), (x1, y1) in _sides(w, d)]
    shell.append(placed(box(w, d, 0.2), 0.0, 0.0, _CEILING))
    shell += [placed(box(0.5, 0.5, _CEILING), x, y) for x in _axis(w, 7.5) for y in _axis(d, 7.5)]
    shell += [placed(box(3.0, 6.0, _CEILING), s * (w / 2 - 1.6), rng.uniform(-0.25, 0.25) * d) for s in (1.0, -1.0)]
    floors = []
    for stream in (_THEN, _NOW):
        way = _way(_rng("storey", seed, _ROUND + stream), w, d)
        rooms = _partitions(_rng("storey", seed, stream), w, d, way)
        floors.append((way, Contents([placed(join([*shell, *rooms]), 0.0, 0.0, 0.0, yaw)])))
    (_, lower), (way, here) = floors[0], floors[1 if changed else 0]
    site = _flat(layout_of(way, [way], half, 1.0, yaw), half)
    return scene_of("storey", size, site, lower, here, ())


def _axis(length: float, step: float) -> Floats:
    """Return columns between the walls, half a step off the drive's lanes."""
    count = int((length / 2 - 1.0) / step)
    return np.asarray((np.arange(-count, count) + 0.5) * step)


def _way(rng: np.random.Generator, w: float, d: float) -> Floats:
    """Return the drive round a storey: between the columns."""
    x = 7.5 * float(rng.integers(1, int((w / 2 - 4.0) / 7.5) + 1))
    y = 7.5 * float(rng.integers(1, int((d / 2 - 3.0) / 7.5) + 1))
    return loop((-x, x), (-y, y), 1.5)


def _sides(w: float, d: float) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    at = [(-w / 2, -d / 2), (w / 2, -d / 2), (w / 2, d / 2), (-w / 2, d / 2)]
    return list(zip(at, [*at[1:], at[0]], strict=True))


def _wall(start: tuple[float, float], end: tuple[float, float], thick: float = 0.15) -> Mesh:
    (x0, y0), (x1, y1) = start, end
    turn = float(np.arctan2(y1 - y0, x1 - x0))
    return placed(box(float(np.hypot(x1 - x0, y1 - y0)), thick, _CEILING), (x0 + x1) / 2, (y0 + y1) / 2, 0.0, turn)


def _partitions(rng: np.random.Generator, w: float, d: float, way: Floats) -> list[Mesh]:
    """Divide a storey into rooms of 4 to 9 metres with doors, and leave 1.1 metres on either side of the way free."""
    out: list[Mesh] = []

    def divide(x0: float, x1: float, y0: float, y1: float) -> None:
        long = max(x1 - x0, y1 - y0)
        if long < rng.uniform(6.0, 10.0):
            return
        share = rng.uniform(0.35, 0.65)
        if x1 - x0 >= y1 - y0:
            x = x0 + share * (x1 - x0)
            raise_wall(np.array([x, y0]), np.array([x, y1]))
            divide(x0, x, y0, y1)
            divide(x, x1, y0, y1)
        else:
            y = y0 + share * (y1 - y0)
            raise_wall(np.array([x0, y]), np.array([x1, y]))
            divide(x0, x1, y0, y)
            divide(x0, x1, y, y1)

    def raise_wall(a: Floats, b: Floats) -> None:
        length = float(np.linalg.norm(b - a))
        at = np.arange(0.1, length, 0.2)
        points = a + (b - a) * (at / length)[:, None]
        free = np.linalg.norm(points[:, None] - way[None], axis=2).min(axis=1) > 1.1
        door = rng.uniform(0.5, max(length - 1.5, 0.6))
        free &= np.abs(at - door - 0.5) > 0.5
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8)))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            p, q = (a + (b - a) * (0.2 * k / length) for k in (first, last))
            out.append(_wall((float(p[0]), float(p[1])), (float(q[0]), float(q[1]))))

    divide(-w / 2, w / 2, -d / 2, d / 2)
    return out
