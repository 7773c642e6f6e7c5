"""Dirt of the scene: snow and grass, years and seasons since the survey, and traffic."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_stream.config.checks import within
from coview_stream.geometry.arrays import Bools, Floats, Indices
from coview_stream.geometry.transforms import Pose, yaw_of
from coview_stream.sim.furniture import vehicle
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.layout import Site, arc_lengths, directions
from coview_stream.sim.mesh import EMPTY, Mesh, cylinder, ellipsoid, join, placed
from coview_stream.sim.scenes import Parts, Scene

_VERGE = 1.0  # metres beside the carriageway without grass
_STEEPEST = 0.05  # least cosine of the incidence: bounds the path of flat rays through the cover
_WAVES = ((23.0, 0.6), (9.0, 0.4))  # metres and share: drifts and tussocks


@dataclass(frozen=True)
class Snow:
    """Snow on the ground after the survey; the robot's wheels sink through it."""

    depth: float = 0.25  # metres, off the roads
    on_roads: float = 0.5  # share of the depth that lies on the carriageway
    drifts: float = 0.1  # share by which the depth varies

    def __post_init__(self) -> None:
        within(self, depth=(0.0, 1.0), on_roads=(0.0, 1.0), drifts=(0.0, 1.0))


@dataclass(frozen=True)
class Grass:
    """Tall grass off the roads after the survey; beams enter it and end somewhere inside."""

    height: float = 0.35  # of the tallest, metres
    reach: float = 0.3  # mean path of a beam through it, metres
    tussocks: float = 0.5  # share by which the height varies

    def __post_init__(self) -> None:
        within(self, height=(0.0, 2.0), reach=(0.01, 10.0), tussocks=(0.0, 1.0))


class Cover:
    """Snow and grass on the ground of a scene; where both are, the deeper one counts."""

    def __init__(self, site: Site, snow: Snow | None, grass: Grass | None, rng: np.random.Generator) -> None:
        self._site, self._snow, self._grass = site, snow, grass
        self._phases = rng.uniform(0, 2 * np.pi, (2, len(_WAVES), 2))

    def depth(self, x: Floats, y: Floats) -> Floats:
        """Return the depth (N,) of the cover at coordinates (N,), metres."""
        return np.asarray(np.maximum(self._snow_depth(x, y), self._grass_height(x, y)))

    def _snow_depth(self, x: Floats, y: Floats) -> Floats:
        if self._snow is None:
            return np.zeros(len(x))
        road = self._site.road_distance(x, y) < self._site.layout.half_width
        drift = 1.0 + self._snow.drifts * self._wave(x, y, 0)
        return np.asarray(self._snow.depth * np.where(road, self._snow.on_roads, 1.0) * drift)

    def _grass_height(self, x: Floats, y: Floats) -> Floats:
        if self._grass is None:
            return np.zeros(len(x))
        off = self._site.road_distance(x, y) > self._site.layout.half_width + _VERGE
        return np.asarray(self._grass.height * off * (1.0 - self._grass.tussocks * (0.5 + 0.5 * self._wave(x, y, 1))))

    def _wave(self, x: Floats, y: Floats, which: int) -> Floats:
        """Return a smooth value in [-1, 1] at (N,) coordinates."""
        total = np.zeros(len(x))
        for (wavelength, share), (along, across) in zip(_WAVES, self._phases[which], strict=True):
            k = 2 * np.pi / wavelength
            total += share * np.sin(k * x + along) * np.sin(k * y + across)
        return total

    def sink(self, x: Floats, y: Floats, incidence: Floats, rng: np.random.Generator) -> Floats:
        """Return the metres (N,) that beams travel below the cover's surface at coordinates (N,).

        Snow stops a beam at once; in grass it travels ``reach`` metres on average, at most to the ground.
        ``incidence`` is the cosine of the angle of incidence.
        """
        if self._grass is None:
            return np.zeros(len(x))
        grass = self._grass_height(x, y)
        through = (grass - self._snow_depth(x, y)) / np.maximum(incidence, _STEEPEST)
        ends: Bools = grass > 0.0
        return np.where(ends, np.clip(rng.exponential(self._grass.reach, len(x)), 0.0, np.maximum(through, 0.0)), 0.0)


_GONE, _NEW, _REBUILT = 0.01, 0.01, 0.005  # share of the buildings per year
_FELLED = 0.015  # share of the trees per year; the same number is planted
_GROWTH = 0.12  # metres per year
_SMALLEST = 0.6  # least height of a tree at the survey, as a share of its present height


@dataclass(frozen=True)
class Years:
    """Years between the survey and the run.

    Buildings were demolished, built and replaced, at least one each; trees were felled, planted and have grown; other
    cars are parked.
    """

    years: float = 10.0  # between survey and run

    def __post_init__(self) -> None:
        within(self, years=(0.0, 60.0))


@dataclass(frozen=True)
class Seasons:
    """Seasons: the survey saw bare trees and bushes, the robot sees leaves. Conifers do not change."""

    bare: float = 0.88  # probability that a pulse passes one surface of a bare crown

    def __post_init__(self) -> None:
        within(self, bare=(0.0, 1.0))


@dataclass(frozen=True)
class Fate:
    """Fate of the buildings, as indices of ``Scene.footprints``: in the survey only, at the drive only, replaced."""

    gone: Indices
    new: Indices
    rebuilt: Indices


