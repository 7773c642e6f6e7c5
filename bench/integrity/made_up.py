"""Sites that look alike in many places: equal things in rows, an avenue, a court, a storey between others.

All sizes are set by hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.integrity.sites import (
    MARGIN,
    Contents,
    footprint,
    furnished,
    layout_of,
    loop,
    movables,
    scene_of,
    stand,
    there_and_back,
    turned,
)
from coview_stream.geometry.arrays import Floats
from coview_stream.sim import buildings, vegetation
from coview_stream.sim.layout import Layout, Site
from coview_stream.sim.mesh import Mesh, box, cylinder, frustum, join, placed
from coview_stream.sim.scenes import Scene
from coview_stream.sim.vegetation import TreeMix

_GARDEN = TreeMix((3.0, 9.0))
_DRAWN, _NOW, _OTHER, _ROUND = range(4)  # random streams
_BOX = (12.2, 2.44, 2.6)  # metres, a container of forty feet


class _Spot(NamedTuple):
    """Place of one thing in a row: position and heading."""

    xy: Floats
    yaw: float


def _rng(kind: str, seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, sum(kind.encode()), stream])


def _streets(
    rng: np.random.Generator, size: float, spacing: float, across: float, half_width: float, relief: float
) -> tuple[Site, float]:
    """Return parallel streets ``spacing`` apart, cross streets ``across`` apart, and a drive round a block or two."""
    half, yaw = size / 2 + MARGIN, rng.uniform(0, np.pi / 2)
    reach = 1.5 * half
    rows, columns = _multiples(spacing, reach), _multiples(across, reach) + 0.5 * across
    lines = [np.array([[-reach, y], [reach, y]]) for y in rows] + [np.array([[x, -reach], [x, reach]]) for x in columns]
    inner = columns[np.abs(columns) <= 0.34 * size]
    first = int(rng.integers(-1, 1))
    route = loop((inner.min(), inner.max()), (first * spacing, (first + 1) * spacing))
    site = Site(rng, layout_of(route, lines, half, half_width, yaw), half, relief=relief, roughness=0.02, ditch=0.0)
    return site, yaw


def _multiples(step: float, reach: float) -> Floats:
    count = int(np.ceil(reach / step))
    return np.asarray(np.arange(-count, count + 1) * step)


def _row_spots(
    site: Site, yaw: float, size: tuple[float, float], pitch: float, spacing: float, setback: float
) -> list[_Spot]:
    """Return where houses of ``size`` stand on both sides of every street, those on a road left out."""
    out, reach = [], 1.5 * site.half
    off = site.layout.half_width + 1.8 + setback + size[1] / 2
    for y in _multiples(spacing, reach):
        for x in _multiples(pitch, reach):
            for side in (1.0, -1.0):
                spot = _Spot(turned(np.array([[x, y + side * off]]), yaw)[0], yaw + (0.0 if side > 0 else np.pi))
                # neighbours touch: a little less is claimed than what is built
                if np.abs(spot.xy).max() < site.half and site.claim(
                    spot.xy[0], spot.xy[1], size[0] - 1.4, size[1], spot.yaw
                ):
                    out.append(spot)
    return out


def terraces(seed: int, size: float, changed: float) -> Scene:
    """Draw identical terraced houses in parallel streets; ``changed`` of the cars, trees and poles are others now."""
    rng = _rng("terraces", seed, _DRAWN)
    spacing, width, depth = rng.uniform(34.0, 42.0), rng.uniform(6.0, 8.0), rng.uniform(8.0, 10.0)
    site, yaw = _streets(rng, size, spacing, float(np.ceil(52.0 / width) * width + 14.0), 3.6, rng.uniform(0.1, 0.6))
    mesh = buildings.house(rng, width, depth)
    spots = _row_spots(site, yaw, (width, depth), width, spacing, 1.5)
    houses = [stand(mesh, site, *spot) for spot in spots]
    plots = [footprint(mesh, site, spot.xy, (width, depth), spot.yaw) for spot in spots]
    things = movables(rng, site, 0.002, _GARDEN, 0.4, 28.0)
    before = furnished(things, site, None, 0.0)
    after = furnished(things, site, _rng("terraces", seed, _NOW), changed)
    mapped, now = (Contents([*houses, *each.solid], each.foliage) for each in (before, after))
    return scene_of("terraces", size, site, mapped, now, plots)


def rows(seed: int, size: float, changed: float) -> Scene:
    """Draw equal houses with gardens in parallel streets, of which one beside the drive is another house now.

    For even seeds the survey knows that house elsewhere, between the same neighbours. ``changed`` of the cars, trees
    and poles are others now.
    """
    rng = _rng("rows", seed, _DRAWN)
    spacing, width, depth = rng.uniform(40.0, 48.0), rng.uniform(9.0, 12.0), rng.uniform(8.0, 10.0)
    site, yaw = _streets(rng, size, spacing, rng.uniform(70.0, 84.0), 3.4, rng.uniform(0.1, 0.6))
    usual, other = buildings.house(rng, width, depth), buildings.house(rng, width, depth)
    spots = _row_spots(site, yaw, (width, depth), width + rng.uniform(4.0, 7.0), spacing, 3.0)
    far = np.array([np.linalg.norm(site.layout.route - spot.xy, axis=1).min() for spot in spots])
    here, there = int(rng.choice(np.flatnonzero(far < 20.0))), int(rng.choice(np.flatnonzero(far > 30.0)))
    known = there if seed % 2 == 0 else None

    def houses(odd: int | None) -> list[Mesh]:
        return [stand(other if k == odd else usual, site, *spot) for k, spot in enumerate(spots)]

    things = movables(rng, site, 0.003, _GARDEN, 0.3, 32.0)
    before = furnished(things, site, None, 0.0)
    after = furnished(things, site, _rng("rows", seed, _NOW), changed)
    mapped = Contents([*houses(known), *before.solid], before.foliage)
    now = Contents([*houses(here), *after.solid], after.foliage)
    plots = [footprint(usual, site, spot.xy, (width, depth), spot.yaw) for spot in spots]
    return scene_of("rows", size, site, mapped, now, plots)


def plantation(seed: int, size: float, changed: float) -> Scene:
    """Draw equal objects on a grid beside a few tracks: trees or, for odd seeds, silos; some are missing.

    With ``changed`` they stand on a grid of another offset now, and others are missing.
    """
    rng = _rng("plantation", seed, _DRAWN)
    site, yaw = _streets(rng, size, rng.uniform(58.0, 70.0), rng.uniform(58.0, 70.0), 2.4, rng.uniform(0.2, 1.2))
    pitch = rng.uniform((4.0, 5.0), (7.0, 8.0)) if seed % 2 == 0 else rng.uniform((7.0, 7.0), (10.0, 10.0))
    height, radius, missing = rng.uniform(4.0, 7.0), rng.uniform(0.18, 0.28), rng.uniform(0.05, 0.3)
    silo = cylinder(1.6, height, 12, top=1.2)

    def stock(draw: np.random.Generator) -> Contents:
        count = int(1.5 * site.half / pitch.min())
        grid = np.stack(np.meshgrid(*2 * [np.arange(-count, count)]), axis=-1).reshape(-1, 2) * pitch
        xy = turned(grid + draw.uniform(0, 1, 2) * pitch, yaw)
        xy = xy[(np.abs(xy) < site.half - 2).all(axis=1)]
        xy = xy[(site.road_distance(*xy.T) > site.layout.half_width + 1.8) & (draw.random(len(xy)) > missing)]
        if seed % 2:
            return Contents([stand(silo, site, each, 0.0) for each in xy])
        tree = np.array([height, radius * height, 0.0, 0.0, 0.0, 7.0])
        trees, ground = np.column_stack([xy, np.tile(tree, (len(xy), 1))]), site.z(*xy.T)
        return Contents([vegetation.trunks(trees, ground)], [vegetation.crowns(trees, ground)])

    mapped = stock(_rng("plantation", seed, _NOW))
    now = stock(_rng("plantation", seed, _OTHER)) if changed else mapped
    return scene_of("plantation", size, site, mapped, now, ())


def yard(seed: int, size: float, changed: float) -> Scene:
    """Draw a container yard: stacks of one to four in blocks of five rows, masts; with ``changed`` all others now."""
    rng = _rng("yard", seed, _DRAWN)
    spacing, across = 7 * 2.9, rng.choice([4, 5]) * 13.5 + 6.0
    site, yaw = _streets(rng, size, spacing, across, 2.6, rng.uniform(0.05, 0.3))
    spots, masts = list[Floats](), list[Mesh]()
    for x, y in rng.uniform(-size / 2, size / 2, (40, 2)):
        if len(masts) < 12 and site.claim(x, y, 0.6, 0.6, 0.0, 0.3):
            masts.append(stand(box(0.4, 0.4, 20.0), site, np.array([x, y]), yaw))
    for y in _multiples(2.9, 1.5 * site.half) + 1.45:
        for x in _multiples(13.5, 1.5 * site.half):
            at = turned(np.array([[x, y]]), yaw)[0]
            if np.abs(at).max() < site.half and site.claim(at[0], at[1], _BOX[0], 1.4, yaw):
                spots.append(at)

    def cargo(draw: np.random.Generator) -> list[Mesh]:
        high = draw.choice(5, len(spots), p=(0.25, 0.25, 0.2, 0.2, 0.1))
        stacks = [box(_BOX[0], _BOX[1], _BOX[2] * max(n, 1)) for n in range(5)]
        return [stand(stacks[n], site, xy, yaw) for n, xy in zip(high, spots, strict=True) if n]

    mapped = Contents([*masts, *cargo(_rng("yard", seed, _NOW))])
    now = Contents([*masts, *cargo(_rng("yard", seed, _OTHER))]) if changed else mapped
    return scene_of("yard", size, site, mapped, now, ())


def boxes(seed: int, size: float, changed: float) -> Scene:
    """Draw 24 x 40 equal boxes, 16 and 7 metres apart, and one mast 250 m away; nothing changes (``changed``).

    Its streets are the lanes along the boxes, then those across; the route is one of either for every other seed.
    """
    del changed
    rng = _rng("boxes", seed, _DRAWN)
    half, yaw = size / 2 + MARGIN, rng.uniform(0, 0.2)
    xs, ys = ((np.arange(n) - (n - 1) / 2) * step for n, step in ((24, 16.0), (40, 7.0)))
    ends = (xs[-1] + 8.0, ys[-1] + 3.5)
    along = [np.array([[-ends[0], y], [ends[0], y]]) for y in ys[:-1] + 3.5]
    across = [np.array([[x, -ends[1]], [x, ends[1]]]) for x in xs[:-1] + 8.0]
    lanes = along if seed % 2 else across
    route = there_and_back(lanes[int(rng.integers(len(lanes)))], 0.6)
    site = Site(rng, layout_of(route, [*along, *across], half, 1.0, yaw), half, relief=0.1, roughness=0.01, ditch=0.0)
    grid = turned(np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2), yaw)
    angle = rng.uniform(0, 2 * np.pi)
    mast = stand(box(0.5, 0.5, 25.0), site, 250.0 * np.array([np.cos(angle), np.sin(angle)]), 0.0)
    stacked = Contents([mast, *(stand(box(*_BOX), site, xy, yaw) for xy in grid)])
    return scene_of("boxes", size, site, stacked, stacked, ())


_SHELL = (54.0, 36.0)  # metres, of a storey
_CEILING = 3.0  # metres above its floor


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
    for stream in (_OTHER, _NOW):
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
