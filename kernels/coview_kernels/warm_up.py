"""Compilation of the kernels before they are needed: each takes a tenth of a second or more, from the cache too."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coview_kernels import runtime
from coview_kernels.covisibility import coview
from coview_kernels.evidence import Distances, Raster, Sight, match_points, match_rays, sort_beams
from coview_kernels.icp import Scale, align_planes
from coview_kernels.nearest import PointGrid, nearest
from coview_kernels.polar import describe_points, polar_bin, station_bins
from coview_kernels.voxel_filter import transform_unique

_CLOUD = np.ones((2, 3), dtype=np.float32)
_EYE, _ORIGIN, _ONE = np.eye(4), np.zeros(3), np.zeros(1, dtype=np.int32)


def _align() -> None:
    scales = [Scale(1.0, 1.0)]
    align_planes(
        *(PointGrid(_CLOUD), _CLOUD, _CLOUD, np.ones(2), _EYE, _ORIGIN, scales), keep=1.0, iterations=1, min_pairs=1
    )


def _match_points() -> None:
    raster = Raster(np.ones((1, 1), dtype=np.float32), np.zeros(2), 1.0)
    survey = raster._replace(values=np.ones((1, 1), dtype=np.uint8))
    match_points(PointGrid(_CLOUD), _CLOUD, _CLOUD, np.ones(2), _EYE, raster, survey, Distances(1.0, 1.0, 1.0, 1.0))


_SIGHT = Sight(1.0, 1.0, 1.0, 1.0, 1.0)
_CALLS: dict[str, Callable[[], object]] = {
    "align_planes": _align,
    "coview": lambda: coview(*np.ones((2, 100, 20, 60))),
    "describe_points": lambda: describe_points(_CLOUD, _ORIGIN, 2, 4, 8.0),
    "match_points": _match_points,
    "match_rays": lambda: match_rays(np.ones((2, _SIGHT.cells)), _CLOUD, _EYE, 0.0, _SIGHT),
    "nearest": lambda: nearest(PointGrid(_CLOUD), _CLOUD, 1.0),
    "polar_bin": lambda: polar_bin(_CLOUD, _ORIGIN, 2, 4, 8.0),
    "sort_beams": lambda: sort_beams(_CLOUD, _SIGHT),
    "station_bins": lambda: station_bins(np.ones((1, 1)), np.ones((1, 1)), 1.0, _ONE, _ONE, _ONE, 2, 4, 2.0),
    "transform_unique": lambda: transform_unique(_CLOUD, _EYE, 1.0),
}


def warm_up(*names: str) -> None:
    """Start the backend and compile kernels now rather than at first use.

    Args:
        names: of the public functions that will be called, all of them by default. ``transform_unique`` stands for
            :class:`coview_kernels.VoxelFilter` too.

    Raises:
        ValueError: a name is unknown.
    """
    if unknown := sorted(set(names) - set(_CALLS)):
        raise ValueError(f"no kernel {', '.join(unknown)}; there are {', '.join(_CALLS)}")
    if runtime.backend() == "numpy":
        return
    for name in names or _CALLS:
        _CALLS[name]()
