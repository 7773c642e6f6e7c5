"""The map around a place, with what registration and verification make of it.

Roof edges: an airborne scan shows roofs and few of the facades that a robot sees. But a facade stands under the edge of
a roof, so a point there is explained by the map though no map point is near it. Seen by hand on one simulated campus
(no command prints it) in whose map most facades are missing: at the right place 27-55 % of the structure has a map
point within 0.5 m, and 99-100 % has one or stands below an edge; at the best wrong places 6-22 % and 25-44 %.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

import coview_kernels as kernels
from coview_stream.basemap import likelihood_field
from coview_stream.config import RegistrationMethod
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, norms
from coview_stream.localization.registration.result import MIN_PAIRS

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.localization.registration.gicp import Surfaces

# set by hand
_MAX_CROPS = 12  # cached
_CROP_STEP = 16.0  # metres between the centres of cached crops
_SAMPLE_EVERY = 3  # of the points
_CELL = 0.5  # metres, of the raster of roof edges
_NOTHING = -1e6  # metres: height of a cell without points


@dataclass(frozen=True)
class LocalMap:
    """A crop of the base map; what registration and verification make of it is made when first asked for.

    Attributes:
        points: (K, 3) map frame, metres.
        normals: (K, 3) normals, as long as the planarity around each point: 1 on a surface, 0 in scatter.
        crop: the same points with what came of them when they were cut out of the map, if they were.
    """

    points: Points
    normals: Points
    crop: kernels.Crop | None = None

    @cached_property
    def grid(self) -> kernels.PointGrid:
        """The points, to be searched by :func:`coview_kernels.nearest`."""
        return (
            kernels.PointGrid(self.points)
            if self.crop is None
            else kernels.PointGrid.sorted(self.points, self.crop.cells)
        )

    def planes(self, rows: Ints) -> tuple[Floats32, Floats32]:
        """Return the unit normals (N, 3) of some points, and the planarity (N,) around each in [0, 1]."""
        normals = self.normals[rows]
        length = norms(normals)
        unit = np.asarray(normals / np.maximum(length, np.float32(1e-6))[:, None], dtype=np.float32)
        return unit, np.minimum(length, np.float32(1.0))

    @property
    def sample(self) -> Points:
        """One (S, 3) of three points: enough for shares of them."""
        return self.points[::_SAMPLE_EVERY] if self.crop is None else self.crop.sample

    def prepare(self, method: RegistrationMethod = "trimmed-icp") -> None:
        """Make now what registration by ``method`` and verification would make when they ask for it."""
        _ = self.edges, self._sorted
        if method == "gicp":
            _ = self.surfaces

    @cached_property
    def _sorted(self) -> bool:
        kernels.nearest(self.grid, self.points[:1], 1.0)
        return True

    @cached_property
    def edges(self) -> kernels.Raster:
        """The walls that the map must have though it may not show them."""
        return roof_edges(self.points) if self.crop is None else _edges(self.crop.top, self.crop.corner)

    @cached_property
    def surfaces(self) -> Surfaces | None:
        """The points as GICP takes them; None where they are too few."""
        from coview_stream.localization.registration.gicp import surfaces

        return surfaces(self.points)


class LocalMaps:
    """Crops of a base map by place, of which the recently used ones are kept."""

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
            crop = self._map.cut(kernels.Cut(float(centre[0]), float(centre[1]), radius, _SAMPLE_EVERY, _CELL))
            few = crop is None or len(crop.points) < MIN_PAIRS
            self._crops[key] = None if crop is None or few else LocalMap(crop.points, crop.normals, crop)
            if len(self._crops) > self._max_crops:
                self._crops.popitem(last=False)
        self._crops.move_to_end(key)
        return self._crops[key]


def roof_edges(points: Points) -> kernels.Raster:
    """Find the edges of what stands high among (K, 3) map points, below which the map must have walls.

    Cells without points count as low: below a roof's edge there often are none.

    Returns:
        Height (H, W) of the edges, metres, rows along x, columns along y; far below everything where there is none.
    """
    corner = np.array([points[:, d].min() for d in range(2)], dtype=np.float64) - 2 * _CELL
    i, j = (np.floor((points[:, d] - corner[d]) / _CELL).astype(np.int64) for d in range(2))
    rows, columns = int(i.max()) + 3, int(j.max()) + 3
    flat = np.full(rows * columns, _NOTHING, dtype=np.float32)
    np.maximum.at(flat, i * columns + j, np.ascontiguousarray(points[:, 2]))  # quick on flat arrays only
    return _edges(flat.reshape(rows, columns), corner)


def _edges(top: Floats32, corner: Floats) -> kernels.Raster:
    """Edges (H, W) of the highest points of the cells, ``_NOTHING`` where there is none."""
    return kernels.Raster(likelihood_field.roof_edges(top), corner, _CELL)
