"""Background: shares of a scan that this map explains by chance, measured at wrong places.

All scored places but those around the leader are chance places. Their mean shares are an observation's value at a wrong
place, as much as 0.4 in a yard of equal boxes. Their scatter gives the number of independent observations in a scan:
neighbouring points fall and rise together, and so do the scans of successive keyframes. A search has hundreds of wrong
places; tracking has one place, so its background is measured in rings around it (:func:`observe_with_background`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.distributions import normal_quantile
from coview_stream.localization.evidence.observation import ObservedScan, Share

# prior, set by hand
_PSEUDO = 6.0  # chance places that it counts as
_PSEUDO_SHARES = (0.12, 0.12, 0.16, 0.6)  # on, near, under edges, unexplained
_PSEUDO_NUMBER = 3.0  # independent observations
_MOST = 100.0  # independent observations of a scan: on a bare field chance places hardly scatter
_COVERED = 0.05  # least covered share of a scan by which other shares are divided
_TAIL = (84.0, 95.0, 99.0)  # percentiles
_MANY = 20  # places from which the second largest share is meaningful
_CALIBRATED = 1.75
"""Factor on the number of independent observations by the scatter: searches on maps of other sites then state an error
below e in less than a share e of them (``python -m bench.integrity.calibrate``)."""
OPEN = 0.01
"""Share of places that are as clear of structure and as level as the right one, presumed: open roads."""
_RINGS, _SPOKES = (3.0, 5.0, 8.0, 12.0), 8  # metres from the pose, and places on each ring
_TURNS = tuple(np.radians((-12.0, -4.0, 4.0, 12.0)))  # of the heading there, in turn
_PASSED = (0.003, 0.5)  # range of the share of free points that lie on structure


@dataclass(frozen=True)
class Most:
    """Upper limits of the number of independent observations."""

    structure: float = np.inf  # patches of structure in a scan
    free: float = np.inf  # cubes of free space in a scan
    scans: float = 1.0  # number of scans with different surroundings; 1 where all keyframes see the same


@dataclass(frozen=True)
class Background:
    """Shares at chance places, and the number of independent observations in a scan.

    Attributes:
        structure: (4,) probabilities that a covered structure point is on map structure, only near it, under an edge,
            unexplained.
        passed: probability that a free point lies on map structure.
        ground: parameters of the Beta distribution, over places, of the ground's share on the map's ground.
        number: effective numbers of independent structure points and of free points.
        open: probability that a chance place is as clear and level as the right one; (Q, L) by the nuisances' values.
    """

    structure: Floats
    passed: float
    ground: tuple[float, float]
    number: tuple[float, float]
    open: float | Floats = OPEN


def outcomes(observed: Floats32) -> Floats:
    """Return the shares (P, 4) of the structure's outcomes in observations (P, 7): on, near, edge, unexplained."""
    on, near, edge, covered = (observed[:, k].astype(np.float64) for k in range(4))
    return np.column_stack([on, near - on, edge, np.maximum(covered - near - edge, 0.0)])


def scatter(observed: Floats32) -> Floats:
    """Return the variances (4,) of chance places' shares: on, near, explained, passed.

    They belong to the narrowest normal distribution that covers the tail towards the shares of a right place, at one,
    two and about three standard deviations and at the second largest share. The tail is often wider than the middle,
    where a few places are of another kind than the rest.
    """
    if len(observed) < 2:
        return np.full(4, np.nan)
    return _scatter(_compared(observed))


def _scatter(shares: Floats) -> Floats:
    """Return :func:`scatter` of each column of shares (P, C)."""
    count = len(shares)
    shares = np.sort(shares, axis=0)
    levels = np.percentile(shares, (50.0, *_TAIL), axis=0)
    reach = (levels[1:] - levels[0]) / np.array([normal_quantile(percent / 100.0) for percent in _TAIL])[:, None]
    if count >= _MANY:  # the second largest, by Blom's plotting position; the largest may be a twin of the right place
        last = (shares[-2] - levels[0]) / normal_quantile((count - 1.375) / (count + 0.25))
        reach = np.vstack([reach, last])
    return np.asarray(np.maximum(reach.max(axis=0), 1e-3) ** 2)


