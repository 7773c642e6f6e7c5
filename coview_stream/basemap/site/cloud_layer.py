"""Layer ``cloud`` of a tile: its points in steps of a twelfth of a voxel, their normals and planarity, 2.5 bytes each.

Points are sorted by the voxel they lie in: rows, columns, heights. Stored are how many each column has, the steps of
height between them, and where in its voxel each lies, in steps of ``voxel / STEPS`` (2 cm of 0.25 m); normals point up
and are stored by the octahedral map (Meyer et al., 2010) in 64 x 64 cells, within 2.3 degrees.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Floats, Floats32, Int8s
from coview_stream.geometry.transforms import Points

# set by hand
STEPS = 12
"""Steps of a voxel's edge."""
_CELLS = 64  # of the octahedral map, along each edge
_PLANARITY = 15  # steps
_MAX_LEVEL = 30_000  # voxels above or below zero
_MAX_COLUMNS = 1 << 24

Layer = dict[str, npt.NDArray[Any]]


def cloud_layer(points: Points, normals: Points, planarity: Floats32, tile: float, voxel: float) -> Layer:
    """Return the arrays of a tile's cloud.

    Args:
        points: (N, 3) float32 metres about the tile's lower corner, in [0, tile) in x and y.
        normals: (N, 3) unit normals, none of which points down.
        planarity: (N,) in [0, 1].
        tile: metres.
        voxel: metres.
    """
    across = columns_of(tile, voxel)
    cell = np.floor(points.astype(np.float64) / voxel).astype(np.int64)
    np.clip(cell[:, :2], 0, across - 1, out=cell[:, :2])
    np.clip(cell[:, 2], -_MAX_LEVEL, _MAX_LEVEL, out=cell[:, 2])
    order = np.lexsort((cell[:, 2], cell[:, 0], cell[:, 1]))
    cell = cell[order]
    inside = points[order].astype(np.float64) / voxel - cell
    counts = np.bincount(cell[:, 1] * across + cell[:, 0], minlength=across * across)
    return {
        "counts": counts.astype(np.uint16).reshape(across, across),
        "levels": np.diff(cell[:, 2], prepend=0).astype(np.int32),
        "inside": np.ascontiguousarray(np.clip(np.floor(inside * STEPS), 0, STEPS - 1).astype(np.uint8).T),
        "normals": _octahedral(normals[order]),
        "planarity": np.rint(planarity[order] * _PLANARITY).astype(np.uint8),
    }


def read_cloud_layer(layer: Layer, corner: Floats, tile: float, voxel: float) -> tuple[Points, Int8s]:
    """Return a tile's points (N, 3) float32, and normals (N, 3) as a map keeps them, as long as the planarity.

    Args:
        layer: arrays of :func:`cloud_layer`, from anywhere.
        corner: (3,) lower corner of the tile in the map's frame, metres.
        tile: metres.
        voxel: metres.

    Raises:
        MapError: they do not fit together.
    """
    across = columns_of(tile, voxel)
    try:
        counts, levels, inside = layer["counts"], layer["levels"], layer["inside"]
        normals, planarity = layer["normals"], layer["planarity"]
    except KeyError as error:
        raise MapError(f"a tile's cloud lacks {error}; fetch or build it again") from error
    kinds = [each.dtype.str for each in (counts, levels, inside, normals, planarity)]
    number = len(levels)
    shapes = inside.shape == (3, number) and normals.shape == (number, 2) and planarity.shape == (number,)
    if kinds != ["<u2", "<i4", "|u1", "|u1", "|u1"] or counts.shape != (across, across) or not shapes:
        raise MapError("a tile's cloud has other arrays than it should; fetch or build it again")
    level = np.cumsum(levels, dtype=np.int64)
    if int(counts.sum(dtype=np.int64)) != number or (number and np.abs(level).max() > _MAX_LEVEL):
        raise MapError("a tile's cloud does not fit together; fetch or build it again")
    column = np.repeat(np.arange(across * across), counts.reshape(-1))
    cell = np.stack([column % across, column // across, level])
    places = (cell + (inside.astype(np.float64) + 0.5) / STEPS) * voxel
    points = (places.T + np.asarray(corner, dtype=np.float64)).astype(np.float32)
    length = np.maximum(planarity.astype(np.float32) * np.float32(127.0 / _PLANARITY), np.float32(8.0))
    return points, np.rint(_directions(normals) * length[:, None]).astype(np.int8)


def square_metres(points: Points) -> int:
    """Return how many squares of a metre hold points (N, 3)."""
    column, row = np.floor(points[:, :2]).astype(np.int64).T
    return len(np.unique(column * (1 << 32) + row))


def columns_of(tile: float, voxel: float) -> int:
    """Return how many voxels a tile has along an edge.

    Raises:
        MapError: too many, or none.
    """
    across = int(np.ceil(tile / voxel - 1e-6)) if voxel > 0 else 0
    if not 0 < across * across <= _MAX_COLUMNS:
        raise MapError(f"tiles of {tile:g} m in voxels of {voxel:g} m: choose smaller tiles or larger voxels")
    return across


def _octahedral(normals: Points) -> npt.NDArray[np.uint8]:
    """Return cells (N, 2) of normals that do not point down: on the octahedron's upper half, a turned square."""
    length = np.abs(normals).sum(axis=1, dtype=np.float64)
    x, y = (normals[:, :2] / np.maximum(length, 1e-9)[:, None]).T
    square = np.stack([x + y, x - y], axis=1)
    return np.rint(np.clip((square + 1.0) * 0.5, 0.0, 1.0) * (_CELLS - 1)).astype(np.uint8)


def _directions(cells: npt.NDArray[np.uint8]) -> Floats32:
    """Return the unit normals (N, 3) of cells (N, 2)."""
    a, b = cells.astype(np.float64).T / (_CELLS - 1) * 2.0 - 1.0
    x, y = (a + b) * 0.5, (a - b) * 0.5
    normal = np.stack([x, y, 1.0 - np.abs(x) - np.abs(y)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
    return normal.astype(np.float32)
