"""Sites that look alike in many places: equal things in rows, an avenue, a court. All sizes are set by hand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.integrity.sites import (
    MARGIN,
    Contents,
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
_DRAWN, _NOW, _OTHER = range(3)  # random streams
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
    things = movables(rng, site, 0.002, _GARDEN, 0.4, 28.0)
    before = furnished(things, site, None, 0.0)
    after = furnished(things, site, _rng("terraces", seed, _NOW), changed)
    mapped, now = (Contents([*houses, *each.solid], each.foliage) for each in (before, after))
    return scene_of("terraces", size, site, mapped, now)


def rows(seed: int, size: float, changed: float) -> Scene:
    """Draw equal houses with gardens in parallel streets; one beside the drive is another house now.

    ``changed`` of the cars, trees and poles are others now.
    """
    rng = _rng("rows", seed, _DRAWN)
    spacing, width, depth = rng.uniform(40.0, 48.0), rng.uniform(9.0, 12.0), rng.uniform(8.0, 10.0)
    site, yaw = _streets(rng, size, spacing, rng.uniform(70.0, 84.0), 3.4, rng.uniform(0.1, 0.6))
    usual, other = buildings.house(rng, width, depth), buildings.house(rng, width, depth)
    spots = _row_spots(site, yaw, (width, depth), width + rng.uniform(4.0, 7.0), spacing, 3.0)
    far = np.array([np.linalg.norm(site.layout.route - spot.xy, axis=1).min() for spot in spots])
    odd = int(rng.choice(np.flatnonzero(far < 20.0)))
    houses = [stand(usual, site, *spot) for spot in spots]
    houses_now = [*houses[:odd], stand(other, site, *spots[odd]), *houses[odd + 1 :]]
    things = movables(rng, site, 0.003, _GARDEN, 0.3, 32.0)
    before = furnished(things, site, None, 0.0)
    after = furnished(things, site, _rng("rows", seed, _NOW), changed)
    mapped = Contents([*houses, *before.solid], before.foliage)
    now = Contents([*houses_now, *after.solid], after.foliage)
    return scene_of("rows", size, site, mapped, now)


def plantation(seed: int, size: float, changed: float) -> Scene:
    """Draw equal silos on a grid beside a few tracks, some missing; ``changed``: the grid has another offset now."""
    rng = _rng("plantation", seed, _DRAWN)
    site, yaw = _streets(rng, size, rng.uniform(58.0, 70.0), rng.uniform(58.0, 70.0), 2.4, rng.uniform(0.2, 1.2))
    pitch = rng.uniform((7.0, 7.0), (10.0, 10.0))
    silo, missing = cylinder(1.6, rng.uniform(4.0, 7.0), 12, top=1.2), rng.uniform(0.05, 0.3)

    def stock(draw: np.random.Generator) -> Contents:
        count = int(1.5 * site.half / pitch.min())
        grid = np.stack(np.meshgrid(*2 * [np.arange(-count, count)]), axis=-1).reshape(-1, 2) * pitch
        xy = turned(grid + draw.uniform(0, 1, 2) * pitch, yaw)
        xy = xy[(np.abs(xy) < site.half - 2).all(axis=1)]
        xy = xy[(site.road_distance(*xy.T) > site.layout.half_width + 1.8) & (draw.random(len(xy)) > missing)]
        return Contents([stand(silo, site, each, 0.0) for each in xy])

    mapped = stock(_rng("plantation", seed, _NOW))
    now = stock(_rng("plantation", seed, _OTHER)) if changed else mapped
    return scene_of("plantation", size, site, mapped, now)


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
    return scene_of("yard", size, site, mapped, now)


def boxes(seed: int, size: float, changed: float) -> Scene:
    """Draw 24 x 40 equal boxes, 16 and 7 metres apart, and one mast 250 m away; nothing changes (``changed``).

    The streets are the lanes along the boxes, then those across; the drive is in one of the first.
    """
    del changed
    rng = _rng("boxes", seed, _DRAWN)
    half, yaw = size / 2 + MARGIN, rng.uniform(0, 0.2)
    xs, ys = ((np.arange(n) - (n - 1) / 2) * step for n, step in ((24, 16.0), (40, 7.0)))
    ends = (xs[-1] + 8.0, ys[-1] + 3.5)
    along = [np.array([[-ends[0], y], [ends[0], y]]) for y in ys[:-1] + 3.5]
    across = [np.array([[x, -ends[1]], [x, ends[1]]]) for x in xs[:-1] + 8.0]
    route = there_and_back(along[int(rng.integers(len(along)))], 0.6)
    site = Site(rng, layout_of(route, [*along, *across], half, 1.0, yaw), half, relief=0.1, roughness=0.01, ditch=0.0)
    grid = turned(np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2), yaw)
    angle = rng.uniform(0, 2 * np.pi)
    mast = stand(box(0.5, 0.5, 25.0), site, 250.0 * np.array([np.cos(angle), np.sin(angle)]), 0.0)
    stacked = Contents([mast, *(stand(box(*_BOX), site, xy, yaw) for xy in grid)])
    return scene_of("boxes", size, site, stacked, stacked)


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
    return scene_of("avenue", size, site, same, same)


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
    return scene_of("court", size, site, same, same)
