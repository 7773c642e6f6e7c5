"""Registration of a scan to the map, coarse to fine: trimmed point-to-plane ICP (eq. 13), and its covariance.

Covariances and information matrices are (6, 6) over (rx, ry, rz, x, y, z), radians and metres: a rotation about the
body, then a shift, along the map's axes.
"""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_kernels import Prior, Registration
from coview_stream.config import RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, boxminus, boxplus, skew
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud

RESIDUAL_SCALE = 0.1
"""Metres: width of the Cauchy weights on the last scale of trimmed ICP."""

# calibrated like RegistrationConfig.inflation on the simulated drives of `python -m bench tracking --seeds 5100`
SIGMA_FLOOR = np.array([np.radians(0.004)] * 3 + [0.002] * 3)
"""Sigmas (6,) over (rx, ry, rz, x, y, z) that are added to each registration: radians, metres."""
WEAK_FROM = 0.05
"""Metres: a direction with a larger sigma is poorly constrained by the map, and its sigma is widened."""
WEAK_SIGMA = 10.0
"""Metres: the sigma of a direction without any information."""
WEAK_LEVER = 10.0
"""Metres: an angle counts as its shift at this distance."""

_ANGLES_FIRST = [3, 4, 5, 0, 1, 2]  # and back again
_MIN_SHARE = 0.01  # least share of a direction's information; below it the minimum of the pairs is noise
_STOP_SHIFT = 2e-3  # metres: below the map's noise, and the next step would be a third of it
_STOP_TURN = 1e-4  # radians
# limits of a coarse scale's last step; a finer scale continues from there, with smaller steps, as its radius and
# trimming keep to near points. Four times as much left half of the runs a metre off where crowns pull slowly
_COARSE_SHIFT = 0.015  # metres per metre of the scale
_COARSE_TURN = 7.5e-4  # radians per metre of the scale
_COARSE_POINTS = 1500  # up to twice as many are used
_WIDTH_SHARE = 0.33  # width of the weights per metre of a scale: narrow ones keep a wrong initial pose


