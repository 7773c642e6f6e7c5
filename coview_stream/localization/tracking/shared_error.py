"""The systematic error of registrations, which the next ones repeat: a fit is a compromise between map and scan.

The inverse Hessian is the covariance for independent residuals of one size, with fixed correspondences. But a part of
the map lies some centimetres off the others, a tree's crown looks different from above, a lidar's far rings lie too
high: all points of a sector pull together. And a point that is off finds another partner nearby, so a displaced fit
looks hardly worse: on a map of several passes the gradient grows less than with fixed correspondences.

So a clustered sandwich estimator is used: C = c H^-1 B H^-1. B is the sum, over the quadrants around the body, ground
and structure apart, of the outer products of their gradients, each a mean over the last metres, in which scanner noise
averages out and map error does not. H is the derivative of the whole gradient by the pose, with all correspondences
searched again. The fit uses up six of the eight gradients: c = 8 / (8 - 6).

The scatter of the gradients about this mean is a registration's own error, independent of the next one's. On a sparse
survey it is far larger than the inverse Hessian.
"""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud
from coview_stream.localization.registration.register import RESIDUAL_SCALE

FLOOR = np.array([*np.radians([0.001, 0.001, 0.001]), 0.001, 0.001, 0.001])
"""Sigmas (6,) over (rx, ry, rz, x, y, z), radians and metres, below which the error never falls."""

_VIEW = 5.0  # metres of driving with about the same view, over which gradients are averaged
_STEP = 2.0  # metres of driving between two updates
_EVERY = 2  # every second point is used: more change nothing
_MIN_PAIRS = 50
_SHIFT = 0.03  # least metres by which the pose is moved to search partners again: above scanner noise
_FARTHEST = 1.5 * RESIDUAL_SCALE  # metres, limit of that shift: farther off, weights fall faster than residuals grow
_LEVER = 17.0  # metres; at this lever arm a rotation moves points as far
_TURNS = (0.0, 0.25 * np.pi)  # radians: two cuts into quadrants, as a wall may lie along a cut
_SECTORS = 8  # four quadrants, ground and structure apart
_LEAST = 0.03  # least curvature of a direction relative to the others'; less is noise


class SharedErrorModel:
    """Running mean and scatter of the gradients by sector, and the covariances that follow from them.

    Attributes:
        repeats: number of registrations, spaced like the present one and the last, that count as one.
    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self.clear()

    def clear(self) -> None:
        """Forget all registrations of the previous place."""
        self._gradients = np.zeros((len(_TURNS), _SECTORS, 6))
        self._scatter = np.zeros((6, 6))  # of the gradients about their mean
        self._repeated = 1.0  # inverse of the number of registrations that the means are of
        self.repeats = 1.0
        self._curvature = np.zeros((6, 6))
        self._learned_at: float | None = None  # metres driven
        self._side = -1  # direction in which the pose is moved for the curvature, alternating

    @property
    def unknown(self) -> bool:
        """Whether nothing was learned yet."""
        return self._learned_at is None

    def learn(
        self, source: RegistrationCloud, T_map_source: Pose, target: LocalMap, pivot: Floats, travelled: float
    ) -> None:
        """Add a registration, ``travelled`` metres into the drive; other arguments as in :func:`disagreement`.

        One registration per two metres counts, as those between see the same. The next replaces a registration at -inf.
        """
        before = self._learned_at
        if before is not None and travelled - before < _STEP:
            return
        self._side = -self._side
        now = disagreement(source, T_map_source, target, pivot, self._config, self._side)
        if now is None:
            return
        share = 1.0 if before is None else 1.0 - np.exp((before - travelled) / _VIEW)
        change = now[0] - self._gradients
        self._scatter = (1.0 - share) * (self._scatter + share * _mean_outer(change))
        self._gradients += share * change
        self._repeated = share**2 + (1.0 - share) ** 2 * self._repeated
        self._curvature += share * (now[1] - self._curvature)
        self._learned_at = travelled

    @property
    def covariance(self) -> Floats:
        """(6, 6) over (rx, ry, rz, x, y, z), map axes: ``shared``^2 times the mean's sandwich, and the floor."""
        sandwich = np.zeros((6, 6))
        if self._learned_at is not None:
            sandwich = clustered_covariance(self._gradients, self._curvature)
        return np.asarray(self._config.shared**2 * sandwich + np.diag(FLOOR**2))

    @property
    def own(self) -> Floats:
        """(6, 6) likewise: the sandwich of the scatter about the mean, which the next registration does not repeat.

        The scatter of a single registration is unknown: all of its gradients count.
        """
        if self._learned_at is None:
            return np.zeros((6, 6))
        single = self._repeated == 1.0
        scatter = _mean_outer(self._gradients) if single else self._scatter / (1.0 - self._repeated)
        return self.repeats * _sandwich(scatter, self._curvature)


def clustered_covariance(gradients: Floats, curvature: Floats) -> Floats:
    """Return the sandwich (6, 6) of gradients (K, 8, 6), by K cuts into sectors, and the curvature (6, 6)."""
    return _sandwich(_mean_outer(gradients), curvature)


