"""Route of a node's robots through a site: circles that move with them, inside of which tiles are wanted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from coview_stream.basemap.site.manifest import Around

Place = tuple[float, float]
"""x and y in the frame of the site's sources, metres."""

_STEP = 1.0 / 3.0
"""Of the radius: how far a robot goes before its circle moves; set by hand. Two thirds of it always lie ahead."""


class Whereabouts(NamedTuple):
    """Where a robot is, or may be.

    Attributes:
        place: in the frame of the map's sources.
        known: whether it is there; else it may be anywhere as well.
    """

    place: Place
    known: bool


class Route:
    """A circle for each robot, which moves in steps as the robot does.

    A robot whose place is not known may be where it was seen last, if it was; else at the start, or where it was when a
    node ended; and besides where somebody, or its search, believes that it is.

    Attributes:
        start: the circle to begin with.
    """

    def __init__(self, start: Around, before: Mapping[str, Place] | None = None) -> None:
        """Begin at the start, and at the places where robots were before."""
        self.start = start
        self._before = dict(before or {})
        self._seen: dict[str, Place | None] = dict.fromkeys(self._before)
        self._possible: dict[str, Place] = {}

    def move(self, robots: Mapping[str, Whereabouts | None]) -> bool:
        """Take where the robots are or may be, None where nothing is known; return whether a circle has moved.

        Only robots that are named have a circle from then on.
        """
        moved = False
        self._seen = {robot: self._seen.get(robot) for robot in robots}
        self._possible = {robot: place for robot, place in self._possible.items() if robot in robots}
        for robot, told in robots.items():
            if told is None:
                continue
            nearest = min(self._centres(robot), key=lambda centre: math.dist(centre, told.place))
            far = math.dist(nearest, told.place) > _STEP * self.start.radius
            moved |= far
            if told.known:
                self._seen[robot] = told.place if far else nearest
                self._possible.pop(robot, None)
            elif far:
                self._possible[robot] = told.place
        return moved

    def circles(self) -> list[Around]:
        """Return the circles, each once."""
        centres = [centre for robot in self._seen for centre in self._centres(robot)] or [self._begin]
        return [Around(x, y, self.start.radius) for x, y in dict.fromkeys(centres)]

    def last_places(self) -> dict[str, Place]:
        """Return about where each robot was seen last, for the next start."""
        return self._before | {robot: place for robot, place in self._seen.items() if place is not None}

    @property
    def _begin(self) -> Place:
        return self.start.x, self.start.y

    def _centres(self, robot: str) -> list[Place]:
        seen = self._seen.get(robot)
        found = [seen] if seen is not None else [self._begin]
        if seen is None and robot in self._before:
            found.append(self._before[robot])
        return [*found, self._possible[robot]] if robot in self._possible else found
