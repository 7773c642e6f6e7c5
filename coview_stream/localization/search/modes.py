"""Modes of a place: the poses within it that registration may end at, and how probable each is.

A place is all poses within two metres of its best. Registration leads to the nearest pose that fits, and where there is
little to see, or much has changed, that may be a wall's neighbour a metre away. So an accepted place is registered from
poses all around, and what comes out is weighed by the log-likelihood ratio of the scan, as places are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import Move
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_METRES
from coview_stream.geometry.transforms import Pose, boxminus
from coview_stream.localization.evidence.chance_places import observe_with_background
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.search.refinement import Candidate, register_place
from coview_stream.localization.search.request import SearchRequest, same_place
from coview_stream.localization.search.scoring import BASIN_ANGLE, BASIN_DISTANCE

# set by hand
_AROUND = 1.2  # metres: a little more than registration reaches from a pose
_DIRECTIONS = 8
_SAME_METRES, _SAME_RADIANS = 0.3, np.radians(2.0)  # nearer poses are one mode


@dataclass(frozen=True)
class Modes:
    """The modes of a place.

    Attributes:
        best: the most probable one.
        distances: (M,) metres of each from that.
        probabilities: (M,) of each; they add up to one.
    """

    best: Candidate
    distances: Floats
    probabilities: Floats

    @property
    def undecided(self) -> float:
        """Metres to the most probable mode elsewhere, if those elsewhere are together more probable than the best's."""
        elsewhere = self.distances > 0.5 * ALERT_METRES
        if self.probabilities[elsewhere].sum() < 0.5:
            return 0.0
        return float(self.distances[elsewhere][self.probabilities[elsewhere].argmax()])


def find_modes(
    leader: Candidate, scan: ObservedScan, request: SearchRequest, base_map: BaseMap, config: LocalizerConfig,
    local_maps: LocalMaps,
) -> Modes:  # fmt: skip
    """Register a scan from poses around a registered place, and weigh what comes out within the place."""
    place, start, found = leader.place.hypothesis.T_map_odom, leader.T_map_odom, [leader]
    for angle in 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        moved = start.copy()
        moved[:2, 3] += _AROUND * np.cos(angle), _AROUND * np.sin(angle)
        beside = replace(leader.place, hypothesis=replace(leader.place.hypothesis, T_map_odom=moved))
        other = register_place(beside, scan, base_map, config, local_maps)
        if other is not None and same_place(other.T_map_odom, place, request, BASIN_DISTANCE, BASIN_ANGLE):
            found.append(other)
    poses = np.array([each.T_map_odom for each in found])
    _, background = observe_with_background(base_map.field, scan, poses[:1])
    observed = scan.many.look_up(base_map.field, scan.poses(poses), Move.NONE)
    ratios = log_likelihood_ratios(observed.shares, background)[0]
    own: list[int] = []
    for k in np.argsort(-ratios, kind="stable"):
        if not any(_same(found[k], found[j], scan.T_odom_body) for j in own):
            own.append(int(k))
    weights = np.exp(ratios[own] - ratios[own[0]])
    far = [_apart(found[k], found[own[0]], scan.T_odom_body)[0] for k in own]
    return Modes(found[own[0]], np.array(far), weights / weights.sum())


def _same(one: Candidate, other: Candidate, T_odom_body: Pose) -> bool:
    metres, radians = _apart(one, other, T_odom_body)
    return metres < _SAME_METRES and radians < _SAME_RADIANS


def _apart(one: Candidate, other: Candidate, T_odom_body: Pose) -> tuple[float, float]:
    """Return how far the robot is from itself: metres, radians."""
    gap = boxminus(one.T_map_odom @ T_odom_body, other.T_map_odom @ T_odom_body)
    return float(np.linalg.norm(gap[3:])), float(np.linalg.norm(gap[:3]))
