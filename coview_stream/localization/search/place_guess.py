"""Guess of where a robot is, by somebody who may be wrong: more places for the search to try, none of them trusted.

Only a circle that goes with it is: nothing outside of that is searched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from coview_stream.basemap.stations import StationGrid
from coview_stream.config.checks import require
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Circle, Pose, pose_from, rot_z, transform, yaw_of
from coview_stream.geometry.validation import MAX_COORDINATE
from coview_stream.localization.search.consensus import Hypothesis

# set by hand: scoring a hypothesis moves it by up to three metres and seven degrees
_SPACING = 3.0  # metres
_TURN = np.radians(13.0)
_MAX_POSES = 400

MAX_DISTANCE = 20.0
"""Metres around a guess that are tried at most."""

MIN_WITHIN = 50.0
"""Metres of a circle that is searched alone, at least: evidence is judged by what the other places in it look like.

Set by hand, the radius of a virtual scan; no robot came to a pose in one that it was not in (``python -m bench city``).
"""


@dataclass(frozen=True)
class PlaceGuess:
    """Place where a robot is said to be.

    Attributes:
        x, y: in the frame of the map's sources, metres.
        yaw: heading of the body's x axis, radians, counter-clockwise from the map's x axis; None: any.
        distance: metres around it that are tried as well, up to :data:`MAX_DISTANCE`.
        angle: radians to either side of ``yaw`` that are tried as well.
        map: name of the one of several maps in whose frame it is; None of one map.
        within: metres around it outside of which nothing is searched; None: all of the map is. Unlike the rest this
            is trusted: of a robot that is elsewhere no place is found.
        begin, end: of x, beyond which ``within`` does not reach: where one of several maps ends.
    """

    x: float
    y: float
    yaw: float | None = None
    distance: float = 5.0
    angle: float = float(np.radians(30.0))
    map: str | None = None
    within: float | None = None
    begin: float = -math.inf
    end: float = math.inf

    def __post_init__(self) -> None:
        numbers = (self.x, self.y, 0.0 if self.yaw is None else self.yaw)
        plain = all(isinstance(each, float | int) and not isinstance(each, bool) for each in numbers)
        require(plain and bool(np.isfinite(numbers).all()), self, "x", "x, y and yaw as finite numbers")
        require(max(abs(self.x), abs(self.y)) < MAX_COORDINATE, self, "x", "map coordinates in metres")
        require(0.0 < self.distance <= MAX_DISTANCE, self, "distance", f"above 0, at most {MAX_DISTANCE:g} m")
        require(0.0 <= self.angle <= np.pi, self, "angle", "0 to pi radians")
        if self.within is not None:
            plain = isinstance(self.within, float | int) and not isinstance(self.within, bool)
            require(plain and MIN_WITHIN <= self.within < MAX_COORDINATE, self, "within", f"{MIN_WITHIN:g} m or more")

    def poses(self) -> Floats:
        """Return (K, 3) x, y and yaw to be tried, the nearest to the guess first."""
        steps = np.arange(-np.ceil(self.distance / _SPACING), np.ceil(self.distance / _SPACING) + 1) * _SPACING
        xy = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        far = np.linalg.norm(xy, axis=1)
        xy, far = xy[far <= self.distance], far[far <= self.distance]
        reach = np.pi if self.yaw is None else self.angle
        count = int(np.ceil(reach / _TURN))
        turns = np.arange(-count, count + 1) * (reach / max(count, 1))
        if reach == np.pi:
            turns = turns[1:]  # both ends are one
        poses = np.array([(x, y, turn) for x, y in xy for turn in turns])
        unlikely = np.repeat(far / self.distance, len(turns)) + np.tile(np.abs(turns) / max(reach, 1e-9), len(xy))
        poses = poses[np.argsort(unlikely, kind="stable")][:_MAX_POSES]
        return np.asarray(np.add(poses, (self.x, self.y, self.yaw or 0.0)))

    def area(self, origin: Floats) -> Circle | None:
        """Return the circle, about the map's ``origin`` (3,), outside of which nothing is searched; None for none."""
        if self.within is None:
            return None
        x, y = float(origin[0]), float(origin[1])
        return Circle(self.x - x, self.y - y, self.within, self.begin - x, self.end - x)

    def transforms(self, origin: Floats, T_odom_body: Pose) -> tuple[Pose, ...]:
        """Return them as ``T_map_odom`` (4, 4), level, about the map's ``origin`` (3,), heights left open (0).

        Args:
            origin: (3,) of the map.
            T_odom_body: (4, 4) of the frame at which the robot is there.
        """
        out = []
        for x, y, yaw in self.poses():
            turn = rot_z(yaw - yaw_of(T_odom_body))
            at = np.array([x - origin[0], y - origin[1], 0.0])
            out.append(pose_from(turn, at - turn @ T_odom_body[:3, 3]))
        return tuple(out)


def on_the_ground(guesses: list[Hypothesis], ground: Floats, grid: StationGrid) -> list[Hypothesis]:
    """Put guesses on the map's ground, on each of its levels; those beside the map are left out.

    Args:
        guesses: of ``T_map_odom``, whose height is open.
        ground: (3,) the ground below the robot, odometry frame, metres.
        grid: of the map's stations.
    """
    out = []
    for guess in guesses:
        T = guess.T_map_odom
        there = transform(T, ground[None])
        for station in grid.levels_at(there)[:, 0]:
            if station >= 0:
                lift = grid.stations[station, 2] - there[0, 2]
                out.append(Hypothesis(pose_from(T[:3, :3], T[:3, 3] + (0.0, 0.0, lift)), None, None, 0.0))
    return out


def has_ground(guess: PlaceGuess, origin: Floats, grid: StationGrid) -> bool:
    """Tell whether the map has ground anywhere near a guess, or within its circle if it has one."""
    area = guess.area(origin)
    if area is not None:
        return bool(area.holds(grid.stations).any())
    poses = guess.poses()
    return bool((grid.levels_at(poses[:, :2] - origin[:2]) >= 0).any())
