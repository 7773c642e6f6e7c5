"""The lost place: odometry's path from the last known place, weighed against a search's first place.

The robot is where odometry leads, within its drift, or odometry went wrong and the robot is anywhere. A first place
within the drift is confirmed. One beside it contradicts odometry. Then either the path is wrong, by the odds of
:class:`LostPlace`. Or the robot is at the path's end, and the structure that fits at the first place has moved since
the survey, or the scans fit at the end hardly less. After a loss among moved buildings, the evidence of the map alone
puts a robot metres off its right path, from the first keyframe on. Odometry had hardly drifted there, so drift has to
explain the distance at the first keyframe of the evidence, not at the newest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.distributions import chi2_quantile
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES
from coview_stream.geometry.transforms import Poses, boxminus
from coview_stream.localization.evidence.moved_part import FARTHEST_MOVED, log_odds_of_moved
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.evidence.paths import SCATTER
from coview_stream.localization.registration.register import registration_covariance
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import BASIN_ANGLE, BASIN_DISTANCE, Scored
from coview_stream.localization.search.request import LostPlace, SearchRequest, same_place
from coview_stream.localization.search.scoring import PlaceScorer

_LEVEL = [3, 4, 5, 2]  # x, y, z and heading of (rx, ry, rz, x, y, z)
_FAR = 600.0  # squared distance, at most: odds stay finite
_HEIGHT = 0.5  # metres, sigma of the ground's height against the survey's: grass, snow, dug ground


def weighed_by_odometry(
    scored: Scored, leader: Hypothesis, request: SearchRequest, scans: Sequence[ObservedScan], base_map: BaseMap,
    config: LocalizerConfig, scorer: PlaceScorer, begin: LostPlace | None = None,
) -> Scored:  # fmt: skip
    """Return a keyframe's places, of which the first is registered as ``leader``, weighed by the request's lost place.

    ``scans`` are the newest keyframes, newest last; their evidence is that of ``scorer``. ``begin`` is the lost place
    at the scorer's first keyframe; None if that is the newest.
    """
    lost = request.lost
    if lost is None or leader.registration is None:
        return scored
    at = [leader.T_map_odom, *(place.T_map_odom for place in scored.places[1:])]
    registered = registration_covariance(leader.registration.information, config.registration)
    path = _by_path(np.stack(at), registered, request, lost, config, scorer, begin)
    first = np.array([k == 0 or same_place(T, at[0], request, BASIN_DISTANCE, BASIN_ANGLE) for k, T in enumerate(at)])
    scored = scored.weighed(np.minimum(path.density, 1.0) / lost.odds, first)
    metres, radians = np.linalg.norm(path.gaps[:, 3:], axis=1), np.abs(path.gaps[:, 2])
    at_end = (metres <= 0.5 * ALERT_METRES) & (radians <= math.radians(0.5 * ALERT_DEGREES))
    if at_end[0]:
        return scored  # both may be right
    right = log_odds_of_moved(base_map.field, scans, at[0], lost.T_map_odom)
    apart = path.squared[0] > chi2_quantile(len(_LEVEL), config.acceptance.risk)  # else both are modes of one place
    if apart and not (at_end & ~first).any():  # it is not weighed yet
        here, beside = scorer.beside(np.stack([at[0], lost.T_map_odom]))
        right = float(np.logaddexp(right, math.log(path.there[0]) + beside - here))
    odds = math.exp(min(right, 100.0)) / path.prior[0]
    return scored.beside([Hypothesis(lost.T_map_odom, probability=float(odds))])


def log_priors(
    T_map_odom: Poses, leader: Hypothesis, request: SearchRequest, config: LocalizerConfig, scorer: PlaceScorer,
    begin: LostPlace | None = None,
) -> Floats:  # fmt: skip
    """Return log-priors (M,) of modes (M, 4, 4) of the registered ``leader``'s place, up to a constant.

    They are zeros if no place was lost. Without them, a moved building beside odometry's path might win by a few nats.
    """
    if request.lost is None or leader.registration is None:
        return np.zeros(len(T_map_odom))
    registered = registration_covariance(leader.registration.information, config.registration)
    return np.log(_by_path(T_map_odom, registered, request, request.lost, config, scorer, begin, one_place=True).prior)


class _Path(NamedTuple):
    """Comparison of P places with odometry's path; densities in the unit of :func:`_by_drift`."""

    gaps: Floats  # (P, 6) from the path's newest end
    squared: Floats  # (P,) distances in units of the drift and of its growth since the first keyframe, squared
    there: Floats  # (P,) density of the drift at no gap
    density: Floats  # (P,) of the drift
    prior: Floats  # (P,) density of the drift or a slip, not normalised


def _by_path(
    at: Poses, registered: Floats, request: SearchRequest, lost: LostPlace, config: LocalizerConfig,
    scorer: PlaceScorer, begin: LostPlace | None, *, one_place: bool = False,
) -> _Path:  # fmt: skip
    """Compare places (P, 4, 4) with odometry's path; ``registered`` (6, 6) is the covariance of a registered pose.

    Places within the drift are compared at the first keyframe, where ``begin`` is the lost place, and by the growth of
    their gaps since; the others at the newest, as all are without ``begin``. Poses of ``one_place`` are all compared at
    the same keyframe, else a mode beyond the drift might have more prior than a nearer one.
    """
    end = lost.T_map_odom @ request.T_odom_body
    gaps = np.array([boxminus(end, T @ request.T_odom_body) for T in at])
    spread = lost.covariance + registered + np.diag([0.0, 0.0, 0.0, 0.0, 0.0, _HEIGHT**2])
    there, distance = _by_drift(gaps, spread)
    near, since = distance <= chi2_quantile(len(_LEVEL), config.acceptance.risk), np.zeros(len(at))
    near |= one_place and near.any()
    slipped = lost.odds if begin is None else min(begin.odds, lost.odds)  # by the first keyframe
    if begin is not None and near.any():
        T_odom_first, path = scorer.look_back(at[near])
        gap = (begin.T_map_odom @ T_odom_first)[:2, 3] - path[:, :2]
        scatter = registered[3:5, 3:5] + SCATTER**2 * np.eye(2)
        size, axes = np.linalg.eigh((lost.covariance - begin.covariance)[3:5, 3:5])  # a way back unwinds drift
        grown = scatter + (axes * np.maximum(size, 0.0)) @ axes.T
        later = gaps[near, 3:5] - gap
        since[near] = np.minimum(np.einsum("ki,ki->k", later, np.linalg.solve(grown, later.T).T), _FAR)
        first = gaps[near]
        spread[3:5], spread[:, 3:5], first[:, 3:5] = 0.0, 0.0, gap
        spread[3:5, 3:5] = begin.covariance[3:5, 3:5] + scatter
        there[near], distance[near] = _by_drift(first, spread)
    along = np.exp(-0.5 * since)
    density = along * there * np.exp(-0.5 * distance)
    return _Path(gaps, distance + since, there, density, density + along * slipped + (lost.odds - slipped))


def _by_drift(gaps: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Return the density of odometry's drift at no gap, and squared distances, of gaps (P, 6) with a spread (6, 6).

    Densities are multiples of that of a slip, which is even within the reach of moved parts.
    """
    level = gaps[:, _LEVEL]
    distance = np.einsum("ki,ki->k", level, np.linalg.solve(spread[np.ix_(_LEVEL, _LEVEL)], level.T).T)
    there = math.pi * FARTHEST_MOVED**2 / math.sqrt(float(np.linalg.det(2.0 * np.pi * spread[3:5, 3:5])))
    return np.full(len(gaps), there), distance
