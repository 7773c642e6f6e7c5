"""Evidence of a tracked place: the search's log-likelihood ratio, with nuisance parameters learned along the path.

Tracking starts with an even prior over the nuisance parameters (unchanged share of the site, kind of survey, leaks
through foliage). They change slowly along the path: their posterior at one registration, spread slightly, is the prior
of the next (docs/integrity.md, eq. 6). So explaining half of the scan speaks for a place in a street where half has
changed, and against it where nearly all was explained a metre before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coview_kernels import Move
from coview_stream.basemap.basemap import BaseMap
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.evidence.background import Background, observe_with_background
from coview_stream.localization.evidence.likelihood import KEPT, NUISANCES, log_likelihoods
from coview_stream.localization.evidence.moved_part import log_odds_of_moved
from coview_stream.localization.evidence.observation import ObservedScan

# set by hand; right registrations of seven drives and three real runs hardly depend on them (docs/integrity.md)
_SPREAD = 0.05  # sigma of the change of the unchanged share q between two registrations
_ANOTHER = 0.01  # probability that the kind of survey and the leaks change between two registrations
_CHANGED = 1e-4  # probability that the whole site changes between two registrations
_BESIDE = 0.5  # probability that a wrong place is metres off, by a slip of odometry, and not anywhere


@dataclass(frozen=True)
class Observation:
    """Evidence of a scan for a pose."""

    ratio: float  # log-likelihood ratio of "the robot is here" against chance
    likelihoods: Floats  # (Q, D, L) log-likelihood ratios by unchanged share, kind of survey and leaks
    rival: float = 0.0  # log-likelihood ratio of the most probable pose metres away; that of chance without any

    @property
    def against_elsewhere(self) -> float:
        """Log-likelihood ratio of "the robot is here" against "it is metres away, or anywhere"."""
        rival = math.log(_BESIDE) + max(self.rival, 0.0)
        return self.ratio - float(np.logaddexp(math.log1p(-_BESIDE), rival))


class PlaceEvidence:
    """Belief over the nuisance parameters at one place, from registrations, and the evidence of a scan given them."""

    def __init__(self, base_map: BaseMap) -> None:
        self._base_map = base_map
        self._newest: tuple[ObservedScan, Pose, Background] | None = None  # background around a scan's pose
        self.clear()

    def clear(self) -> None:
        """Reset the nuisance parameters, for another place."""
        self._known = np.full(NUISANCES, 1.0 / np.prod(NUISANCES))

    def observe(self, scan: ObservedScan, T_map_odom: Pose) -> Observation:
        """Return the evidence of a scan at a pose (4, 4); changes nothing."""
        likelihoods = self._likelihoods(scan, T_map_odom[None])
        return Observation(float(self._ratios(likelihoods)[0]), likelihoods[0])

    def ratios(self, scan: ObservedScan, T_map_odom: Floats) -> Floats:
        """Return the log-likelihood ratios (P,) of poses (P, 4, 4) against chance around the first."""
        return self._ratios(self._likelihoods(scan, T_map_odom))

    def look_around(self, scan: ObservedScan, T_map_odom: Pose, poses: Floats) -> tuple[Floats, Floats]:
        """Move poses (H, 4) to the best ones nearby; return them and their log-likelihood ratios (H,)."""
        observed = scan.few.look_up(self._base_map.field, poses, Move.NEAR)
        return observed.poses, self._ratios(log_likelihoods(observed.shares, self._background(scan, T_map_odom)))

    def log_odds_of_moved(self, scans: Sequence[ObservedScan], T_map_odom: Pose, T_map_other: Pose) -> float:
        """Return the log-odds that the robot is at the other pose, and the structure that fits here has moved."""
        return log_odds_of_moved(self._base_map.field, scans, T_map_odom, T_map_other)

    def learn(self, observation: Observation) -> None:
        """Learn the nuisance parameters from a believed registration; others would make a wrong place usual."""
        likelihoods = observation.likelihoods
        posterior = self._presumed() * np.exp(likelihoods - likelihoods.max())
        self._known = posterior / posterior.sum()

    def _likelihoods(self, scan: ObservedScan, T_map_odom: Floats) -> Floats:
        """Return log-likelihood ratios (P, Q, D, L) of poses (P, 4, 4) against chance around the first."""
        background = self._background(scan, T_map_odom[0])
        observed = scan.few.look_up(self._base_map.field, scan.poses(T_map_odom), Move.NONE)
        return log_likelihoods(observed.shares, background)

    def _background(self, scan: ObservedScan, T_map_odom: Pose) -> Background:
        """Return the background around a pose (4, 4); the newest is cached."""
        newest = self._newest
        if newest is None or newest[0] is not scan or not np.array_equal(newest[1], T_map_odom):
            _, background = observe_with_background(self._base_map.field, scan, T_map_odom[None])
            self._newest = newest = scan, T_map_odom, background
        return newest[2]

    def _ratios(self, likelihoods: Floats) -> Floats:
        """Return the log-likelihood ratios (P,) under the prior of the nuisance parameters."""
        top = likelihoods.max(axis=(1, 2, 3))
        weighted = self._presumed() * np.exp(likelihoods - top[:, None, None, None])
        return np.asarray(top + np.log(weighted.sum(axis=(1, 2, 3))))

    def _presumed(self) -> Floats:
        """Return the prior (Q, D, L) of the nuisance parameters at the next registration."""
        step = np.exp(-0.5 * ((KEPT[:, None] - KEPT) / _SPREAD) ** 2)  # of one share q to another
        spread = np.einsum("qr,qdl->rdl", step / step.sum(axis=1, keepdims=True), self._known)
        spread = (1.0 - _ANOTHER) * spread + _ANOTHER * spread.mean(axis=(1, 2), keepdims=True)
        return np.asarray((1.0 - _CHANGED) * spread + _CHANGED / np.prod(NUISANCES))
