"""Registration of a scan to the map, coarse to fine: trimmed point-to-plane ICP (eq. 13), or GICP; its covariance.

Covariances and informations are (6, 6), radians and metres, along the map's axes, about the body. Their order is
(rx, ry, rz, x, y, z) unless a function says that it is the report's, (x, y, z, roll, pitch, yaw).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, boxminus, boxplus, skew
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud

_ANGLES_FIRST = [3, 4, 5, 0, 1, 2]  # and back again
_MIN_SHARE = 0.01  # of the knowledge of a direction; where the pairs have less, their minimum is noise
_STOP_SHIFT = 2e-3  # metres; below the map's own noise, and the next step would be a third of it
_STOP_TURN = 1e-4  # radians
_COARSE_SHIFT = 0.06  # of a scale that another one follows; a finer stop there changes no error
_COARSE_TURN = 3e-3  # radians per metre of such a scale
_COARSE_POINTS = 1500  # take part in a scale that another one follows, or up to twice as many; more change no result
_WIDTH_SHARE = 0.33  # of a scale, width of its weights: narrow ones from the start hold a wrong pose fast


@dataclass(frozen=True)
class Prior:
    """A Gaussian belief about a pose.

    Attributes:
        T_map_source: (4, 4) mean.
        information: (6, 6) over (rx, ry, rz, x, y, z): a turn about the body's position, then a shift, both along the
            map's axes; radians and metres.
    """

    T_map_source: Pose
    information: Floats


@dataclass(frozen=True)
class Registration:
    """Pose that a registration found, and how it fits.

    Attributes:
        T_map_source: (4, 4) float64.
        information: (6, 6) as of a :class:`Prior`, that prior included, before inflation.
        rmse: root mean square of the kept point-to-plane residuals, metres.
        pairs: how many pairs were kept at the last iteration.
        iterations: over all scales.
        converged: the last step was below 2 mm and 0.006 degrees.
    """

    T_map_source: Pose
    information: Floats
    rmse: float
    pairs: int
    iterations: int
    converged: bool


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
    """Register a scan by trimmed ICP (eq. 13) or GICP, as ``config.method`` says, from an initial pose.

    Args:
        source: the local scan.
        T_map_source: (4, 4) initial guess.
        target: the map around it.
        config: method, overlap, residual scale, iterations.
        scales: largest correspondence distance of each scale, metres.
        prior: belief to fuse; its mean is about ``centre`` too.
        centre: (3,) source-frame point that rotations are about (the body's position); default the mean.
        iterations: at most this many on each scale; default the configuration's.

    Returns:
        The result, or None where fewer than 50 points find a partner.

    Raises:
        DependencyError: the method is GICP and small_gicp is missing.
    """
    pivot = source.points.mean(axis=0, dtype=np.float64) if centre is None else centre
    belief = None
    if prior is not None:  # the pairs are believed too much by inflation^2, so the prior is, too
        belief = kernels.Belief(prior.T_map_source, prior.information * config.inflation**2)
    steps = iterations or config.iterations
    if config.method == "gicp":
        from coview_stream.localization.registration.gicp import register_surfaces

        if target.surfaces is None:
            return None
        alignment = register_surfaces(
            source.surfaces, target.surfaces, target.grid, target.normals, T_map_source, pivot,
            _kernel_scales(scales, config, 1), keep=config.keep, iterations=steps, prior=belief,
        )  # fmt: skip
    else:
        stride = max(1, len(source.points) // _COARSE_POINTS)
        alignment = kernels.align_planes(
            target.grid, target.normals, source.points, source.above, T_map_source, pivot,
            _kernel_scales(scales, config, stride), keep=config.keep, iterations=steps, min_pairs=MIN_PAIRS,
            prior=belief,
        )  # fmt: skip
    return None if alignment is None else Registration(*alignment)


def _kernel_scales(scales: tuple[float, ...], config: RegistrationConfig, stride: int) -> list[kernels.Scale]:
    """Return the scales as the kernel takes them.

    All but the last end early and make do with one of ``every`` points, as the next one goes on from there.
    """
    last = len(scales) - 1
    return [
        kernels.Scale(
            scale,
            max(config.residual_scale, _WIDTH_SHARE * scale),
            _STOP_SHIFT if k == last else max(_STOP_SHIFT, _COARSE_SHIFT * scale),
            _STOP_TURN if k == last else max(_STOP_TURN, _COARSE_TURN * scale),
            1 if k == last else stride,
        )
        for k, scale in enumerate(scales)
    ]


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
        prior_information: (6, 6) as in :class:`Prior`.
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
