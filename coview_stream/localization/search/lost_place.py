"""The lost place: odometry's path from the last known place, weighed against a search's first place.

The robot is where odometry leads, within its drift, or odometry went wrong and the robot is anywhere. A first place
within the drift is confirmed. One beside it contradicts odometry. Either odometry is wrong, with the odds at the loss
and those of a slip by the clouds alone. Or the robot is where odometry leads, and the structure that fits at the first
place has moved since the survey, or the scans fit at the path's end hardly less. After a loss among moved buildings,
the evidence of the map alone puts a robot metres off its right path.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.distributions import chi2_quantile
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES
from coview_stream.geometry.transforms import boxminus
from coview_stream.localization.evidence.moved_part import FARTHEST_MOVED, log_odds_of_moved
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.register import registration_covariance
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.refinement import Beside
from coview_stream.localization.search.request import SearchRequest


def weighed_by_odometry(
    scored: Scored, leader: Hypothesis, request: SearchRequest, scans: Sequence[ObservedScan], base_map: BaseMap,
    config: LocalizerConfig, beside: Beside,
) -> Scored:  # fmt: skip
    """Return a keyframe's places, of which the first is registered as ``leader``, weighed by the request's lost place.

    ``scans`` are the keyframes, newest last; their evidence is that of ``beside``.
    """
    lost = request.lost
    if lost is None or leader.registration is None:
        return scored
    gap = boxminus(lost.T_map_odom @ request.T_odom_body, leader.T_map_odom @ request.T_odom_body)
    shift = gap[3:5]
    spread = lost.covariance + registration_covariance(leader.registration.information, config.registration)
    distance = float(shift @ np.linalg.solve(spread[3:5, 3:5], shift))
    # densities by odometry's drift, in multiples of that of a slip, which is even within the reach of moved parts
    there = math.pi * FARTHEST_MOVED**2 / math.sqrt(float(np.linalg.det(2.0 * np.pi * spread[3:5, 3:5])))
    here = there * math.exp(-0.5 * distance)
    scored = scored.confirmed(min(here, 1.0) / lost.odds)
    metres, degrees = float(np.linalg.norm(shift)), math.degrees(abs(gap[2]))
    if metres <= 0.5 * ALERT_METRES and degrees <= 0.5 * ALERT_DEGREES:
        return scored  # both may be right
    ratios = beside(np.stack([leader.T_map_odom, lost.T_map_odom]))
    right = log_odds_of_moved(base_map.field, scans, leader.T_map_odom, lost.T_map_odom)
    if distance > chi2_quantile(2, config.acceptance.risk):  # else these are modes of one place
        right = float(np.logaddexp(right, math.log(there) + ratios[1] - ratios[0]))
    odds = math.exp(min(right, 100.0)) / (here + lost.odds)
    return scored.beside([Hypothesis(lost.T_map_odom, ratio=float(ratios[1]), probability=odds)])
