"""Hints and guesses of a robot's place, none of them trusted but the circle of a guess, which limits the search."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.stations import StationGrid
from coview_stream.config.checks import require
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Circle, Pose, inverse, pose_from, rot_z, transform, yaw_of
from coview_stream.geometry.validation import MAX_COORDINATE
from coview_stream.localization.search.consensus import Hypothesis

# poses of a guess: scoring moves a hypothesis by up to three metres and seven degrees
_SPACING = 3.0  # metres
_TURN = np.radians(13.0)
_MAX_POSES = 400

_TRIES = 5  # successive keyframes that must refute all hints before these are tried less often
_PAUSE = 4  # keyframes between two later tries
_GROWTH = 1.25  # factor on a circle's radius, at first and per step: a quarter of the radius is driven without a step

MAX_DISTANCE = 20.0
"""Maximum distance around a guess that is tried, metres."""

MIN_WITHIN = 50.0
"""Metres, smallest radius of a circle to search alone: evidence is judged against the other places in it.

This is the radius of a virtual scan; no robot got a pose in 16 circles that it was not in.
"""

FROM_THERE = " (from the last known place)"
"""End of an evidence's reason where the best hypothesis was a hint at first."""


@dataclass(frozen=True)
class PlaceGuess:
    """A guess of a robot's place.

    Attributes:
        x, y: in the frame of the map's sources, metres.
        yaw: heading of the body's x axis, radians, counter-clockwise from the map's x axis; None for any.
        distance: metres around it that are also tried, up to :data:`MAX_DISTANCE`.
        angle: radians to either side of ``yaw`` that are also tried.
        map: name of the one of several maps that it refers to; None or ``map`` for a single map.
        within: radius in metres of the circle to search; None for the whole map. It is trusted, unlike the rest: a
            robot outside is never found.
        begin, end: range of x to which ``within`` is cut, where one of several maps ends.
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
        for name in ("x", "y", "yaw", "distance", "angle", "within"):
            value = getattr(self, name)
            if value is not None or name not in ("yaw", "within"):
                plain = isinstance(value, numbers.Real) and not isinstance(value, bool)
                require(plain and -math.inf < value < math.inf, self, name, "a finite number")
        require(max(abs(self.x), abs(self.y)) < MAX_COORDINATE, self, "x", "map coordinates in metres")
        require(0.0 < self.distance <= MAX_DISTANCE, self, "distance", f"above 0, at most {MAX_DISTANCE:g} m")
        require(0.0 <= self.angle <= np.pi, self, "angle", "0 to pi radians")
        if self.within is not None:
            require(MIN_WITHIN <= self.within < MAX_COORDINATE, self, "within", f"{MIN_WITHIN:g} m or more")

    def poses(self) -> Floats:
        """Return (K, 3) x, y and yaw to try, nearest to the guess first."""
        steps = np.arange(-np.ceil(self.distance / _SPACING), np.ceil(self.distance / _SPACING) + 1) * _SPACING
        xy = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        far = np.linalg.norm(xy, axis=1)
        xy, far = xy[far <= self.distance], far[far <= self.distance]
        reach = np.pi if self.yaw is None else self.angle
        count = int(np.ceil(reach / _TURN))
        turns = np.arange(-count, count + 1) * (reach / max(count, 1))
        if reach == np.pi:
            turns = turns[1:]  # both ends are the same heading
        poses = np.array([(x, y, turn) for x, y in xy for turn in turns])
        unlikely = np.repeat(far / self.distance, len(turns)) + np.tile(np.abs(turns) / max(reach, 1e-9), len(xy))
        poses = poses[np.argsort(unlikely, kind="stable")][:_MAX_POSES]
        return np.asarray(np.add(poses, (self.x, self.y, self.yaw or 0.0)))

    def area(self, origin: Floats) -> Circle | None:
        """Return the circle to search, about the map's ``origin`` (3,); None for none."""
        if self.within is None:
            return None
        x, y = float(origin[0]), float(origin[1])
        return Circle(self.x - x, self.y - y, self.within, self.begin - x, self.end - x)

    def transforms(self, origin: Floats, T_odom_body: Pose) -> tuple[Pose, ...]:
        """Return the poses as level ``T_map_odom`` (4, 4) about the map's ``origin`` (3,), with unknown heights (0).

        ``T_odom_body`` (4, 4) is of the frame at which the guess holds.
        """
        out = []
        for x, y, yaw in self.poses():
            turn = rot_z(yaw - yaw_of(T_odom_body))
            at = np.array([x - origin[0], y - origin[1], 0.0])
            out.append(pose_from(turn, at - turn @ T_odom_body[:3, 3]))
        return tuple(out)


