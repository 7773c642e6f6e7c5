"""Route of a node's robots through a site: circles that move with them, inside of which tiles are wanted."""

from __future__ import annotations

import math
from collections.abc import Mapping

from coview_stream.basemap.site.part import Around

Place = tuple[float, float]
"""x and y in the frame of the site's sources, metres."""

_STEP = 1.0 / 3.0
"""Of the radius: how far a robot goes before its circle moves; set by hand. Two thirds of it always lie ahead."""


class Route:
    """A circle for each robot, which moves in steps as the robot does.

    A robot that has not been seen yet may be at the start, or where it was when a node ended.

    Attributes:
        start: the circle to begin with.
    """

    def __init__(self, start: Around, before: Mapping[str, Place] | None = None) -> None:
        """Begin at the start, and at the places where robots were before."""
        self.start = start
        self._before = dict(before or {})
        self._seen: dict[str, Place | None] = dict.fromkeys(self._before)

    def move(self, places: Mapping[str, Place | None]) -> bool:
        """Take where the robots are or may be, None where that is not known; return whether a circle has moved.

        Only robots that are named have a circle from then on.
        """
        moved = False
        seen = {robot: self._seen.get(robot) for robot in places}
        for robot, place in places.items():
            if place is not None:
                nearest = min(self._centres(robot), key=lambda centre: math.dist(centre, place))
                far = math.dist(nearest, place) > _STEP * self.start.radius
                moved |= far
                seen[robot] = place if far else nearest
        self._seen = seen
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
        if seen is not None:
            return [seen]
        return [self._begin, self._before[robot]] if robot in self._before else [self._begin]
