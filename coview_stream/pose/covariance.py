"""How sure a measurement is: odometry by how far it has driven, a registration by its Hessian, less what it was told.

Covariances and informations are (6, 6), radians and metres, along the map's axes, about the body. Their order is
(rx, ry, rz, x, y, z) unless a function says that it is the report's, (x, y, z, roll, pitch, yaw).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_stream.config import RegistrationConfig, TrackingConfig
from coview_stream.errors import InputError
from coview_stream.geometry import Pose
from coview_stream.pose.tangent import Matrix6, difference, shifted

_ANGLES_FIRST = [3, 4, 5, 0, 1, 2]  # and back again
_LEAST_SHARE = 0.01  # of what is known of a direction: where the pairs have less, their minimum is guesswork
_LEAST_DRIVEN = 1e-3  # metres: standing still, a covariance of zero would be none


class Measured(NamedTuple):
    """What the map alone says of the pose."""

    T_map_body: Pose
    """(4, 4)."""
    information: Matrix6
    """(6, 6), positive semi-definite, before inflation."""


def angles_first(covariance: Matrix6) -> Matrix6:
    """(6, 6) over (x, y, z, roll, pitch, yaw) as over (rx, ry, rz, x, y, z), or the other way round."""
    return np.asarray(covariance[np.ix_(_ANGLES_FIRST, _ANGLES_FIRST)])


def drift_covariance(config: TrackingConfig, driven: float, turned: float) -> Matrix6:
    """Covariance (6, 6) over (x, y, z, roll, pitch, yaw) that odometry gathers in metres driven and radians turned."""
    rates = np.array(
        [*[config.position_drift] * 3, config.tilt_drift, config.tilt_drift, config.yaw_drift],
        dtype=np.float64,
    )
    variances = rates**2 * driven
    variances[5] += (config.turn_drift * turned) ** 2
    return np.diag(variances)


def odometry_covariance(distance: float, turn: float, config: TrackingConfig) -> Matrix6:
    """Covariance of a motion by odometry: a random walk with every metre driven, and yaw with every radian turned.

    Args:
        distance: metres driven; a millimetre at least is assumed, so that the answer has an inverse.
        turn: radians turned.
        config: the drifts.
    """
    return angles_first(drift_covariance(config, max(distance, _LEAST_DRIVEN), turn))


def without_prior(
    T_map_body: Pose,
    information: Matrix6,
    T_map_prior: Pose,
    prior_information: Matrix6,
    config: RegistrationConfig,
) -> Measured:
    """Take a prior out of a registration again, so that a graph that knows it already does not count it twice.

    Registration minimises |pairs|^2 + a |prior|^2 with a = inflation^2 (its pairs are believed too much by that factor,
    so the prior is, too), and its information is the sum A = H + a P. So H = A - a P. At the minimum both pull alike:
    the pairs' gradient there is -a P d, where d leads from the prior's mean to the minimum, and Gauss-Newton's model of
    the pairs alone has its own minimum H^-1 a P d further on. Directions of which the pairs know less than a hundredth
    stay about where the prior has them, with the little information that they have.

    Args:
        T_map_body: (4, 4) as registered; what was registered may be another frame's pose (``T_map_odom``), the
            rotation being about the body all the same.
        information: (6, 6) of the registration.
        T_map_prior: (4, 4) the prior's mean, of the same body.
        prior_information: (6, 6) as in :class:`coview_stream.pose.registration.Prior`.
        config: the one that the registration had.

    Returns:
        Pose and information of the measurement alone, to be given to :func:`registration_covariance`.
    """
    told = np.asarray(prior_information) * config.inflation**2
    alone = information - told
    L = np.linalg.cholesky(0.5 * (information + information.T))
    half = np.linalg.inv(L)
    # in units of what is known with the prior, what the pairs know of a direction is a share in [0, 1]
    share, directions = np.linalg.eigh(half @ (0.5 * (alone + alone.T)) @ half.T)
    share = np.clip(share, 0.0, 1.0)
    back, spread = L @ directions, half.T @ directions
    pull = told @ difference(T_map_body, T_map_prior)
    step = spread @ (share / (share**2 + _LEAST_SHARE**2) * (spread.T @ pull))
    return Measured(shifted(T_map_body, step), np.asarray((back * share) @ back.T))


def registration_covariance(information: Matrix6, config: RegistrationConfig) -> Matrix6:
    """Covariance of a registration from its Hessian: inflated, widened where the map shows little, and floored.

    The inverse Hessian is optimistic, as points next to each other are not independent: its sigma is multiplied by
    ``inflation``. Where the map hardly shows a direction (along a tunnel, on a bare field) what there is of a Hessian
    comes from noise in the normals, so that its sigma means little. In units that compare, metres and metres at a lever
    arm of ``weak_lever``, a direction's sigma s becomes s sqrt(1 + (s / w)^2), w = ``weak_floors`` *
    ``sigma_floor``: well below w nothing happens, far above it the sigma grows with its square, up to ``weak_sigma``,
    which also stands for none at all. At last ``sigma_floor`` and ``sigma_floor_angle`` are added: errors that all
    points share.

    Args:
        information: (6, 6) of the pairs alone: no prior in it (see :func:`without_prior`), before inflation.
        config: inflation, floors, and what counts as weak.

    Raises:
        InputError: ``information`` is not a finite (6, 6) matrix.
    """
    A = np.asarray(information, dtype=np.float64)
    if A.shape != (6, 6) or not np.isfinite(A).all():
        raise InputError(f"information has shape {A.shape} or is not finite; expected (6, 6)")
    unit = np.array([1.0 / config.weak_lever] * 3 + [1.0] * 3)  # radians that move by a metre, metres
    balanced = unit[:, None] * (0.5 * (A + A.T)) * unit / config.inflation**2
    strength, directions = np.linalg.eigh(balanced)
    widest = config.weak_sigma**2
    variance = 1.0 / np.maximum(strength, 1.0 / widest)
    weak = (config.weak_floors * config.sigma_floor) ** 2
    variance = np.minimum(variance * (1.0 + variance / weak), widest)
    spread = unit[:, None] * directions
    floor = np.array([config.sigma_floor_angle] * 3 + [config.sigma_floor] * 3) ** 2
    return np.asarray((spread * variance) @ spread.T + np.diag(floor))
