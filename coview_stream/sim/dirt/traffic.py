"""Traffic: people and vehicles that move through the scene, and people who walk along with the robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, yaw_of
from coview_stream.sim.dirt.ranges import within
from coview_stream.sim.furniture import vehicle
from coview_stream.sim.layout import Site, arc_lengths, directions
from coview_stream.sim.mesh import Mesh, cylinder, ellipsoid, join, placed

# set by hand
_SEEN = 70.0  # metres from the robot within which traffic is drawn
_CLEAR = 3.2  # metres: a vehicle that would come nearer to the robot waits elsewhere
_DRIVING, _WALKING = (4.0, 12.0), (0.8, 1.7)  # metres per second
_FOOTWAY = 0.9  # metres beside the carriageway


@dataclass(frozen=True)
class Traffic:
    """Moving people and vehicles, none of which is in the map.

    Attributes:
        vehicles: on 100 metres of street.
        people: on 100 metres of street.
        companions: people who walk with the robot, a few metres behind it or beside.

    Raises:
        ConfigError: a value out of its range.
    """

    vehicles: float = 2.0
    people: float = 4.0
    companions: int = 2

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
    """Somebody who goes along a street, over and over."""

    mesh: Mesh
    line: Floats  # (K, 2) metres, points a metre apart
    start: float  # metres along it
    speed: float  # metres per second; negative against its direction
    beside: float  # metres to the left of the line
    clear: float  # metres from the robot that it keeps

    def at(self, seconds: float) -> Floats:
        """Return x, y and yaw."""
        arc = arc_lengths(self.line)
        s = (self.start + self.speed * seconds) % arc[-1]
        heading = float(np.interp(s, arc, np.unwrap(directions(self.line))))
        x, y = (float(np.interp(s, arc, self.line[:, k])) for k in range(2))
        x, y = x - self.beside * np.sin(heading), y + self.beside * np.cos(heading)
        return np.array([x, y, heading + (0.0 if self.speed > 0 else np.pi)])


class Movers:
    """Everybody who moves in a scene."""

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
        """Return those near the robot at a time, scene frame."""
        here, parts = T_scene_body[:2, 3], []
        for mover in self._movers:
            x, y, yaw = mover.at(seconds).tolist()
            apart = float(np.hypot(x - here[0], y - here[1]))
            if mover.clear < apart < _SEEN:
                parts.append(placed(mover.mesh, x, y, self._site.height(x, y), yaw))
        yaw = yaw_of(T_scene_body)
        c, s = np.cos(yaw), np.sin(yaw)
        for (ahead, left), phase in zip(self._companions.tolist(), self._pace.tolist(), strict=True):
            ahead += 0.3 * np.sin(0.7 * seconds + phase)  # nobody keeps an even distance
            x, y = here[0] + c * ahead - s * left, here[1] + s * ahead + c * left
            parts.append(placed(person(), x, y, self._site.height(x, y), yaw))
        return join(parts)
