"""Crops of the map around a place, prepared for registration."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

import coview_kernels as kernels
from coview_kernels.cells import Cells
from coview_stream.basemap.tiles import cut_points
from coview_stream.config import RegistrationMethod
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, norms

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.localization.registration.gicp import Surfaces


_MAX_CROPS = 12  # cached
_CROP_STEP = 16.0  # metres between the centres of cached crops


@dataclass(frozen=True)
class LocalMap:
    """A crop of the base map; its search structures are made at first use."""

    points: Points  # (K, 3) map frame, metres
    normals: Points  # (K, 3) normals, as long as the planarity around each point: 1 on a surface, 0 in scatter
    cells: Cells | None = None  # the points' order by cell, if they have been sorted

    @cached_property
    def grid(self) -> kernels.PointGrid:
        """The points for :func:`coview_kernels.nearest`."""
        if self.cells is None:
            return kernels.PointGrid(self.points)
        return kernels.PointGrid.sorted(self.points, self.cells)

    def planes(self, rows: Ints) -> tuple[Floats32, Floats32]:
        """Return the unit normals (N, 3) of points by their rows, and the planarity (N,) around each in [0, 1]."""
        normals = self.normals[rows]
        length = norms(normals)
        unit = np.asarray(normals / np.maximum(length, np.float32(1e-6))[:, None], dtype=np.float32)
        return unit, np.minimum(length, np.float32(1.0))

    def prepare(self, method: RegistrationMethod = "trimmed-icp") -> None:
        """Make the search structures for registration by ``method`` now."""
        if "grid" not in vars(self):
            kernels.nearest(self.grid, self.points[:1], 1.0)
        if method == "gicp":
            _ = self.surfaces

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """The points as GICP takes them; None where they are too few."""
        from coview_stream.localization.registration.gicp import surfaces

        return surfaces(self.points)


class LocalMaps:
    """Crops of a base map by place; the recently used ones are cached."""

    def __init__(self, base_map: BaseMap, radius: float, crops: int = _MAX_CROPS) -> None:
        self._map = base_map
        self._radius = radius
        self._max_crops = crops
        self._crops: OrderedDict[tuple[int, int], LocalMap | None] = OrderedDict()

    def around(self, position: Floats) -> LocalMap | None:
        """Return the map within at least ``radius`` metres of ``position`` (3,); None if it is (nearly) empty there."""
        key = (round(position[0] / _CROP_STEP), round(position[1] / _CROP_STEP))
        if key not in self._crops:
            centre = np.array([key[0], key[1]]) * _CROP_STEP
            radius = self._radius + 0.75 * _CROP_STEP
            cut = kernels.Cut(float(centre[0]), float(centre[1]), radius)
            crop = cut_points(self._map.arrays, self._map.config.tile, cut)
            few = crop is None or len(crop.points) < MIN_PAIRS
            self._crops[key] = None if crop is None or few else LocalMap(*crop)
            if len(self._crops) > self._max_crops:
                self._crops.popitem(last=False)
        self._crops.move_to_end(key)
        return self._crops[key]
