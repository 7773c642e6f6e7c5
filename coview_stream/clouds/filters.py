"""Filters of (N, 3) float32 points near zero: outliers, voxel grid, normals."""

from __future__ import annotations

import numpy as np

from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points

_MAX_CELLS = 2**62  # voxel keys must fit a signed 64-bit integer
_BLOCK = 1 << 14  # points at a time: with twenty neighbours each, 8 MB per axis


def remove_outliers(points: Points, neighbours: int = 20, std_ratio: float = 2.0) -> tuple[Points, Bools]:
    """Drop points unusually far from their neighbours (Rusu, 2009); return the remaining points and their mask (N,).

    Outliers are points (float32, finite) whose mean distance to the nearest ``neighbours``, including themselves,
    exceeds the cloud's mean by ``std_ratio`` standard deviations. Takes several seconds per million points: thin large
    maps with ``voxel_grid`` first.
    """
    if len(points) <= neighbours:
        return points, np.ones(len(points), dtype=bool)
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    blocks = (points[i : i + _BLOCK] for i in range(0, len(points), _BLOCK))
    mean = np.concatenate([tree.query(block, neighbours, workers=-1)[0].mean(axis=1) for block in blocks])
    mask = np.asarray(mean <= mean.mean() + std_ratio * mean.std(ddof=1))
    return points[mask], mask


def voxel_grid(points: Points, voxel: float) -> Points:
    """Return the centroids of the occupied voxels, in the order of their keys (x slowest, z fastest).

    Points (N, 3) are float32 metres, finite; voxels are aligned to multiples of their edge ``voxel``, metres.
    ConfigError if it is so small for this extent that keys would overflow.
    """
    if not len(points):
        return points.reshape(0, 3)
    low = np.floor(points.min(axis=0).astype(np.float64) / voxel)
    extent = np.floor(points.max(axis=0).astype(np.float64) / voxel) - low + 1
    if float(np.prod(extent)) > _MAX_CELLS:
        raise ConfigError(f"voxel={voxel}: too small for a cloud of {(extent * voxel).round().tolist()} m")
    keys: Ints = np.zeros(len(points), dtype=np.int64)
    for axis in range(3):
        cell = np.floor(points[:, axis].astype(np.float64) / voxel) - low[axis]
        keys *= int(extent[axis])
        keys += cell.astype(np.int64)
    order = np.argsort(keys)
    keys = keys[order]
    starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    counts = np.diff(np.append(starts, len(points)))
    centroids = np.empty((len(starts), 3), dtype=np.float32)
    for axis in range(3):  # one axis at a time: smaller float64 copies
        column = points[:, axis][order].astype(np.float64)
        centroids[:, axis] = np.add.reduceat(column, starts) / counts
    return centroids


def estimate_normals(points: Points, k: int = 20, radius: float | None = None) -> tuple[Points, Floats32]:
    """Estimate upward unit normals (N, 3) float32, from the local covariance, and planarity (N,).

    Planarity is 1 - 3 s, where s is the share of the covariance's smallest eigenvalue ("surface variation", Pauly et
    al., 2002): 1 on a plane, 0 for isotropic scatter as in a crown. Fewer than three neighbours give (0, 0, 1) and 0.
    Points (N, 3) are float32 metres, finite; the ``k`` nearest, itself included, are a point's neighbours, within
    ``radius`` metres if given.
    """
    if not len(points):
        return points.reshape(0, 3), np.empty(0, dtype=np.float32)
    from scipy.spatial import cKDTree

    tree, reach = cKDTree(points), np.inf if radius is None else radius
    columns = [np.append(points[:, axis].astype(np.float64), 0.0) for axis in range(3)]  # last row: no neighbour
    normals, planarity = np.empty_like(points), np.empty(len(points), dtype=np.float32)
    for start in range(0, len(points), _BLOCK):
        block = slice(start, min(start + _BLOCK, len(points)))
        rows = tree.query(points[block], min(k, len(points)), distance_upper_bound=reach, workers=-1)[1]
        rows = rows.reshape(len(rows), -1)
        near = rows < len(points)
        gaps = [np.where(near, column[rows] - column[block, None], 0.0) for column in columns]
        normals[block], planarity[block] = _plane(gaps, near.sum(axis=1))
    return normals, planarity


def _plane(gaps: list[Floats], count: Ints) -> tuple[Floats, Floats]:
    """Return normals (N, 3) and planarity (N,) from offsets to neighbours: three axes (N, K), ``count`` (N,) valid."""
    means = [gap.sum(axis=1) / count for gap in gaps]
    covariance = np.empty((len(count), 3, 3))
    for row in range(3):
        for column in range(row + 1):  # eigh reads only the lower half
            products = np.einsum("nk,nk->n", gaps[row], gaps[column]) / count
            covariance[:, row, column] = products - means[row] * means[column]
    values, vectors = np.linalg.eigh(covariance)
    normals = np.where(vectors[:, 2:, 0] < 0.0, -vectors[..., 0], vectors[..., 0])
    total = values.sum(axis=1)
    share = np.divide(values[:, 0], total, out=np.zeros_like(total), where=total > 0.0)
    few = count < 3
    normals[few] = 0.0, 0.0, 1.0
    return normals, np.where(few, 0.0, np.clip(1.0 - 3.0 * share, 0.0, 1.0))