def on_the_ground(guesses: list[Hypothesis], ground: Floats, grid: StationGrid) -> list[Hypothesis]:
    """Put guesses of ``T_map_odom``, of unknown height, on each level of the map's ground; drop those off the map.

    ``ground`` (3,) is the ground below the robot, odometry frame, metres.
    """
    out = []
    for guess in guesses:
        T = guess.T_map_odom
        there = transform(T, ground[None])
        for station in grid.levels_at(there)[:, 0]:
            if station >= 0:
                lift = grid.stations[station, 2] - there[0, 2]
                out.append(Hypothesis(pose_from(T[:3, :3], T[:3, 3] + (0.0, 0.0, lift))))
    return out


def require_ground(guess: PlaceGuess, base_map: BaseMap) -> None:
    """Raise InputError if a guess has another type, or the map has no ground near it or within its circle, if any."""
    if not isinstance(guess, PlaceGuess):
        raise InputError(f"guess is a {type(guess).__name__}; give a coview_stream.PlaceGuess(x, y)")
    area, places = guess.area(base_map.origin), guess.poses()[:, :2] - base_map.origin[:2]
    ground = base_map.station_grid.levels_at(places) >= 0 if area is None else area.holds(base_map.stations)
    if not ground.any():
        raise InputError(
            f"guess: the map has no ground within {guess.within or guess.distance:g} m of it; "
            "give coordinates of the frame of the map's sources (coview-stream info)"
        )