def _mean_outer(gradients: Floats) -> Floats:
    """Return the sum over the sectors, as a mean over the cuts, of the gradients' outer products (6, 6)."""
    return np.asarray(np.einsum("ksi,ksj->ij", gradients, gradients) / len(gradients))


def _sandwich(middle: Floats, curvature: Floats) -> Floats:
    diagonal = np.diag(curvature).reshape(2, 3)  # angles, shifts
    least = np.maximum(_LEAST * diagonal.max(axis=1, keepdims=True), 1e-12)  # a direction may lack ground
    unit = 1.0 / np.sqrt(np.maximum(diagonal, least)).ravel()
    strength, directions = np.linalg.eigh(unit[:, None] * curvature * unit)
    inverse = unit[:, None] * (directions / np.maximum(strength, _LEAST)) @ directions.T * unit
    return np.asarray(_SECTORS / (_SECTORS - 6) * inverse @ middle @ inverse)


def disagreement(
    source: RegistrationCloud,
    T_map_source: Pose,
    target: LocalMap,
    pivot: Floats,
    config: RegistrationConfig,
    side: int = 1,
) -> tuple[Floats, Floats] | None:
    """Return the gradients (2, 8, 6) of a registration by sector, and its curvature (6, 6); None for too few pairs.

    Both are over (rx, ry, rz, x, y, z); rotations are about ``pivot`` (3,) in the source's frame, along the map's axes.
    """
    source = source.every(_EVERY)
    reach, body = config.track[-1], transform(T_map_source, pivot[None])[0]
    moved = transform(T_map_source, source.points)
    distance, partner = kernels.nearest(target.grid, moved, reach)
    paired = distance < reach  # not trimmed, as the best pairs disagree least
    if paired.sum() < _MIN_PAIRS:
        return None
    shift = _disparity(moved, np.where(paired & source.above, partner, -1), target)
    # as in registration, a few points do not outweigh thousands
    few = len(source.points) // 10
    counts = [max(1, few, int((kind & paired).sum())) for kind in (source.above, ~source.above)]
    weight = np.where(source.above, 1.0 / counts[0], 1.0 / counts[1])  # equal weight of both kinds
    arm = (moved - body).astype(np.float32)
    gradient = _gradient(moved, arm, weight, target, reach)
    total, curvature = gradient.sum(axis=0), np.empty((6, 6))
    for axis, size in enumerate([side * shift / _LEVER] * 3 + [side * shift] * 3):
        unit = np.eye(3, dtype=np.float32)[axis % 3]
        step = np.float32(size) * (np.cross(unit, arm) if axis < 3 else unit)
        curvature[:, axis] = (_gradient(moved + step, arm, weight, target, reach).sum(axis=0) - total) / size
    angle = np.arctan2(arm[:, 1], arm[:, 0])
    sectors = [2 * (np.floor((angle - turn) / (0.5 * np.pi)).astype(np.int64) % 4) + source.above for turn in _TURNS]
    gradients = [[np.bincount(sector, column, _SECTORS) for column in gradient.T] for sector in sectors]
    return np.array(gradients).transpose(0, 2, 1), 0.5 * (curvature + curvature.T)


def _disparity(moved: Points, partner: Ints, target: LocalMap) -> float:
    """Return the median distance of points to their partners' planes, 0.03 to 0.15 m; ``partner`` (N,) is -1 for none.

    Partners change over about this distance: a wall of the map is as thick as its points are imprecise or sparse.
    """
    there = np.flatnonzero(partner >= 0)
    if len(there) < _MIN_PAIRS:
        return _SHIFT
    normal, _ = target.planes(partner[there])
    off = np.einsum("ij,ij->i", moved[there] - target.points[partner[there]], normal)
    return min(max(_SHIFT, float(np.median(np.abs(off)))), _FARTHEST)


def _gradient(moved: Points, arm: Points, weight: Floats, target: LocalMap, reach: float) -> Floats:
    """Return each point's part (N, 6) of the gradient, with its partner searched among the map's points.

    A point on a surface pulls along its normal, with Cauchy's weight; one without a surface in all directions.
    """
    distance, partner = kernels.nearest(target.grid, moved, reach)
    partner = np.where(distance < reach, partner, 0)
    gap, (normal, planarity) = moved - target.points[partner], target.planes(partner)
    residual = np.einsum("ij,ij->i", gap, normal)
    weight = np.where(distance < reach, weight, 0.0)
    flat = weight * planarity / (1.0 + (residual / RESIDUAL_SCALE) ** 2)
    loose = weight * (1.0 - planarity) / (kernels.SCATTER**2 + np.einsum("ij,ij->i", gap, gap) / RESIDUAL_SCALE**2)
    pull = (flat * residual)[:, None] * normal + loose[:, None] * gap
    return np.concatenate([np.cross(arm, pull), pull], axis=1).astype(np.float64)
