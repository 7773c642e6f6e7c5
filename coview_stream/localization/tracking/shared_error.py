"""Cluster-robust (sandwich) covariance of a registration: the error that neighbouring registrations share.

The inverse Hessian presumes independent residuals. But a wall that lies 3 cm off in the map pulls with all of its
points, and a tree's whole crown looks different from above. So pairs are gathered into clusters by place, and the
covariance is A^-1 B A^-1, with A the sum of J^T J over the pairs and B the sum over clusters of the outer products of
their gradients.
"""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, transform
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud
from coview_stream.localization.registration.register import RESIDUAL_SCALE

UNCLUSTERED = np.array([*np.radians([0.03, 0.03, 0.001]), 0.001, 0.001, 0.001])
"""Sigmas (6,) over (rx, ry, rz, x, y, z) of the shared error that the pairs do not show: radians, metres.

Calibrated on the simulated drives of ``python -m bench tracking --seeds 5100``.
"""

_CELL = 16.0  # metres: about a house, or a tree and its neighbours; 8 to 30 give similar results
_EVERY = 2  # of the points: more change nothing
_NEWEST_SHARE = 0.3  # of a new covariance in the running average
_MIN_CLUSTERS = 8  # more than the six unknowns


class SharedErrorModel:
    """Running average of the error that neighbouring registrations share: it does not average out over them."""

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self.clear()

    def clear(self) -> None:
        """Forget all registrations: the place is another."""
        self._clustered: Floats | None = None

    def learn(self, source: RegistrationCloud, T_map_source: Pose, target: LocalMap, pivot: Floats) -> None:
        """Add a verified registration; arguments are those of :func:`clustered_covariance`."""
        now = clustered_covariance(source, T_map_source, target, pivot, self._config)
        if now is not None:
            before = self._clustered
            self._clustered = now if before is None else before + _NEWEST_SHARE * (now - before)

    @property
    def covariance(self) -> Floats:
        """(6, 6) over (rx, ry, rz, x, y, z): ``shared`` times the clustered sigma, and other errors.

        The main one of these: odometry's roll and pitch tremble from frame to frame.
        """
        clustered = np.zeros((6, 6)) if self._clustered is None else self._clustered
        return np.asarray(self._config.shared**2 * clustered + np.diag(UNCLUSTERED**2))


def clustered_covariance(
    source: RegistrationCloud, T_map_source: Pose, target: LocalMap, pivot: Floats, config: RegistrationConfig
) -> Floats | None:
    """Return the covariance (6, 6) over (rx, ry, rz, x, y, z) of a registration; None for too few clusters.

    Rotations are about ``pivot`` (3,) in the source's frame, along the map's axes.
    """
    source = source.every(_EVERY)
    reach = config.track[-1]
    moved = transform(T_map_source, source.points)
    distance, partner = kernels.nearest(target.grid, moved, reach)
    weights, paired = np.zeros(len(distance)), distance < reach  # not trimmed: the best pairs disagree least
    for kind in (source.above, ~source.above):  # both kinds weigh the same
        weights[kind & paired] = 1.0 / max(1, int((kind & paired).sum()))
    chosen = np.flatnonzero(weights)
    gap, (n, planarity) = moved[chosen] - target.points[partner[chosen]], target.planes(partner[chosen])
    residual = np.einsum("ij,ij->i", gap, n).astype(np.float64)
    weight = weights[chosen] * planarity / (1.0 + (residual / RESIDUAL_SCALE) ** 2)
    arm = moved[chosen] - transform(T_map_source, pivot[None])[0].astype(np.float32)
    J = np.concatenate([np.cross(arm, n), n], axis=1).astype(np.float64)
    cell = np.floor(moved[chosen, :2] / _CELL).astype(np.int64)  # structure apart from ground
    cluster = np.unique((cell[:, 0] * 100_003 + cell[:, 1]) * 2 + source.above[chosen], return_inverse=True)[1]
    count = int(cluster.max()) + 1 if len(cluster) else 0
    if count < _MIN_CLUSTERS:
        return None
    gradient = J * (weight * residual)[:, None]
    A = (J * weight[:, None]).T @ J + 1e-6 * np.eye(6)
    loose = weights[chosen] * (1.0 - planarity)
    loose /= kernels.SCATTER**2 + np.einsum("ij,ij->i", gap, gap) / RESIDUAL_SCALE**2
    for axis in np.eye(3, dtype=np.float32):  # points without a surface constrain all three directions
        J = np.concatenate([np.cross(arm, axis), np.broadcast_to(axis, arm.shape)], axis=1).astype(np.float64)
        gradient += J * (loose * (gap @ axis))[:, None]
        A += (J * loose[:, None]).T @ J
    gradients = np.stack([np.bincount(cluster, column, count) for column in gradient.T], axis=1)
    inverse_A = np.linalg.inv(A)
    # the fit uses up six clusters
    return np.asarray(inverse_A @ (gradients.T @ gradients) @ inverse_A * count / (count - 6))
