"""Background: shares of a scan that this map explains by chance, measured at wrong places.

All scored places except those around the leader are chance places. Their mean shares are the expectation at a wrong
place, up to 0.4 in a yard of equal boxes. Their scatter gives the number of independent observations in a scan:
neighbouring points agree or disagree together, and so do scans of successive keyframes. A search has hundreds of wrong
places; tracking has one place, so its background is measured in rings around it (:func:`observe_with_background`).

Wrong places differ: among trees or houses any scan fits better than on a field. So a search also observes the map
around each place, a few metres off and turned a little. Chance at a place is the map's chance, corrected by how the
shares around the place differ from those around others, and the scatter is measured about it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.distributions import normal_quantile
from coview_stream.localization.evidence.observation import ObservedScan, ScanPart, Share

# prior, set by hand
_PSEUDO = 6.0  # weight of the prior in chance places
_PSEUDO_SHARES = (0.12, 0.12, 0.16, 0.6)  # on, near, under edges, unexplained
_PSEUDO_NUMBER = 3.0  # independent observations
_MOST = 100.0  # most independent observations of a scan: on a bare field chance places hardly scatter
_LEAST_DEVIATION = 0.03  # in units of one point's sigma: a thousand independent points
_COVERED = 0.05  # least covered share of a scan by which other shares are divided
_TAIL = (84.0, 95.0, 99.0)  # percentiles
_MANY = 20  # least places for which the second largest share is meaningful
_CALIBRATED = 1.75
"""Factor on the number of independent observations that the scatter gives. With it, less than a share e of the searches
on maps of other sites state an error below e (``python -m bench.integrity.calibrate``)."""
OPEN = 0.01
"""Presumed share of places as clear of structure and as level as the right one: open roads."""
_RINGS, _SPOKES = (3.0, 5.0, 8.0, 12.0), 8  # metres from the pose, and places on each ring
_TURNS = tuple(np.radians((-12.0, -4.0, 4.0, 12.0)))  # of the heading at the places, alternating
_PASSED = (0.003, 0.5)  # range of the share of free points that lie on structure
NEARBY = slice(len(Share), len(Share) + 4)
"""Columns of a search's observation (15,): shares of the structure's outcomes around the place."""
NEARBY_VARIANCE = slice(NEARBY.stop, NEARBY.stop + 4)
"""Columns of a search's observation (15,): variances of these shares among the poses around the place."""


@dataclass(frozen=True)
class Most:
    """Upper limits on the number of independent observations."""

    structure: float = np.inf  # patches of structure in a scan
    free: float = np.inf  # cubes of free space in a scan
    scans: float = 1.0  # scans with different surroundings; 1 where all keyframes see the same


@dataclass(frozen=True)
class Background:
    """Shares at chance places, and the number of independent observations in a scan."""

    # (4,) probabilities that a covered structure point is on map structure, only near it, under an edge, unexplained
    structure: Floats
    passed: float  # probability that a free point lies on map structure
    # parameters of the Beta distribution, over places, of the share of the ground on the map's ground
    ground: tuple[float, float]
    number: tuple[float, float]  # effective numbers of independent structure points and of free points
    # probability that a chance place is as clear and level as the right one; (Q, L) by nuisance values
    open: float | Floats = OPEN
    around: Floats | None = None  # (4,) like structure, around chance places; None if not observed
    # (4,) variances among the neighbours of one place, in units of one point's
    within: Floats = field(default_factory=lambda: np.zeros(4))
    between: Floats = field(default_factory=lambda: np.zeros(4))  # (4,) variances of around from place to place

    def structure_at(self, observed: Floats32) -> Floats:
        """Return ``structure`` (P, 4) at places observed (P, 15), by the outcomes around each; (1, 4) without those."""
        return _structure_at(observed, self.structure, self.around)

    def relative_errors_at(self, observed: Floats32) -> tuple[Floats, Floats]:
        """Return two relative standard errors (P, 4) of :meth:`structure_at`.

        The first comes from the scatter among the poses around a place, which are few, or none if they lie outside the
        survey; the second from the scatter between places. Without ``around`` both are (1, 4) zeros.
        """
        if self.around is None:
            return np.zeros((1, 4)), np.zeros((1, 4))
        told = len(_NEIGHBOURS) * observed[:, NEARBY].astype(np.float64)
        count = told.sum(axis=1, keepdims=True) + 1.0  # all places count as one neighbour
        share = (told + self.around) / count
        own = self.within * share * (1.0 - share) * (count - 1.0)
        variance = np.log1p((own + self.between) / np.square(count * share))  # of a logarithm, as shares are positive
        part = own / np.maximum(own + self.between, 1e-12)
        return np.sqrt(part * variance), np.sqrt((1.0 - part) * variance)


