"""Registration of a scan to the map, coarse to fine: trimmed point-to-plane ICP (eq. 13), or GICP."""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud
from coview_stream.localization.registration.result import MIN_PAIRS, Prior, Registration

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
