"""Covariance of a registration: from its Hessian, without the prior, inflated; and carried along by a known motion.

Covariances and informations are (6, 6), radians and metres, along the map's axes, about the body. Their order is
(rx, ry, rz, x, y, z) unless a function says that it is the report's, (x, y, z, roll, pitch, yaw).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_stream.config import RegistrationConfig
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, boxminus, boxplus, skew

_ANGLES_FIRST = [3, 4, 5, 0, 1, 2]  # and back again
_MIN_SHARE = 0.01
"""Share of what is known of a direction; where the pairs have less, their minimum is noise. Set by hand."""


class Measured(NamedTuple):
    """A registration without its prior: what the map alone says of the pose."""

    T_map_body: Pose
    """(4, 4)."""
    information: Floats
    """(6, 6), positive semi-definite, before inflation."""


def swap_rotation_translation(covariance: Floats) -> Floats:
    """(6, 6) over (x, y, z, roll, pitch, yaw) as over (rx, ry, rz, x, y, z), or the other way round."""
    return np.asarray(covariance[np.ix_(_ANGLES_FIRST, _ANGLES_FIRST)])


def remove_prior(
    T_map_body: Pose, information: Floats, T_map_prior: Pose, prior_information: Floats, config: RegistrationConfig
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
        prior_information: (6, 6) as in :class:`coview_stream.localization.registration.result.Prior`.
        config: the one that the registration had.

    Returns:
        Pose and information of the measurement alone, to be given to :func:`registration_covariance`.

    Raises:
        InputError: ``information`` is not finite, or leaves a direction open in spite of the prior.
    """
    prior_part = np.asarray(prior_information) * config.inflation**2
    pairs_part = information - prior_part
    if not np.isfinite(information).all():
        raise InputError("the registration's information is not finite")
    try:
        L = np.linalg.cholesky(0.5 * (information + information.T))
        half = np.linalg.inv(L)
    except np.linalg.LinAlgError as error:
        raise InputError("the registration's information is not positive definite") from error
    # in units of what is known with the prior, what the pairs know of a direction is a share in [0, 1]
    share, directions = np.linalg.eigh(half @ (0.5 * (pairs_part + pairs_part.T)) @ half.T)
    share = np.clip(share, 0.0, 1.0)
    back, spread = L @ directions, half.T @ directions
    pull = prior_part @ boxminus(T_map_body, T_map_prior)
    step = spread @ (share / (share**2 + _MIN_SHARE**2) * (spread.T @ pull))
    return Measured(boxplus(T_map_body, step), np.asarray((back * share) @ back.T))


def registration_covariance(information: Floats, config: RegistrationConfig) -> Floats:
    """Return a registration's covariance from its Hessian: inflated, widened where the map shows little, and floored.

    The inverse Hessian is optimistic, as points next to each other are not independent: its sigma is multiplied by
    ``inflation``. Where the map hardly shows a direction (along a tunnel, on a bare field) what there is of a Hessian
    comes from noise in the normals, so that its sigma means little. In units that compare, metres and metres at a lever
    arm of ``weak_lever``, a direction's sigma s becomes s sqrt(1 + (s / w)^2), w = ``weak_from``: well below w nothing
    happens, far above it the sigma grows with its square, up to ``weak_sigma``, which also stands for no information
    at all. At last ``sigma_floor`` and ``sigma_floor_angle`` are added.

    Args:
        information: (6, 6) of the pairs alone: no prior in it (see :func:`remove_prior`), before inflation.
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
    weak = config.weak_from**2
    variance = np.minimum(variance * (1.0 + variance / weak), widest)
    spread = unit[:, None] * directions
    floor = np.array([config.sigma_floor_angle] * 3 + [config.sigma_floor] * 3) ** 2
    return np.asarray((spread * variance) @ spread.T + np.diag(floor))


def propagate(covariance: Floats, shift: Floats) -> Floats:
    """Return a covariance (6, 6) after a known motion by ``shift`` (3,), metres along the map's axes.

    An error r in the heading at its beginning is one in the place s at its end: s' = s + r x shift.
    """
    J = np.eye(6)
    J[3:, :3] = -skew(shift)
    return np.asarray(J @ covariance @ J.T)
