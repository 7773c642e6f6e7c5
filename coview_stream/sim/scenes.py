"""Seeded scenes in two states: when the map was made, and now.

The scene frame has z up, metres, and its origin at the centre. Trees, cars and poles may change between the states;
ground, buildings and hedges stay, except in :func:`coview_stream.sim.dirt.scene.aged`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.sim import buildings, furniture, vegetation
from coview_stream.sim.kinds import KINDS, Kind, Plot
from coview_stream.sim.layout import Site, directions, resample
from coview_stream.sim.mesh import Mesh, join, placed

# metres
_MARGIN = 50.0  # of the scene beyond the map, seen by a robot near the edge
_FOOTWAY = 1.8  # width
_PARKING = 6.4  # length of a parking place

# one random stream per purpose, so that changes of one leave the others unchanged
_GROUND, _BUILT, _GREEN, _STREET, _SPARE = range(5)


@dataclass(frozen=True)
class Footprint:
    """Footprint of a building, scene frame, metres."""

    x: float  # centre
    y: float  # centre
    w: float  # frontage
    d: float  # depth
    yaw: float  # heading, radians
    ground: float  # height of the ground
    top: float  # height of the ridge

    def holds(self, xy: Floats, margin: float = 0.0) -> Bools:
        """Mask the places (N, 2) inside the footprint or within ``margin`` metres of it."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        across = np.abs((xy - (self.x, self.y)) @ np.array([[c, -s], [s, c]]))
        return np.asarray((across < (self.w / 2 + margin, self.d / 2 + margin)).all(axis=1))


@dataclass(frozen=True)
class SceneState:
    """Scene at one time; solid surfaces stop every ray, foliage lets some rays pass."""

    solid: Mesh
    foliage: Mesh


@dataclass(frozen=True)
class Parts:
    """Parts of a scene at one time."""

    ground: Mesh  # the bare ground
    built: tuple[Mesh, ...]  # buildings, and the hedges, walls and fences between them
    fixed: tuple[Mesh, ...]  # boulders and fallen trunks
    bushes: tuple[Mesh, ...]  # leafy undergrowth
    trees: Floats  # rows of vegetation.TREE_COLUMNS
    cars: Floats  # rows of parked vehicles for furniture.cars
    poles: Floats  # rows of poles for furniture.poles

    def state(self, site: Site) -> SceneState:
        """Join the solid parts, and the leafy parts."""
        below = site.z(self.trees[:, 0], self.trees[:, 1])
        street = [furniture.cars(self.cars, site), furniture.poles(self.poles, site)]
        solid = join([self.ground, *self.built, *self.fixed, *street, vegetation.trunks(self.trees, below)])
        return SceneState(solid, join([*self.bushes, vegetation.crowns(self.trees, below)]))


@dataclass(frozen=True)
class Scene:
    """Scene in both states."""

    kind: str  # one of KINDS
    size: float  # side of the map's square, metres
    mapped: SceneState  # the scene as the aircraft saw it
    now: SceneState  # the scene as the robot sees it
    site: Site  # ground and roads
    route: Floats  # (N, 2) closed loop that robots drive on, metres
    footprints: tuple[Footprint, ...]  # of the buildings
    # parts when the map was made and now; None for a scene not drawn by build_scene
    parts: tuple[Parts, Parts] | None = None
    houses: tuple[int, ...] = ()  # index of each footprint's building in Parts.built
    passage: Footprint | None = None  # hall on the route


@dataclass(frozen=True)
class _Movable:
    """Objects of one kind: ``rows`` when the map was made, and ``spares`` that replace some of them now."""

    rows: Floats
    spares: Floats

    def now(self, rng: np.random.Generator, changed: float) -> Floats:
        """Return the rows, a share of them replaced by spares."""
        count = round(changed * len(self.rows))
        keep = np.sort(rng.permutation(len(self.rows))[count:])
        return np.concatenate([self.rows[keep], self.spares[:count]])