class PoseHints:
    """Hints of a localizer to its search, stored as ``T_map_odom`` about the origin of corrected odometry.

    The localizer uses odometry about an anchor (3,), another one after each loss; here all anchors are undone.

    Attributes:
        circle: circle on the map, metres from its zero, in which the robot is said to be; None for none.
    """

    def __init__(self) -> None:
        self._awaited: tuple[Pose, ...] = ()  # T_map_body at the next frame
        self._known: tuple[Pose, ...] = ()
        self._lost: Pose | None = None  # the lost place, if odometry continues
        self._leader: Pose | None = None  # leading place of the current search
        self._led: tuple[Pose, ...] = ()
        self._guess: PlaceGuess | None = None  # of the place at the next frame
        self._guessed: tuple[Pose, ...] = ()
        self.circle: Circle | None = None
        self._circle_at = np.zeros(3)  # position by odometry at the guess

    def clear(self) -> None:
        """Forget all hints, as a place has been accepted."""
        self._awaited = self._known = ()
        self._lost = None
        self.forget_leader()
        self._guess, self._guessed, self.circle = None, (), None

    def guess(self, guess: PlaceGuess) -> None:
        """Try a guess of the place at the next frame, instead of an earlier guess."""
        self._guess = guess

    def guessed(self, origin: Floats, anchor: Floats, T_odom_body: Pose) -> tuple[Pose, ...]:
        """Return the guess as ``T_map_odom`` about ``anchor``, with unknown heights.

        ``origin`` (3,) is the map's; the other arguments are as in :meth:`about`.
        """
        if self._guess is not None:
            guess, self._guess = self._guess, None
            away = pose_from(np.eye(3), -anchor)
            self._guessed = tuple(T @ away for T in guess.transforms(origin, T_odom_body))
            self.circle, self._circle_at = guess.area(origin), anchor + T_odom_body[:3, 3]
        return tuple(T @ pose_from(np.eye(3), anchor) for T in self._guessed)

    def area(self, anchor: Floats, T_odom_body: Pose) -> Circle | None:
        """Return the given circle, widened by the distance driven since then; the arguments are as in :meth:`about`.

        It grows in steps, as each step discards the votes so far.
        """
        if self.circle is None:
            return None
        moved = float(np.linalg.norm(anchor + T_odom_body[:3, 3] - self._circle_at))
        steps = math.ceil(math.log(1.0 + moved / self.circle.radius, _GROWTH))
        return replace(self.circle, radius=self.circle.radius * _GROWTH ** max(1, steps))

    def robot_at(self, T_map_body: Pose) -> None:
        """Hint that the robot will be at ``T_map_body`` (4, 4) at the next frame."""
        self._awaited = (T_map_body,)

    def odometry_jumped(self, anchor: Floats, T_odom_body: Pose) -> None:
        """Turn all hints into places of the body at the frame before a jump of odometry; args as in :meth:`about`.

        Guesses and circles end.
        """
        places = tuple(T @ pose_from(np.eye(3), anchor) @ T_odom_body for T in (*self._known, *self._led))
        places = (*self._awaited, *places)
        self.clear()
        self._awaited = places

    def odometry_continues(self, T_map_odom: Pose, anchor: Floats) -> None:
        """Hint, replacing all others, that odometry continues: ``T_map_odom`` (4, 4) about ``anchor`` (3,)."""
        self._lost = T_map_odom @ pose_from(np.eye(3), -anchor)
        self._awaited, self._known = (), (self._lost,)
        self.forget_leader()

    def forget_lost(self) -> None:
        """Keep the lost place as a mere hint, as odometry does not lead from there."""
        self._lost = None

    def lost(self, anchor: Floats) -> Pose | None:
        """Return the lost place as ``T_map_odom`` about ``anchor`` (3,); None without one that odometry continues."""
        return None if self._lost is None else self._lost @ pose_from(np.eye(3), anchor)

    def place_leads(self, T_map_odom: Pose, anchor: Floats) -> None:
        """Store the search's leader, ``T_map_odom`` (4, 4) about ``anchor`` (3,), as a hint for the next search."""
        self._leader = T_map_odom @ pose_from(np.eye(3), -anchor)

    def search_begins_anew(self) -> None:
        """Hint at the place that has led the search so far, if any."""
        if self._leader is not None:
            self._led = (self._leader,)

    def forget_leader(self) -> None:
        """Forget the leading place, as the odometry that it is tied to was contradicted."""
        self._leader, self._led = None, ()

    def about(self, anchor: Floats, T_odom_body: Pose) -> tuple[Pose, ...]:
        """Return the hints as ``T_map_odom`` about ``anchor`` (3,), at a frame of pose ``T_odom_body`` about it."""
        awaited, self._awaited = self._awaited, ()
        for T_map_body in awaited:  # level, as both frames are: the robot's lean has changed since
            turn = rot_z(yaw_of(T_map_body @ inverse(T_odom_body)))
            T = pose_from(turn, T_map_body[:3, 3] - turn @ T_odom_body[:3, 3])
            self._known = (*self._known, T @ pose_from(np.eye(3), -anchor))
        return tuple(T @ pose_from(np.eye(3), anchor) for T in (*self._known, *self._led))


class HintSchedule:
    """Schedule of hints: all are tried at every keyframe until a few in a row have refuted them.

    Then they are tried at every fifth rather than never, as the sensor may only have been covered.
    """

    def __init__(self) -> None:
        self._hints: tuple[bytes, ...] = ()
        self._refuted = 0
        self._wait = 0

    def due(self, hints: Sequence[Pose]) -> list[Hypothesis]:
        """Return the hints to try at this keyframe, as hypotheses without a station."""
        hashes = tuple(T.tobytes() for T in hints)
        if hashes != self._hints:
            self._hints, self._refuted, self._wait = hashes, 0, 0
        if self._wait:
            self._wait -= 1
            return []
        return [Hypothesis(T) for T in hints]

    def tried(self, refuted: bool) -> None:
        """Count a keyframe that tried the hints, and whether it refuted all of them."""
        self._refuted = self._refuted + 1 if refuted else 0
        if self._refuted >= _TRIES:
            self._wait = _PAUSE


def robot_position(T_map_odom: Pose, T_odom_body: Pose) -> Floats:
    """Return the robot's position (1, 2) in the map under a hint."""
    return transform(T_map_odom, T_odom_body[None, :3, 3])[:, :2]
