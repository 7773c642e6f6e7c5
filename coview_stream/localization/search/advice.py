"""Advice to an ambiguous robot: the path to where the fitting places differ most, from the map alone.

From the most probable place, virtual scans of the map (:func:`virtual_scan`) are taken along the paths with ground and
compared with the map at the other fitting places, as if the robot had driven there. The advice is added to the reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from coview_kernels import Move
from coview_stream.descriptors.coview import EYE
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, inverse, pose_from, rot_z
from coview_stream.localization.search.acceptance import Considered, SearchResult
from coview_stream.localization.search.ambiguity import virtual_scan
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.places import BASIN_ANGLE, BASIN_DISTANCE
from coview_stream.localization.search.request import Epoch, SearchRequest
from coview_stream.localization.state import State

_SIDES = ("ahead", "to the left", "back", "to the right")  # of the body, counter-clockwise
_METRES = (5, 15, 30)  # driven; each costs a virtual scan
_STEP = 2.0  # metres; a path has a station at each step
_AGAIN = 10.0  # metres of driving until new advice
_SERIOUS, _MOST = 0.01, 5  # least probability of another place relative to the first one's, and the number of places


class AdvisedSearch(GlobalSearch):
    """Search whose results, if several places fit, say where to drive to tell them apart.

    Attributes:
        considered: places of the newest keyframe, None without any.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        """As :class:`GlobalSearch`."""
        super().__init__(*args, **options)
        self.considered: Considered | None = None
        self._goal: Floats | None = None  # (3,) odometry frame; None if no path is better than staying
        self._asked: tuple[Epoch, float] | None = None  # epoch and metres driven at the newest advice

    def update(self, request: SearchRequest) -> SearchResult:
        """Search the map for one keyframe; the reason of an ambiguous one ends with the advice."""
        result = super().update(request)
        self.considered = result.considered
        if result.considered is None or result.evidence.state is not State.AMBIGUOUS:
            return result
        places = serious(result.considered.places - np.array([*self.base_map.origin, 0.0, 0.0, 0.0]))
        if len(places) < 2:
            return result
        before, T_odom_body = self._asked, result.T_odom_body
        if before is None or before[0] != result.epoch or result.travelled - before[1] >= _AGAIN:
            self._asked = result.epoch, result.travelled
            away = self._best_way(places)
            self._goal = None if away is None else T_odom_body[:3, :3] @ away + T_odom_body[:3, 3]
        evidence = replace(result.evidence, reason=f"{result.evidence.reason}; {_in_words(self._goal, T_odom_body)}")
        return replace(result, evidence=evidence)

    def _best_way(self, places: list[Pose]) -> Floats | None:
        """Return the goal (3,) in the body frame at which the places (map <- body) differ most; None for here."""
        best, goal = self._difference(places, places[0][:3, 3]), None
        for away, there in self._ways(places[0]):
            difference = self._difference(places, there)
            if difference > best:
                best, goal = difference, away
        return goal

    def _ways(self, T_map_body: Pose) -> Iterator[tuple[Floats, Floats]]:
        """Yield goals, nearest first: in the body frame, and on the map's ground; a path ends where no station is."""
        heading = np.arange(len(_SIDES)) * (2.0 * np.pi / len(_SIDES))
        along = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(_SIDES))])
        at, grid = np.tile(T_map_body[:3, 3], (len(_SIDES), 1)), self.base_map.station_grid
        open_ways, driven = np.ones(len(_SIDES), dtype=bool), 0.0
        for metres in _METRES:
            while driven < metres:
                driven = min(driven + _STEP, float(metres))
                at[:, :2] = T_map_body[:2, 3] + driven * (along @ T_map_body[:3, :3].T)[:, :2]
                station = grid.at(at)
                open_ways &= station >= 0
                at[open_ways, 2] = self.base_map.stations[station[open_ways], 2]
            for side in np.flatnonzero(open_ways):
                yield driven * along[side], at[side].copy()

    def _difference(self, places: list[Pose], there: Floats) -> float:
        """Return by how much a view from ``there`` (3,) scores better at the first place than at the best other one."""
        station = int(self.base_map.station_grid.at(there[None])[0])
        eye = there.copy() if station < 0 else np.array([*there[:2], self.base_map.stations[station, 2]])
        eye[2] += EYE
        scan = virtual_scan(self.base_map, eye, 0.0, self.config.registration)
        if scan is None:
            return 0.0
        moved = np.array([place @ inverse(places[0]) for place in places])
        seen = scan.few.look_up(self.base_map.field, scan.poses(moved), Move.NEAR)
        inside = seen.parts[1:, -1].min()  # beyond the survey nothing speaks against a place
        return float(inside * (seen.scores[0] - seen.scores[1:].max()))


def serious(places: Floats) -> list[Pose]:
    """Return map <- body of the first :class:`Considered` place (K, 6) and of distinct places that may be right."""
    x, y, z, yaw, probability, _ = places.T
    turn = np.abs((yaw - yaw[0] + np.pi) % (2.0 * np.pi) - np.pi)
    apart = (np.linalg.norm(places[:, :3] - places[0, :3], axis=1) > BASIN_DISTANCE) | (turn > BASIN_ANGLE)
    rows = [0, *np.flatnonzero(apart & (probability > _SERIOUS * probability[0]))[: _MOST - 1]]
    return [pose_from(rot_z(yaw[k]), np.array([x[k], y[k], z[k]])) for k in rows]


def _in_words(goal: Floats | None, T_odom_body: Pose) -> str:
    if goal is None:
        return f"on no way of {_METRES[-1]} m do they differ more than here"
    away = T_odom_body[:3, :3].T @ (goal - T_odom_body[:3, 3])
    side = round(float(np.arctan2(away[1], away[0])) / (0.5 * np.pi)) % len(_SIDES)
    return f"they differ most {max(1.0, float(np.hypot(*away[:2]))):.0f} m {_SIDES[side]}"