def build_scene(kind: str, seed: int, size: float = 240.0, changed: float = 0.0) -> Scene:
    """Draw a scene of ``size`` metres in which the share ``changed`` of the trees, cars and poles is replaced now.

    Scenes that differ only in ``changed`` have the same map.

    Raises:
        ConfigError: unknown kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"scene: {kind!r} is unknown; use one of {', '.join(KINDS)}")
    spec, half = KINDS[kind], size / 2 + _MARGIN
    rng = [np.random.default_rng([seed, sum(kind.encode()), stream]) for stream in range(5)]
    layout = spec.streets(rng[_GROUND], size, half)
    site = Site(rng[_GROUND], layout, half, relief=spec.relief, roughness=spec.roughness, ditch=spec.ditch)
    passage, hall = _passage(rng[_BUILT], site, spec) if any(spec.passage) else (None, None)
    footprints, houses, built = _buildings(rng[_BUILT], site, spec)
    if hall is not None:
        built.append(hall)
    area, extent = (2 * site.half) ** 2, site.half - 2.0
    rocks = vegetation.rocks(rng[_GREEN], site, int(spec.rocks * area), extent)
    logs = vegetation.logs(rng[_GREEN], site, int(spec.logs * area), extent)
    bushes = vegetation.undergrowth(rng[_GREEN], site, int(spec.undergrowth * area), extent)
    cars, poles = _street_furniture(rng[_STREET], site, spec, passage)
    trees = _trees(rng[_GREEN], rng[_SPARE], site, spec, changed)

    def parts(pick: Callable[[_Movable], Floats]) -> Parts:
        return Parts(site.mesh(), tuple(built), (rocks, logs), (bushes,), pick(trees), pick(cars), pick(poles))

    before = parts(lambda movable: movable.rows)
    after = parts(lambda movable: movable.now(rng[_SPARE], changed)) if changed else before
    mapped = before.state(site)
    now = after.state(site) if changed else mapped
    return Scene(
        kind, size, mapped, now, site, layout.route, tuple(footprints),
        parts=(before, after), houses=tuple(houses), passage=passage,
    )  # fmt: skip


def _passage(rng: np.random.Generator, site: Site, spec: Kind) -> tuple[Footprint, Mesh]:
    """Put a hall over the straightest part of the route, a shorter hall on a small site."""
    route, (w, d) = site.layout.route, spec.passage
    w = min(w, 0.44 * (site.half - _MARGIN))
    heading, step = np.unwrap(directions(route)), float(np.linalg.norm(route[1] - route[0]))
    half = int(0.7 * w / step)
    bends = [float(np.ptp(heading[k - half : k + half])) for k in range(half, len(route) - half)]
    k = half + int(np.argmin(bends))
    x, y, yaw = float(route[k, 0]), float(route[k, 1]), float(heading[k])
    site.occupy(x, y, w, d, yaw)
    mesh, ground = buildings.passage(rng, w, d), site.height(x, y)
    top = ground + float(mesh.vertices[:, 2].max())
    return Footprint(x, y, w, d, yaw, ground, top), placed(mesh, x, y, ground, yaw)


def _buildings(rng: np.random.Generator, site: Site, spec: Kind) -> tuple[list[Footprint], list[int], list[Mesh]]:
    footprints: list[Footprint] = []
    houses: list[int] = []
    meshes: list[Mesh] = []

    def build(plot: Plot, x: float, y: float, yaw: float, w: float, d: float, margin: float) -> bool:
        if not site.claim(x, y, w, d, yaw, margin):
            return False
        local = plot.draw(rng, w, d)
        ground = site.height(x, y)
        houses.append(len(meshes))
        meshes.append(placed(local, x, y, ground, yaw))
        top = ground + float(local.vertices[:, 2].max(initial=0.0))
        footprints.append(Footprint(x, y, w, d, yaw, ground, top))
        return True

    for line in site.layout.streets:
        for side in (-1.0, 1.0):
            _line_street(rng, site, spec, line, side, build, meshes)
    for _ in range(int(spec.infill * (2 * site.half) ** 2)):
        plot, w, d = _draw_plot(rng, spec)
        x, y = rng.uniform(-site.half, site.half, 2)
        build(plot, x, y, rng.uniform(0, 2 * np.pi), w, d, 2.5)
    return footprints, houses, meshes


def _line_street(
    rng: np.random.Generator,
    site: Site,
    spec: Kind,
    line: Floats,
    side: float,
    build: Callable[[Plot, float, float, float, float, float, float], bool],
    meshes: list[Mesh],
) -> None:
    """Fill one side of a street with plots, each a building and perhaps a hedge or fence in front."""
    heading = directions(line)
    kerb = site.layout.half_width + _FOOTWAY
    at = rng.uniform(0.0, 10.0)
    while True:
        plot, w, d = _draw_plot(rng, spec)
        k = int(at + w / 2)
        if k >= len(line):
            return
        setback = rng.uniform(*spec.setback)
        normal = side * np.array([-np.sin(heading[k]), np.cos(heading[k])])
        x, y = line[k] + normal * (kerb + setback + d / 2)
        yaw = heading[k] + (0.0 if side > 0 else np.pi)
        vacant, hedged = rng.random() < spec.vacant, rng.random() < spec.hedges
        if not vacant and build(plot, x, y, yaw, w, d, 0.3) and hedged and setback > 1.5:
            along = np.array([np.cos(heading[k]), np.sin(heading[k])])
            front = line[k] + normal * (kerb + 0.5)
            meshes.append(_enclosure(rng, site, front - along * w / 2, front + along * w / 2))
        at += w + rng.uniform(*spec.gap)


def _enclosure(rng: np.random.Generator, site: Site, start: Floats, end: Floats) -> Mesh:
    """Draw a hedge, wall or fence with a gate; none if it would come too close to a road."""
    line = resample(np.array([start, end]), 2.0)
    if site.road_distance(*line.T).min() < site.layout.half_width + 0.8 or np.abs(line).max() >= site.half:
        return join([])
    gate = int(rng.integers(0, len(line) - 1))
    thickness, height = [(0.7, 1.5), (0.25, 1.1), (0.06, 1.8)][int(rng.integers(3))]
    height *= rng.uniform(0.8, 1.2)
    return join(vegetation.strip(site, part, thickness, height) for part in (line[: gate + 1], line[gate + 1 :]))


def _draw_plot(rng: np.random.Generator, spec: Kind) -> tuple[Plot, float, float]:
    weights = np.array([plot.weight for plot in spec.plots])
    plot = spec.plots[int(rng.choice(len(weights), p=weights / weights.sum()))]
    return plot, rng.uniform(*plot.frontage), rng.uniform(*plot.depth)


def _trees(
    rng: np.random.Generator, spare_rng: np.random.Generator, site: Site, spec: Kind, changed: float
) -> _Movable:
    def plant(rng: np.random.Generator, count: int) -> Floats:
        rows = []
        for x, y in rng.uniform(-site.half + 2, site.half - 2, (count, 2)):
            tree = vegetation.draw_tree(rng, x, y, spec.species)
            if site.claim(x, y, 0.5, 0.5, 0.0, 0.6):
                rows.append(tree)
        return np.array(rows).reshape(-1, len(vegetation.TREE_COLUMNS))

    count = int(spec.trees * (2 * site.half) ** 2)
    return _Movable(plant(rng, count), plant(spare_rng, int(count * changed)))


def _street_furniture(
    rng: np.random.Generator, site: Site, spec: Kind, passage: Footprint | None
) -> tuple[_Movable, _Movable]:
    parked = furniture.spots(rng, site.layout, _PARKING, site.layout.half_width - 0.6)
    spacing = spec.pole_spacing or 40.0
    posts = furniture.spots(rng, site.layout, spacing / 2, site.layout.half_width + 1.1)
    if passage is not None:
        parked, posts = (rows[~passage.holds(rows[:, :2], 3.0)] for rows in (parked, posts))
    taken, used = int(spec.cars * len(parked)), len(posts) // 2 if spec.pole_spacing else 0
    return _Movable(parked[:taken], parked[taken:] if taken else parked[:0]), _Movable(posts[:used], posts[used:])
