"""Flat surfaces of single clouds, and registration of one cloud to another's surfaces: a motion without the map."""

from __future__ import annotations

import math

import numpy as np

import coview_kernels as kernels
from coview_kernels import Registration
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud
from coview_stream.localization.registration.register import register

LONGEST = 12.0
"""Metres between two clouds that still share their surroundings."""
_SCALES = (1.5, 0.8, 0.4)  # metres: largest correspondence distances of the registration, coarse to fine
_FARTHER = 3.0  # metres, first scale from a start without a prior
_FREE = np.array([math.radians(2.0), math.radians(2.0), math.radians(3.0), 0.05, 0.05, 0.05])
_FREE_METRE = 0.1  # prior sigmas of a motion about its start: radians and metres; metres more per metre of motion

# sigmas of a registered motion
_POSITION = 0.02  # metres
_POSITION_METRE = 0.01  # per metre: as in three real runs at steps of two to eight metres
_ANGLE = math.radians(0.2)

# surface patches
_CELL = 1.0  # metres, edge of a cube
_CELL_POINTS = 5  # least points in it
_THICKNESS = 0.15  # metres, one sigma across
_FLATTER = 2.0  # least ratio of width to thickness
_RANGE_NOISE = 0.03  # metres: points along one ring form a line, whose width is mere noise


def motion_prior(T_start: Pose, far: float) -> kernels.Prior:
    """Return the prior of a motion by ``far`` metres about its start (4, 4)."""
    free = _FREE + np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) * _FREE_METRE * far
    return kernels.Prior(T_start, np.diag(free**-2.0))


def motion_sigmas(far: float) -> tuple[float, float]:
    """Return the sigmas of a registered motion by ``far`` metres, in metres and in radians."""
    return math.hypot(_POSITION, _POSITION_METRE * far), _ANGLE


def register_to_cloud(
    scan: RegistrationCloud, target: LocalMap, start: kernels.Prior | Pose, config: RegistrationConfig, centre: Floats
) -> Registration | None:
    """Register a scan to the surfaces of an earlier one from a prior's mean, or from any pose (4, 4).

    Rotations are about ``centre`` (3,).
    """
    if isinstance(start, kernels.Prior):
        return register(scan, start.T_map_source, target, config, _SCALES, start, centre)
    return register(scan, start, target, config, (_FARTHER, *_SCALES), centre=centre)


def surface_points(points: Points) -> tuple[Points, Floats32]:
    """Return the points (K, 3) of a cloud (N, 3) that are in a flat cubic metre, and their normals (K, 3)."""
    if not len(points):
        return points, points.copy()
    cell = np.floor(points / np.float32(_CELL)).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    _, cell_of, count = np.unique(
        (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_inverse=True, return_counts=True
    )
    full = count >= _CELL_POINTS
    rows = np.flatnonzero(full[cell_of])
    points, cell_of, count = points[rows], (np.cumsum(full) - 1)[cell_of[rows]], count[full]
    exact = points.astype(np.float64)
    off = exact - np.stack([_means(column, cell_of, count) for column in exact.T], axis=1)[cell_of]
    moments = np.empty((len(count), 3, 3))
    for i, j in zip(*np.tril_indices(3), strict=True):  # eigh reads the lower half
        moments[:, i, j] = _means(off[:, i] * off[:, j], cell_of, count)
    variances, axes = np.linalg.eigh(moments)
    thin = np.maximum(variances[:, 0], 0.0)
    wide = variances[:, 1] > _FLATTER**2 * np.maximum(thin, _RANGE_NOISE**2)
    flat = ((thin < _THICKNESS**2) & wide)[cell_of]
    return points[flat], axes[:, :, 0][cell_of[flat]].astype(np.float32)


def _means(values: Floats, cell_of: Ints, count: Ints) -> Floats:
    """Return the means (C,) of values (N,) by cell number (N,), of cells with ``count`` (C,) values."""
    return np.asarray(np.bincount(cell_of, values, minlength=len(count)) / count)