def left_in_mean(observed: Floats32) -> Floats:
    """Return ratios (4,) of the variance of the mean over keyframes to the mean variance (max of bulk and tail).

    ``observed`` (N, W, 7) has W keyframes at the same chance places. Keyframes see much of the same surroundings, so a
    place that fits by chance goes on to fit: at 1 all keyframes see the same.
    """
    count, width = observed.shape[:2]
    if count < _MANY or width < 2:
        return np.ones(4)
    shares = _compared(observed)
    whole = shares.mean(axis=1).var(axis=0) / np.maximum(shares.var(axis=0).mean(axis=0), 1e-9)
    single = _scatter(shares.reshape(count, -1)).reshape(width, -1).mean(axis=0)
    return np.asarray(np.clip(np.maximum(whole, scatter(observed.mean(axis=1)) / single), 1.0 / width, 1.0))


def _compared(observed: Floats32) -> Floats:
    """Return the compared shares (..., 4) of observations (..., 7)."""
    covered = np.maximum(observed[..., Share.COVERED], _COVERED)
    near = observed[..., Share.NEAR]
    shares = observed[..., Share.ON] / covered, near / covered, (near + observed[..., Share.EDGE]) / covered
    return np.stack([*shares, -observed[..., Share.PASSED]], axis=-1).astype(np.float64)


def estimate_background(now: Floats32, variance: Floats, followed: Floats32, most: Most | None = None) -> Background:
    """Estimate the background from chance places.

    Args:
        now: (N, 7) the newest keyframe's observations there.
        variance: (4,) mean of :func:`scatter` over the keyframes so far.
        followed: (K, 7) mean observations over the keyframes at the followed ones.
        most: limits of the number of independent observations.
    """
    most = most or Most()
    counts = outcomes(now)
    total = counts.sum(axis=0) + _PSEUDO * np.array(_PSEUDO_SHARES)
    structure = total / total.sum()
    passed = float(np.clip(now[:, Share.PASSED].mean(), *_PASSED)) if len(now) else 0.05
    chance = np.append(np.cumsum(structure[:3]), passed)
    chance = chance * (1.0 - chance)
    count = np.where(np.isfinite(variance), len(now), 0)
    measured = np.where(np.isfinite(variance), variance, 0.0)
    presumed = chance / _PSEUDO_NUMBER
    number = _CALIBRATED * chance / ((count * measured + _PSEUDO * presumed) / (count + _PSEUDO))
    high = float(3.0 / (1.0 / number[:3]).sum())
    both = min(high, most.scans * min(_MOST, most.structure)), min(float(number[3]), most.scans * most.free)
    # a Beta distribution by mean and variance of the ground's shares
    ground = np.concatenate([now, followed])
    shares = np.clip(ground[:, Share.GROUND] / np.maximum(ground[:, Share.COVERED_GROUND], _COVERED), 0.0, 1.0)
    shares = np.concatenate([shares, np.linspace(0.0, 1.0, round(_PSEUDO))])
    mean = float(np.clip(shares.mean(), 0.02, 0.98))
    spread = float(np.clip(shares.var(), 1e-4, 0.9 * mean * (1.0 - mean)))
    size = mean * (1.0 - mean) / spread - 1.0
    return Background(structure, passed, (max(mean * size, 0.3), max((1.0 - mean) * size, 0.3)), both)


def observe_with_background(
    field: kernels.FieldMap, scan: ObservedScan, T_map_odom: Floats
) -> tuple[Floats32, Background]:
    """Return observations (P, 7) of the map from poses (P, 4, 4), and the background around the first."""
    poses = scan.poses(T_map_odom)
    observed = scan.few.look_up(field, np.concatenate([poses, chance_places(poses[0])]), kernels.Move.NONE).shares
    places, chance = observed[: len(poses)], observed[len(poses) :]
    return places, estimate_background(chance, scatter(chance), chance[:0], Most(*scan.patches))


def chance_places(pose: Floats) -> Floats:
    """Return poses (H, 4), x, y, z and heading, in rings around a pose (4,), turned a little."""
    ring, spoke = (index.ravel() for index in np.indices((len(_RINGS), _SPOKES)))
    angle = 2.0 * np.pi * (spoke + 0.5 * (ring % 2)) / _SPOKES
    radius, turn = np.take(_RINGS, ring), np.take(_TURNS, (ring + spoke) % len(_TURNS))
    zero = np.zeros_like(radius)
    return np.asarray(pose + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), zero, turn]))