def register(
    source: RegistrationCloud,
    T_map_source: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    scales: tuple[float, ...],
    prior: Prior | None = None,
    centre: Floats | None = None,
    iterations: int | None = None,
) -> Registration | None:
    """Register a scan from an initial pose; None where fewer than 50 points find a partner.

    Args:
        source: the local scan.
        T_map_source: (4, 4) initial guess.
        target: the map around it.
        config: overlap, iterations, inflation.
        scales: largest correspondence distance of each scale, metres.
        prior: fused with the pairs; about ``centre``, before inflation.
        centre: (3,) centre of rotations in the source frame (the body's position); default the mean.
        iterations: limit per scale; default the configuration's.
    """
    pivot = source.points.mean(axis=0, dtype=np.float64) if centre is None else centre
    if prior is not None:  # the pairs' information is inflation^2 too large, so the prior's has to be
        prior = Prior(prior.T_map_source, prior.information * config.inflation**2)
    stride = max(1, len(source.points) // _COARSE_POINTS)
    last = len(scales) - 1
    steps = [
        kernels.Scale(
            scale,
            max(RESIDUAL_SCALE, _WIDTH_SHARE * scale),
            _STOP_SHIFT if k == last else max(_STOP_SHIFT, _COARSE_SHIFT * scale),
            _STOP_TURN if k == last else max(_STOP_TURN, _COARSE_TURN * scale),
            1 if k == last else stride,
            config.keep if k == last else 1.0,
        )
        for k, scale in enumerate(scales)
    ]
    return kernels.align_planes(
        target.grid, target.normals, source.points, source.above, T_map_source, pivot, steps,
        iterations=iterations or config.iterations, min_pairs=MIN_PAIRS, prior=prior,
    )  # fmt: skip


def gravity_information(sigma: float) -> Floats:
    """Information (6, 6) of "both frames are level to ``sigma`` radians"."""
    return np.diag([sigma**-2, sigma**-2, 0.0, 0.0, 0.0, 0.0])


def swap_rotation_translation(covariance: Floats) -> Floats:
    """Convert a covariance (6, 6) over (x, y, z, roll, pitch, yaw) to (rx, ry, rz, x, y, z), or back."""
    return np.asarray(covariance[np.ix_(_ANGLES_FIRST, _ANGLES_FIRST)])


def remove_prior(registration: Registration, prior: Prior, config: RegistrationConfig) -> tuple[Pose, Floats]:
    """Return pose and information of the pairs alone, for a graph that contains the prior already.

    Registration minimises |pairs|^2 + a |prior|^2 with a = inflation^2, and its information is A = H + a P, so
    H = A - a P. At the minimum the pairs' gradient is -a P d, with d from the prior's mean to the minimum, and
    Gauss-Newton's model of the pairs alone has its minimum H^-1 a P d further on. Directions with less than a hundredth
    of the information from the pairs stay near the prior's mean and keep that little information.

    Poses of registration and prior may be of another frame (``T_map_body`` for ``T_map_odom``), as rotations are about
    the body in any case. ``config`` is the registration's.

    Raises:
        InputError: the information is not finite, or leaves a direction unconstrained in spite of the prior.
    """
    total, prior_part = registration.information, prior.information * config.inflation**2
    pairs_part = total - prior_part
    if not np.isfinite(total).all():
        raise InputError("the registration's information is not finite")
    try:
        L = np.linalg.cholesky(0.5 * (total + total.T))
        half = np.linalg.inv(L)
    except np.linalg.LinAlgError as error:
        raise InputError("the registration's information is not positive definite") from error
    # in units of the total information, the pairs' information in a direction is a share in [0, 1]
    share, directions = np.linalg.eigh(half @ (0.5 * (pairs_part + pairs_part.T)) @ half.T)
    share = np.clip(share, 0.0, 1.0)
    back, spread = L @ directions, half.T @ directions
    pull = prior_part @ boxminus(registration.T_map_source, prior.T_map_source)
    step = spread @ (share / (share**2 + _MIN_SHARE**2) * (spread.T @ pull))
    return boxplus(registration.T_map_source, step), np.asarray((back * share) @ back.T)


def registration_covariance(information: Floats, config: RegistrationConfig) -> Floats:
    """Return a registration's covariance from its Hessian: inflated, widened in weak directions, with a floor.

    ``information`` (6, 6) is of the pairs alone (:func:`remove_prior`). Its inverse is optimistic, as neighbouring
    points are not independent: the sigma is multiplied by ``inflation``. Where the map hardly constrains a direction
    (along a tunnel, on a bare field) the Hessian comes from noise in the normals. In comparable units, metres and
    metres at a lever arm of ``WEAK_LEVER``, a direction's sigma s becomes s sqrt(1 + (s / w)^2), w = ``WEAK_FROM``: it
    stays the same well below w, and grows with its square far above, up to ``WEAK_SIGMA``, the sigma without any
    information. Finally ``SIGMA_FLOOR`` is added.

    Raises:
        InputError: ``information`` is not a finite (6, 6) matrix.
    """
    A = np.asarray(information, dtype=np.float64)
    if A.shape != (6, 6) or not np.isfinite(A).all():
        raise InputError(f"information has shape {A.shape} or is not finite; expected (6, 6)")
    unit = np.array([1.0 / WEAK_LEVER] * 3 + [1.0] * 3)  # radians per metre of shift, and metres
    balanced = unit[:, None] * (0.5 * (A + A.T)) * unit / config.inflation**2
    strength, directions = np.linalg.eigh(balanced)
    widest = WEAK_SIGMA**2
    variance = 1.0 / np.maximum(strength, 1.0 / widest)
    variance = np.minimum(variance * (1.0 + variance / WEAK_FROM**2), widest)
    spread = unit[:, None] * directions
    return np.asarray((spread * variance) @ spread.T + np.diag(SIGMA_FLOOR**2))


def propagate(covariance: Floats, shift: Floats) -> Floats:
    """Return a covariance (6, 6) after a known motion by ``shift`` (3,), metres along the map's axes.

    A rotation error r at the start gives the position error s' = s + r x shift at the end.
    """
    J = np.eye(6)
    J[3:, :3] = -skew(shift)
    return np.asarray(J @ covariance @ J.T)
