"""Co-view descriptor: channels of the polar bins of a virtual scan (paper, eqs 1-4)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import PolarGrid
from coview_stream.config import Channel, DescriptorConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points

Descriptor = npt.NDArray[np.float32]
"""(R, S) or (M, R, S) float32."""

_GROUND_RADIUS = 6.0  # metres around a keyframe within which its virtual scan has ground points

EYE = 1.7
"""Presumed height of the sensor above the ground, metres, where no ground shows it."""

LOWEST_EYE = 0.3
"""Least height of a sensor above ground, metres: points less far below it are not taken for ground, but for walls."""

FLOOR_RADIUS = 15.0
"""Metres around a body within which its lidar sees ground: a VLP-16 at a height of 2 m does from 7.5 m on."""

_FREE = 1.3  # metres above a body's origin up to which space is free over ground, even below trees, but not at a wall


def channel(name: Channel, grid: PolarGrid) -> Descriptor:
    """Compute a descriptor channel (..., R, S) of polar bins, metres above the ground.

    In ``scan_context`` negative heights (ground in a hollow) count as zero; ``paper`` needs a grid with mean heights.
    """
    if name == "scan_context":
        value: Descriptor = np.where(grid.count > 0, np.maximum(grid.max_height, 0.0), 0.0).astype(np.float32)
        return value
    if name == "paper":
        assert grid.mean_height is not None
        return kernels.paper_context(grid.max_height, grid.count, grid.mean_height)
    return kernels.coview(grid.max_height, grid.count)


def describe(points: Points, centre: Floats, config: DescriptorConfig) -> dict[Channel, Descriptor]:
    """Describe a virtual local scan, gravity-aligned points (N, 3), metres, one per voxel, by channels, (R, S) each.

    ``centre`` (3,) is the zero of the descriptor: the keyframe's x and y, and the ground's height below it.
    """
    grid, _ = kernels.polar_bin(points, centre, config.rings, config.sectors, config.radius)
    return {name: channel(name, grid) for name in config.channels}


def ground_below(points: Points, position: Floats) -> float:
    """Estimate the height of the ground below ``position`` (3,) from the points around it, metres in their frame.

    It is the median of the lowest points below the position in 1 m cells within 6 m: robust to clutter, and independent
    of the sensor's mounting height. A body's origin may lie on the ground itself (:func:`lies_on_ground`); otherwise,
    without such points, as below a hemisphere that looks up, the ground is :data:`EYE` below the position.
    """
    x, y = points[:, 0] - position[0], points[:, 1] - position[1]
    inside = x * x + y * y < _GROUND_RADIUS**2
    near = np.flatnonzero(inside & (points[:, 2] < position[2] - LOWEST_EYE))
    if not len(near):
        if not lies_on_ground(points, position):
            return float(position[2] - EYE)
        near = np.flatnonzero(inside & (points[:, 2] < position[2] + LOWEST_EYE))
        if not len(near):
            return float(position[2])
    reach = int(np.ceil(_GROUND_RADIUS))
    column, row = (np.floor(axis[near]).astype(np.int64) + reach for axis in (x, y))
    lowest = np.full((2 * reach) ** 2, np.inf, dtype=np.float32)
    np.minimum.at(lowest, column * 2 * reach + row, points[near, 2])
    return float(np.median(lowest[np.isfinite(lowest)]))


def lies_on_ground(points: Points, position: Floats) -> bool:
    """Whether ``position`` (3,), the origin of a body such as a ``base_footprint``, lies on the visible ground.

    Of the 1 m cells within 15 m with points at its height, most have free space just above: in contrast to walls, which
    an upward looking lidar sees from its own height upwards.
    """
    offset = points - position.astype(np.float32)
    offset = offset[(offset[:, 0] ** 2 + offset[:, 1] ** 2 < FLOOR_RADIUS**2) & (np.abs(offset[:, 2]) < _FREE)]
    reach = int(np.ceil(FLOOR_RADIUS))
    column, row = (np.floor(axis).astype(np.int64) + reach for axis in (offset[:, 0], offset[:, 1]))
    cell, low = column * 2 * reach + row, np.abs(offset[:, 2]) < LOWEST_EYE
    floor = np.unique(cell[low])
    return bool(2 * np.isin(floor, cell[offset[:, 2] >= LOWEST_EYE]).sum() < len(floor))


def on_ground(points: Points, position: Floats) -> Floats:
    """Return ``position`` (3,) at the height of the ground below it, from :func:`ground_below`."""
    return np.array([position[0], position[1], ground_below(points, position)])
