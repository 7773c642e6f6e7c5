"""Where exactly, and how sure: registration and its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from coview_stream.config.checks import counts, fraction, positive, require

RegistrationMethod = Literal["trimmed-icp", "gicp"]


@dataclass(frozen=True)
class RegistrationConfig:
    """Trimmed ICP (eq. 13): point-to-plane, coarse to fine; or GICP, with the same schedule and settings.

    ``method`` is ``trimmed-icp`` or ``gicp``; the latter needs the extra of that name and is for tracking only, the
    search's hypotheses go through trimmed ICP (see :mod:`coview_stream.localization.registration.gicp`). ``residual_scale`` is trimmed
    ICP's alone. ``keep`` is the overlap; the paper keeps 60 %, 70 % converges faster here and as well. ``search`` and
    ``track`` list the largest correspondence distances of the successive scales. Points above the ground and points
    on it are trimmed apart, else the ground, which fits anywhere, pushes out the facades that fix the position (KITTI
    04: 0.25 m median error against 0.05 m). ``inflation`` scales the inverse Hessian's sigma, which is optimistic
    (points are not independent). A direction in which that leaves more than ``weak_from`` metres (an angle counts as
    what it moves at ``weak_lever`` metres) is one that the map hardly shows: its sigma is widened further, up to
    ``weak_sigma`` metres (see :func:`coview_stream.localization.registration.covariance.registration_covariance`). The ``shared`` sigmas are
    of the error that neighbouring registrations have in common (see
    :class:`coview_stream.localization.tracking.shared_error.SharedErrorModel`): a scanned map's points lie off its surfaces. Inflation,
    floors and shared sigmas are calibrated on simulated drives, seeds 5101 to 5110 of ``bench.tracking``; a real map's
    own error, against the ground truth that matters to you, comes on top.
    """

    method: RegistrationMethod = "trimmed-icp"
    keep: float = 0.7
    search: tuple[float, ...] = (3.0, 1.5, 0.8, 0.4)
    track: tuple[float, ...] = (0.8, 0.4)
    iterations: int = 15
    source_voxel: float = 0.5
    source_points: int = 5000
    source_range: float = 50.0
    residual_scale: float = 0.1
    inflation: float = 3.0
    sigma_floor: float = 0.002
    sigma_floor_angle: float = math.radians(0.004)
    shared: float = 1.3
    shared_position: float = 0.001
    shared_height: float = 0.001
    shared_tilt: float = math.radians(0.03)
    shared_yaw: float = math.radians(0.001)
    gravity_sigma: float = math.radians(1.0)
    weak_lever: float = 10.0
    weak_from: float = 0.05
    weak_sigma: float = 10.0

    def __post_init__(self) -> None:
        methods = get_args(RegistrationMethod)
        require(self.method in methods, self, "method", f"one of {', '.join(methods)}")
        fraction(self, "keep")
        counts(self, "iterations", "source_points")
        positive(self, "weak_lever", "weak_from", "weak_sigma")
        positive(self, "source_voxel", "source_range", "residual_scale", "inflation", "gravity_sigma")
        positive(self, "sigma_floor", "sigma_floor_angle")
        positive(self, "shared", "shared_position", "shared_height", "shared_tilt", "shared_yaw")
        for name in ("search", "track"):
            steps = getattr(self, name)
            falling = bool(steps) and all(
                a >= b > 0 for a, b in zip(steps, (*steps[1:], steps[-1]), strict=True)
            )
            require(falling, self, name, "one or more positive distances, coarse to fine")
