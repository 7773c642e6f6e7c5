"""Registration of a local scan to the base map, coarse to fine: trimmed point-to-plane ICP (eq. 13), or GICP."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig, RegistrationMethod
from coview_stream.geometry import Points, Pose
from coview_stream.pose.edges import EdgeRaster, edge_raster
from coview_stream.pose.tangent import Matrix6

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.pose.gicp import Surfaces

_CACHED_CROPS = 12
_CROP_STEP = 16.0  # metres between the centres of cached crops
_STOP_SHIFT = 2e-3  # metres; below the map's own noise, and the next step would be a third of it
_STOP_TURN = 1e-4  # radians
_COARSE_SHIFT = 0.06  # of a scale that another one follows; a finer stop there changes no error
_COARSE_TURN = 3e-3  # radians per metre of such a scale
LEAST_PAIRS = 50
_WIDTH_SHARE = 0.33  # of a scale, width of its weights: narrow ones from the start hold a wrong pose fast


@dataclass(frozen=True)
class LocalMap:
    """A crop of the base map: points and unit normals (K, 3), map frame, metres; the rest is made when asked for."""

    points: Points
    normals: Points

    @cached_property
    def grid(self) -> kernels.PointGrid:
        """The points, to be searched by :func:`coview_kernels.nearest`."""
        return kernels.PointGrid(self.points)

    def prepare(self, method: RegistrationMethod = "trimmed-icp") -> None:
        """Make now what a registration by ``method`` would make when it asks for it."""
        _ = self.edges, self._sorted
        if method == "gicp":
            _ = self.surfaces

    @cached_property
    def _sorted(self) -> bool:
        kernels.nearest(self.grid, self.points[:1], 1.0)
        return True

    @cached_property
    def edges(self) -> EdgeRaster:
        """Where the map must have walls that it does not show."""
        return edge_raster(self.points)

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """The points as GICP takes them; None where they are too few."""
        from coview_stream.pose.gicp import surfaces

        return surfaces(self.points)


class LocalMaps:
    """Crops of a base map by place, the recently used ones kept."""

    def __init__(self, base_map: BaseMap, radius: float, crops: int = _CACHED_CROPS) -> None:
        self._map = base_map
        self._radius = radius
        self._most = crops
        self._crops: OrderedDict[tuple[int, int], LocalMap | None] = OrderedDict()

    def around(self, position: npt.NDArray[np.float64]) -> LocalMap | None:
        """Return the map within at least ``radius`` metres of ``position`` (3,); None if it is (nearly) empty there."""
        key = (round(position[0] / _CROP_STEP), round(position[1] / _CROP_STEP))
        if key not in self._crops:
            centre = np.array([key[0], key[1]]) * _CROP_STEP
            points, normals = self._map.crop(centre, self._radius + 0.75 * _CROP_STEP)
            enough = len(points) >= LEAST_PAIRS
            self._crops[key] = LocalMap(points, normals) if enough else None
            if len(self._crops) > self._most:
                self._crops.popitem(last=False)
        self._crops.move_to_end(key)
        return self._crops[key]


@dataclass(frozen=True)
class Prior:
    """A Gaussian belief about the pose: mean (4, 4) and information (6, 6) over (rx, ry, rz, x, y, z).

    The tangent is a rotation about the body's position, then a shift, both along the map's axes.
    """

    T_map_source: Pose
    information: Matrix6


@dataclass(frozen=True)
class Registration:
    """What a registration found, with its evidence.

    Attributes:
        T_map_source: (4, 4) float64.
        information: (6, 6) over (rx, ry, rz, x, y, z) about ``centre``, the prior included, before inflation.
        rmse: root mean square of the kept point-to-plane residuals, metres.
        pairs: how many pairs were kept at the last iteration.
        iterations: over all scales.
        converged: the last step was below 2 mm and 0.006 degrees.
    """

    T_map_source: Pose
    information: Matrix6
    rmse: float
    pairs: int
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Source:
    """Points (N, 3) float32 of a local scan, which of them stand above the ground, and how high (metres)."""

    points: Points
    above: npt.NDArray[np.bool_]
    height: npt.NDArray[np.float32]

    def every(self, nth: int) -> Source:
        """Return a thinner scan: every ``nth`` point of each kind."""
        order = np.concatenate((np.flatnonzero(self.above), np.flatnonzero(~self.above)))[::nth]
        return Source(self.points[order], self.above[order], self.height[order])

    @cached_property
    def surfaces(self) -> list[Surfaces]:
        """The points above the ground and those on it as GICP takes them, what there is of them."""
        from coview_stream.pose.gicp import surfaces

        kinds = [surfaces(self.points[some]) for some in (self.above, ~self.above)]
        return [kind for kind in kinds if kind is not None]


def register(
    source: Source,
    T_map_source: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    scales: tuple[float, ...],
    prior: Prior | None = None,
    centre: npt.NDArray[np.float64] | None = None,
    iterations: int | None = None,
) -> Registration | None:
    """Trimmed ICP or GICP, as ``config.method`` says, from an initial pose.

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
    # the pairs count correlated points; weigh the prior alike
    belief = None
    if prior is not None:
        belief = kernels.Belief(prior.T_map_source, prior.information * config.inflation**2)
    if config.method == "gicp":
        return _by_gicp(
            source, T_map_source, target, config, _stages(scales, config), belief, pivot, iterations
        )
    found = kernels.align_planes(
        target.grid,
        target.normals,
        source.points,
        source.above,
        T_map_source,
        pivot,
        _stages(scales, config),
        keep=config.keep,
        iterations=iterations or config.iterations,
        min_pairs=LEAST_PAIRS,
        prior=belief,
    )
    return None if found is None else Registration(*found)


def _by_gicp(
    source: Source,
    T_map_source: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    stages: list[kernels.Scale],
    belief: kernels.Belief | None,
    pivot: npt.NDArray[np.float64],
    iterations: int | None,
) -> Registration | None:
    from coview_stream.pose.gicp import register_surfaces

    if target.surfaces is None:
        return None
    return register_surfaces(
        source.surfaces,
        target.surfaces,
        target.grid,
        target.normals,
        T_map_source,
        pivot,
        stages,
        keep=config.keep,
        iterations=iterations or config.iterations,
        prior=belief,
    )


def _stages(scales: tuple[float, ...], config: RegistrationConfig) -> list[kernels.Scale]:
    """Return the scales as the kernel takes them; all but the last end early, as the next one goes on from there."""
    last = len(scales) - 1
    return [
        kernels.Scale(
            scale,
            max(config.residual_scale, _WIDTH_SHARE * scale),
            _STOP_SHIFT if k == last else max(_STOP_SHIFT, _COARSE_SHIFT * scale),
            _STOP_TURN if k == last else max(_STOP_TURN, _COARSE_TURN * scale),
        )
        for k, scale in enumerate(scales)
    ]
