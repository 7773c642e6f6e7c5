"""Registration of a scan to the map, coarse to fine (trimmed point-to-plane ICP, eq. 13, or GICP), and verification.

:func:`register_and_verify` is what search and tracking call.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

import coview_kernels as kernels
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud
from coview_stream.localization.registration.result import MIN_PAIRS, Prior, Registration
from coview_stream.localization.registration.verification import Evidence, RangeImage, verify

# set by hand
_STOP_SHIFT = 2e-3  # metres; below the map's own noise, and the next step would be a third of it
_STOP_TURN = 1e-4  # radians
_COARSE_SHIFT = 0.06  # of a scale that another one follows; a finer stop there changes no error
_COARSE_TURN = 3e-3  # radians per metre of such a scale
_COARSE_POINTS = 1500  # take part in a scale that another one follows, or up to twice as many; more change no result
_WIDTH_SHARE = 0.33  # of a scale, width of its weights: narrow ones from the start hold a wrong pose fast


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
    if config.method == "gicp":
        return _register_by_gicp(
            source, T_map_source, target, config, _kernel_scales(scales, config, 1), belief, pivot, iterations
        )
    found = kernels.align_planes(
        target.grid,
        target.normals,
        source.points,
        source.above,
        T_map_source,
        pivot,
        _kernel_scales(scales, config, max(1, len(source.points) // _COARSE_POINTS)),
        keep=config.keep,
        iterations=iterations or config.iterations,
        min_pairs=MIN_PAIRS,
        prior=belief,
    )
    return None if found is None else Registration(*found)


def _register_by_gicp(
    source: RegistrationCloud,
    T_map_source: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    scales: list[kernels.Scale],
    belief: kernels.Belief | None,
    pivot: Floats,
    iterations: int | None,
) -> Registration | None:
    from coview_stream.localization.registration.gicp import register_surfaces

    if target.surfaces is None:
        return None
    return register_surfaces(
        source.surfaces,
        target.surfaces,
        target.grid,
        target.normals,
        T_map_source,
        pivot,
        scales,
        keep=config.keep,
        iterations=iterations or config.iterations,
        prior=belief,
    )


def _kernel_scales(scales: tuple[float, ...], config: RegistrationConfig, every: int) -> list[kernels.Scale]:
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
            1 if k == last else every,
        )
        for k, scale in enumerate(scales)
    ]


@dataclass(frozen=True)
class ScanInput:
    """A scan to be registered.

    Attributes:
        cloud: what is registered, odometry frame, metres.
        frame: (N, 3) float32 newest frame, body frame, metres: whose rays are held against the map.
        T_odom_body: (4, 4) odometry of that frame.
    """

    cloud: RegistrationCloud
    frame: Points
    T_odom_body: Pose

    @cached_property
    def range_image(self) -> RangeImage:
        """The newest frame by direction."""
        return RangeImage.of(self.frame)


@dataclass(frozen=True)
class ScanMatch:
    """A registration of a scan and, once it is asked for, its evidence.

    Attributes:
        registration: None where too few points found a partner.
        T_map_odom: (4, 4) as registered; where nothing was, the initial guess.
        scan: what was registered.
        target: the map around it.
        base_map: knows where it has been surveyed.
    """

    registration: Registration | None
    T_map_odom: Pose
    scan: ScanInput
    target: LocalMap
    base_map: BaseMap

    @cached_property
    def evidence(self) -> Evidence:
        """Shares of the scan that fit the map at ``T_map_odom``."""
        T, scan = self.T_map_odom, self.scan
        return verify(scan.cloud, T, scan.range_image, T @ scan.T_odom_body, self.target, self.base_map.survey)


def register_and_verify(
    base_map: BaseMap,
    scan: ScanInput,
    T_map_odom: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    scales: tuple[float, ...],
    prior: Prior,
    moving: RegistrationCloud | None = None,
    iterations: int | None = None,
) -> ScanMatch:
    """Register a scan from an initial guess (eq. 13); the result brings its evidence.

    Args:
        base_map: the map.
        scan: what to register and verify.
        T_map_odom: (4, 4) initial guess.
        target: the map around it.
        config: of the registration.
        scales: largest correspondence distance of each scale, metres.
        prior: belief that takes part in the registration.
        moving: points to register in place of all of the scan's, for coarse scales.
        iterations: at most this many on each scale; default the configuration's.

    Raises:
        DependencyError: the method is GICP and small_gicp is missing.
    """
    centre = scan.T_odom_body[:3, 3]
    cloud = scan.cloud if moving is None else moving
    found = register(cloud, T_map_odom, target, config, scales, prior, centre, iterations)
    T = T_map_odom if found is None else found.T_map_source
    return ScanMatch(found, T, scan, target, base_map)