def outcomes(observed: Floats32) -> Floats:
    """Return shares (P, 4) of the structure's outcomes in observations (P, 7 or 15): on, near, edge, unexplained."""
    on, near, edge, covered = observed[:, :4].T.astype(np.float64)
    return np.stack([on, near - on, edge, np.maximum(covered - near - edge, 0.0)], axis=1)


def observe_around(layers: kernels.FieldMap, part: ScanPart, poses: Floats) -> Floats32:
    """Return (P, 8): means of the four outcomes' shares at the neighbours of poses (P, 4), then their variances."""
    neighbours = (poses[:, None] + _NEIGHBOURS).reshape(-1, 4)
    shares = part.structure.look_up(layers, neighbours, kernels.Move.NONE).shares
    each = outcomes(shares).reshape(-1, len(_NEIGHBOURS), 4)
    return np.column_stack([each.mean(axis=1), each.var(axis=1, ddof=1)]).astype(np.float32)


def scatter(observed: Floats32) -> Floats:
    """Return the variances (4,) of chance places' shares (on, near, explained, passed), in units of one point's.

    They are those of the narrowest normal distribution that reaches as far towards the shares of a right place as
    chance places do, at their 84th, 95th and 99th percentiles and at the second largest share. The tail is often wider
    than the middle, where a few places are of another kind.
    """
    return _tail_variance(_deviations(observed))


def left_in_mean(observed: Floats32) -> Floats:
    """Return the share (4,) of the variance that the mean over keyframes keeps: of all places or the tail, if more.

    ``observed`` (N, W, 7 or 15) has W keyframes at the same chance places. Keyframes share most of their surroundings,
    so a place that fits by chance continues to fit: a share of 1 means that all keyframes see the same.
    """
    count, width = observed.shape[:2]
    if count < _MANY or width < 2:
        return np.ones(4)
    each = np.stack([_deviations(observed[:, k]) for k in range(width)])
    mean = each.mean(axis=0)
    whole = mean.var(axis=0) / np.maximum(each.var(axis=1).mean(axis=0), 1e-9)
    single = _tail_variance(each.transpose(1, 0, 2).reshape(count, -1)).reshape(width, -1).mean(axis=0)
    return np.asarray(np.clip(np.maximum(whole, _tail_variance(mean) / single), 1.0 / width, 1.0))


def _tail_variance(shares: Floats) -> Floats:
    """Return :func:`scatter` of each column of shares (N, C)."""
    count = len(shares)
    if count < 2:
        return np.full(shares.shape[1], np.nan)
    shares = np.sort(shares, axis=0)
    levels = np.percentile(shares, (50.0, *_TAIL), axis=0)
    reach = (levels[1:] - levels[0]) / np.array([normal_quantile(percent / 100.0) for percent in _TAIL])[:, None]
    if count >= _MANY:  # second largest, by Blom's plotting position; the largest may be a twin of the right place
        last = (shares[-2] - levels[0]) / normal_quantile((count - 1.375) / (count + 0.25))
        reach = np.vstack([reach, last])
    return np.asarray(np.maximum(reach.max(axis=0), _LEAST_DEVIATION) ** 2)


def _deviations(observed: Floats32) -> Floats:
    """Return the deviations (N, 4) of on, near, explained and passed from chance, in units of one point's sigma."""
    covered = np.maximum(observed[:, Share.COVERED], _COVERED)
    near = observed[:, Share.NEAR]
    structure = np.column_stack([observed[:, Share.ON], near, near + observed[:, Share.EDGE]]) / covered[:, None]
    expected = np.cumsum(_structure_at(observed, *_structure(observed)), axis=1)[:, :3]
    passed = _passed(observed)
    return np.column_stack(
        [
            (structure - expected) / np.sqrt(expected * (1.0 - expected)),
            (passed - observed[:, Share.PASSED]) / np.sqrt(passed * (1.0 - passed)),
        ]
    ).astype(np.float64)