def aged(scene: Scene, change: Years, rng: np.random.Generator) -> tuple[Scene, Fate]:
    """Return a scene that was mapped ``change.years`` ago, and the fate of its buildings; needs ``Scene.parts``."""
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
    plots = KINDS[scene.kind].plots
    for house in rebuilt:
        plot = scene.footprints[house]
        drawn = plots[int(rng.integers(len(plots)))].draw(rng, plot.w, plot.d)
        now[scene.houses[house]] = placed(drawn, plot.x, plot.y, plot.ground, plot.yaw)
    # trees were smaller at the survey, and vehicles alternate between then and now, as none stays for years
    younger = _kept(before.trees, change, rng)
    younger[:, 2:4] *= np.maximum(1.0 - _GROWTH * change.years / younger[:, 2], _SMALLEST)[:, None]
    old = replace(before, built=tuple(mapped), trees=younger, cars=before.cars[0::2])
    present = replace(after, built=tuple(now), trees=_kept(after.trees, change, rng), cars=after.cars[1::2])
    later = replace(scene, parts=(old, present), mapped=old.state(scene.site), now=present.state(scene.site))
    return later, Fate(gone, new, rebuilt)


def drawn_parts(scene: Scene) -> tuple[Parts, Parts]:
    """Return the parts of a scene at the survey and now."""
    assert scene.parts is not None, "the scene was not drawn by build_scene"
    return scene.parts


def _kept(trees: Floats, change: Years, rng: np.random.Generator) -> Floats:
    return np.asarray(trees[rng.random(len(trees)) < (1.0 - _FELLED) ** change.years])


_SEEN = 70.0  # metres from the robot within which traffic is drawn
_CLEAR = 3.2  # metres: a vehicle that would come nearer to the robot is left out
_DRIVING, _WALKING = (4.0, 12.0), (0.8, 1.7)  # metres per second
_FOOTWAY = 0.9  # metres beside the carriageway


@dataclass(frozen=True)
class Traffic:
    """Moving people and vehicles, none of which is in the map."""

    vehicles: float = 2.0  # per 100 metres of street
    people: float = 4.0  # per 100 metres of street
    companions: int = 2  # people who walk with the robot, within a few metres

    def __post_init__(self) -> None:
        within(self, vehicles=(0.0, 50.0), people=(0.0, 200.0), companions=(0, 50))


def person() -> Mesh:
    """Return a standing person, 1.75 m tall, at the origin."""
    head = ellipsoid(4, 8)
    legs = [placed(cylinder(0.08, 0.85, 6), 0.0, side) for side in (-0.1, 0.1)]
    trunk = placed(cylinder(0.2, 0.65, 8, top=0.24), 0.0, 0.0, 0.82)
    return join([*legs, trunk, placed(Mesh(head.vertices * (0.1, 0.09, 0.14), head.triangles), 0.0, 0.0, 1.61)])


@dataclass(frozen=True)
class _Mover:
    """A person or vehicle that moves along a street again and again."""

    mesh: Mesh
    line: Floats  # (K, 2) metres, points a metre apart
    start: float  # metres along the line
    speed: float  # metres per second; negative against the line's direction
    left: float  # metres to the left of the line
    clear: float  # least distance to the robot, metres

    def at(self, seconds: float) -> Floats:
        """Return x, y and yaw."""
        arc = arc_lengths(self.line)
        s = (self.start + self.speed * seconds) % arc[-1]
        heading = float(np.interp(s, arc, np.unwrap(directions(self.line))))
        x, y = (float(np.interp(s, arc, self.line[:, k])) for k in range(2))
        x, y = x - self.left * np.sin(heading), y + self.left * np.cos(heading)
        return np.array([x, y, heading + (0.0 if self.speed > 0 else np.pi)])


class Movers:
    """People and vehicles that move in a scene."""

    def __init__(self, site: Site, traffic: Traffic, rng: np.random.Generator) -> None:
        self._site = site
        self._movers: list[_Mover] = []
        for line in site.layout.streets:
            length = float(arc_lengths(line)[-1])
            for _ in range(int(rng.poisson(traffic.vehicles * length / 100.0))):
                way = rng.choice([-1.0, 1.0])
                lane = -way * max(0.5 * site.layout.half_width, 1.3)  # on the right
                driving = way * rng.uniform(*_DRIVING)
                self._movers.append(_Mover(vehicle(rng.random()), line, rng.uniform(0, length), driving, lane, _CLEAR))
            for _ in range(int(rng.poisson(traffic.people * length / 100.0))):
                way, side = rng.choice([-1.0, 1.0], 2)
                footway = side * (site.layout.half_width + _FOOTWAY)
                walking = way * rng.uniform(*_WALKING)
                self._movers.append(_Mover(person(), line, rng.uniform(0, length), walking, footway, 0.8))
        angle = rng.uniform(0.6 * np.pi, 1.4 * np.pi, traffic.companions)
        distance = rng.uniform(1.5, 3.5, traffic.companions)
        self._companions = np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])
        self._pace = rng.uniform(0, 2 * np.pi, traffic.companions)

    def around(self, T_scene_body: Pose, seconds: float) -> Mesh:
        """Return the people and vehicles near the robot at a time, scene frame."""
        here, parts = T_scene_body[:2, 3], []
        for mover in self._movers:
            x, y, yaw = mover.at(seconds).tolist()
            apart = float(np.hypot(x - here[0], y - here[1]))
            if mover.clear < apart < _SEEN:
                parts.append(placed(mover.mesh, x, y, self._site.height(x, y), yaw))
        yaw = yaw_of(T_scene_body)
        c, s = np.cos(yaw), np.sin(yaw)
        for (ahead, left), phase in zip(self._companions.tolist(), self._pace.tolist(), strict=True):
            ahead += 0.3 * np.sin(0.7 * seconds + phase)  # people do not keep an even distance
            x, y = here[0] + c * ahead - s * left, here[1] + s * ahead + c * left
            parts.append(placed(person(), x, y, self._site.height(x, y), yaw))
        return join(parts)
