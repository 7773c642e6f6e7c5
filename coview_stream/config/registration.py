"""Settings of registration and of its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from coview_stream.config.checks import all_positive, check_types, counts, fraction, require

RegistrationMethod = Literal["trimmed-icp", "gicp"]


@dataclass(frozen=True)
class RegistrationConfig:
    """Trimmed ICP (eq. 13): point-to-plane, coarse to fine; or GICP, with the same schedule and settings.

    Points above the ground and points on it are trimmed apart, else the ground, which fits anywhere, pushes out the
    facades that fix the position (seen once on KITTI 04, no command prints it: 0.25 m median error against 0.05 m).

    ``inflation``, the floors and the ``shared`` sigmas are calibrated on the simulated drives of
    ``python -m bench tracking --seeds 5100``, which prints how often the truth lies within 1, 2 and 3 sigma; a real
    map's own error, against the ground truth that matters to you, comes on top. The rest is set by hand.

    Attributes:
        method: ``trimmed-icp``, or ``gicp``, which needs the extra of that name and is for tracking only: the search
            registers its hypotheses by trimmed ICP (see :mod:`coview_stream.localization.registration.gicp`).
        keep: overlap, the share of the pairs that is kept; the paper keeps 0.6, 0.7 converges faster and as well.
        search: largest correspondence distances of the successive scales of a search, metres, coarse to fine.
        track: likewise while tracking.
        iterations: at most, on each scale. Half as many leave headings one degree off where odometry is three degrees
            off (``python -m bench conditions --conditions drift`` on three real runs).
        source_voxel: metres; one point of the scan is kept in each cube of this size.
        source_points: at most so many of them, chosen at random.
        source_range: metres from the sensor within which the scan's points are used.
        residual_scale: width of the Cauchy weights on the last scale, metres; of trimmed ICP alone.
        inflation: times the inverse Hessian's sigma, which is optimistic: neighbouring points are not independent.
        sigma_floor: metres, added to what registration claims of each position.
        sigma_floor_angle: radians, likewise of each angle.
        shared: times the clustered sigma of the error that neighbouring registrations have in common, as a scanned
            map's points lie off its surfaces
            (:class:`coview_stream.localization.tracking.shared_error.SharedErrorModel`).
        shared_position: metres of x and of y of that error which the pairs do not show.
        shared_height: metres of z, likewise.
        shared_tilt: radians of roll and of pitch, likewise.
        shared_yaw: radians of the heading, likewise.
        gravity_sigma: radians by which odometry's vertical may be off, each of roll and pitch; a prior of searches.
        weak_lever: metres; an angle is compared with a shift by what it moves at this distance.
        weak_from: metres; a direction that is known less well is one that the map hardly shows, and its sigma is
            widened (:func:`coview_stream.localization.registration.covariance.registration_covariance`).
        weak_sigma: metres, the largest sigma that this gives.
    """

    method: RegistrationMethod = "trimmed-icp"
    keep: float = 0.7
    search: tuple[float, ...] = (3.0, 1.5, 0.8, 0.4)
    track: tuple[float, ...] = (0.8, 0.4)
    iterations: int = 30
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
        check_types(self)
        methods = get_args(RegistrationMethod)
        require(self.method in methods, self, "method", f"one of {', '.join(methods)}")
        fraction(self, "keep")
        counts(self, "iterations", "source_points")
        all_positive(self, "method", "search", "track")
        for name in ("search", "track"):
            scales = getattr(self, name)
            falling = bool(scales) and all(a >= b > 0 for a, b in zip(scales, (*scales[1:], scales[-1]), strict=True))
            require(falling, self, name, "one or more positive distances, coarse to fine")