def _structure(observed: Floats32) -> tuple[Floats, Floats | None]:
    """Return the outcomes (4,) of structure at chance places, and around them."""
    presumed = _PSEUDO * np.array(_PSEUDO_SHARES)
    chance = outcomes(observed).sum(axis=0) + presumed
    if observed.shape[1] == len(Share):
        return chance / chance.sum(), None
    around = observed[:, NEARBY].sum(axis=0, dtype=np.float64) + presumed
    return chance / chance.sum(), around / around.sum()


def _structure_at(observed: Floats32, chance: Floats, around: Floats | None) -> Floats:
    """Return the outcomes (P, 4) of structure by chance at places observed (P, 15); (1, 4) without ``around``."""
    if around is None:
        return chance[None]
    nearby = len(_NEIGHBOURS) * observed[:, NEARBY].astype(np.float64) + around  # all places count as one neighbour
    share = nearby * (chance / around)
    return np.asarray(share / share.sum(axis=1, keepdims=True))


def _passed(observed: Floats32) -> float:
    return float(np.clip(observed[:, Share.PASSED].mean(), *_PASSED)) if len(observed) else 0.05


def estimate_background(now: Floats32, variance: Floats, ground: Floats32, most: Most | None = None) -> Background:
    """Estimate the background from chance places.

    Args:
        now: (N, 7 or 15) the newest keyframe's observations there.
        variance: (4,) mean of :func:`scatter` over the keyframes so far.
        ground: (K, 7 or 15) observations at chance places, where possible out of sight of the right one.
        most: limits on the number of independent observations.
    """
    most = most or Most()
    structure, around = _structure(now)
    count = np.where(np.isfinite(variance), len(now), 0)
    measured = np.where(np.isfinite(variance), variance, 0.0)
    number = _CALIBRATED * (count + _PSEUDO) / (count * measured + _PSEUDO / _PSEUDO_NUMBER)
    high = float(3.0 / (1.0 / number[:3]).sum())
    both = min(high, most.scans * min(_MOST, most.structure)), min(float(number[3]), most.scans * most.free)
    # Beta distribution by the mean and variance of the ground's shares
    shares = np.clip(ground[:, Share.GROUND] / np.maximum(ground[:, Share.COVERED_GROUND], _COVERED), 0.0, 1.0)
    shares = np.concatenate([shares, np.linspace(0.0, 1.0, round(_PSEUDO))])
    mean = float(np.clip(shares.mean(), 0.02, 0.98))
    spread = float(np.clip(shares.var(), 1e-4, 0.9 * mean * (1.0 - mean)))
    size = mean * (1.0 - mean) / spread - 1.0
    level = max(mean * size, 0.3), max((1.0 - mean) * size, 0.3)
    background = Background(structure, _passed(now), level, both, around=around)
    if around is None or len(now) < 2:
        return background
    nearby = now[:, NEARBY].astype(np.float64)
    single = np.maximum((nearby * (1.0 - nearby)).mean(axis=0), around * (1.0 - around) / len(now))
    within = now[:, NEARBY_VARIANCE].mean(axis=0) / single
    return replace(background, within=within, between=nearby.var(axis=0))


def observe_with_background(
    field: kernels.FieldMap, scan: ObservedScan, T_map_odom: Floats
) -> tuple[Floats32, Background]:
    """Return a scan's observations (P, 7) at places ``T_map_odom`` (P, 4, 4), and the background around the first."""
    poses = scan.poses(T_map_odom)
    observed = scan.few.look_up(field, np.concatenate([poses, chance_places(poses[0])]), kernels.Move.NONE).shares
    places, chance = observed[: len(poses)], observed[len(poses) :]
    return places, estimate_background(chance, scatter(chance), chance, Most(*scan.patches))


def chance_places(pose: Floats) -> Floats:
    """Return poses (H, 4), x, y, z and heading, in rings around a pose (4,), turned a little."""
    ring, spoke = (index.ravel() for index in np.indices((len(_RINGS), _SPOKES)))
    angle = 2.0 * np.pi * (spoke + 0.5 * (ring % 2)) / _SPOKES
    radius, turn = np.take(_RINGS, ring), np.take(_TURNS, (ring + spoke) % len(_TURNS))
    zero = np.zeros_like(radius)
    return np.asarray(pose + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), zero, turn]))


_NEIGHBOURS = chance_places(np.zeros(4))[: 2 * _SPOKES]
"""Steps (16, 4) to the poses that measure chance at a place, 3 and 5 metres off."""
