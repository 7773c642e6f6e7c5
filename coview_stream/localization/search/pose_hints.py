"""Hints of where the robot may be, from before the search: hypotheses to verify, never trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Circle, Pose, inverse, pose_from, rot_z, transform, yaw_of
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.place_guess import PlaceGuess

_TRIES = 5  # keyframes in a row that must refute all hints before they are tried less often; set by hand
_PAUSE = 4  # keyframes between two tries then; set by hand
_GROWTH = 1.25  # of the radius of a circle, from step to step and at first: no step within a quarter of it; set by hand

FROM_THERE = " (from the last known place)"
"""What an evidence's reason ends with where the best hypothesis began as a hint."""


class PoseHints:
    """Hints of a localizer to its search: ``T_map_odom`` in an odometry frame that keeps its origin.

    The localizer's own odometry frame has its origin moved to an anchor; here it is undone, for after a loss there is
    another anchor. Map coordinates are the map's own.

    Attributes:
        circle: of the map, metres from its zero, that the robot was said to be in; None for none.
    """

    def __init__(self) -> None:
        self._awaited: Pose | None = None  # T_map_body at the next frame
        self._known: tuple[Pose, ...] = ()
        self._leader: Pose | None = None  # of the search so far
        self._led: tuple[Pose, ...] = ()
        self._guess: PlaceGuess | None = None  # of the place at the next frame
        self._guessed: tuple[Pose, ...] = ()
        self.circle: Circle | None = None
        self._said_at = np.zeros(3)  # where odometry had the robot then

    def clear(self) -> None:
        """Forget them all: a place has been accepted."""
        self._awaited, self._known = None, ()
        self.forget_leader()
        self._guess, self._guessed, self.circle = None, (), None

    def guess(self, guess: PlaceGuess) -> None:
        """Have a guess of the place at the next frame tried, in place of an earlier one."""
        self._guess = guess

    def guessed(self, origin: Floats, anchor: Floats, T_odom_body: Pose) -> tuple[Pose, ...]:
        """Return the guess as ``T_map_odom`` about ``anchor``, heights open.

        Args:
            origin: (3,) of the map.
            anchor: (3,) as of :meth:`about`.
            T_odom_body: (4, 4) likewise.
        """
        if self._guess is not None:
            guess, self._guess = self._guess, None
            away = pose_from(np.eye(3), -anchor)
            self._guessed = tuple(T @ away for T in guess.transforms(origin, T_odom_body))
            self.circle, self._said_at = guess.area(origin), anchor + T_odom_body[:3, 3]
        return tuple(T @ pose_from(np.eye(3), anchor) for T in self._guessed)

    def area(self, anchor: Floats, T_odom_body: Pose) -> Circle | None:
        """Return the circle that the robot is in now, if it was in the one that was said: wider by what it has driven.

        It grows in steps, for the votes so far go with each. The arguments are as for :meth:`about`.
        """
        if self.circle is None:
            return None
        moved = float(np.linalg.norm(anchor + T_odom_body[:3, 3] - self._said_at))
        steps = math.ceil(math.log(1.0 + moved / self.circle.radius, _GROWTH))
        return replace(self.circle, radius=self.circle.radius * _GROWTH ** max(1, steps))

    def robot_at(self, T_map_body: Pose) -> None:
        """Hint that the robot will be at ``T_map_body`` (4, 4) at the next frame."""
        self._awaited = T_map_body

    def odometry_continues(self, T_map_odom: Pose, anchor: Floats) -> None:
        """Hint, in place of all others, that odometry goes on: ``T_map_odom`` (4, 4) about ``anchor`` (3,)."""
        self._awaited, self._known = None, (T_map_odom @ pose_from(np.eye(3), -anchor),)
        self.forget_leader()

    def place_leads(self, T_map_odom: Pose, anchor: Floats) -> None:
        """Note that ``T_map_odom`` (4, 4) about ``anchor`` (3,) leads the search; no hint until it begins anew."""
        self._leader = T_map_odom @ pose_from(np.eye(3), -anchor)

    def search_begins_anew(self) -> None:
        """Hint at the place that has led the search so far, if any."""
        if self._leader is not None:
            self._led = (self._leader,)

    def forget_leader(self) -> None:
        """Forget the place that led: the odometry that it is tied to has been contradicted."""
        self._leader, self._led = None, ()

    def about(self, anchor: Floats, T_odom_body: Pose) -> tuple[Pose, ...]:
        """Return them as ``T_map_odom`` about ``anchor``, at a frame of pose ``T_odom_body`` about it as well."""
        if self._awaited is not None:
            T_map_body, self._awaited = self._awaited, None
            # level, for both frames are: how the robot leans now is not how it leant then
            turn = rot_z(yaw_of(T_map_body @ inverse(T_odom_body)))
            T = pose_from(turn, T_map_body[:3, 3] - turn @ T_odom_body[:3, 3])
            self._known = (*self._known, T @ pose_from(np.eye(3), -anchor))
        return tuple(T @ pose_from(np.eye(3), anchor) for T in (*self._known, *self._led))


class HintSchedule:
    """Schedule of hints: all are tried at every keyframe, until a few in a row have refuted them.

    Then at every fifth, not never: the sensor may only have been covered.
    """

    def __init__(self) -> None:
        self._of: tuple[bytes, ...] = ()
        self._refuted = 0
        self._wait = 0

    def due(self, hints: Sequence[Pose]) -> list[Hypothesis]:
        """Return those to be tried at this keyframe, as hypotheses with no station behind them."""
        of = tuple(T.tobytes() for T in hints)
        if of != self._of:
            self._of, self._refuted, self._wait = of, 0, 0
        if self._wait:
            self._wait -= 1
            return []
        return [Hypothesis(T, None, None, 0.0) for T in hints]

    def tried(self, refuted: bool) -> None:
        """Count a keyframe at which they were tried, and whether it spoke against all of them."""
        self._refuted = self._refuted + 1 if refuted else 0
        if self._refuted >= _TRIES:
            self._wait = _PAUSE


def robot_position(T_map_odom: Pose, T_odom_body: Pose) -> Floats:
    """Return the robot's position (1, 2) in the map, as a hint has it."""
    return transform(T_map_odom, T_odom_body[None, :3, 3])[:, :2]
