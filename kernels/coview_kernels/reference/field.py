"""Scores of hypotheses against a likelihood field, in NumPy, hypothesis by hypothesis and pose by pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_kernels.arrays import F32, F64, I32, I64, U16, Mask

CELL, TILE = 0.5, 32  # metres along a cell's edge; cells along a tile's
NO_GROUND, NOT_SURVEYED = -32768, -32767
"""Values of the ground raster without a height."""

REACH, TURNS, TURN = 3, 7, 0.0349066
"""Largest coarse shift, metres; number of coarse headings, and radians between them."""

NEAR_STEP, NEAR_TURN = 0.25, 0.00872665
"""Metres and radians of the first fine level without a coarse level; each further level halves them."""

RISE_STEPS = 1024
"""Steps in a metre by which a scan's height is raised: sums of whole numbers vectorize."""

ON_GROUND, UNDER_EDGE, UPPER_FLOOR, EDGE_STEP = 0.15, 0.5, 1.5, 0.25
"""Metres: tolerance of points on the ground; tolerance of points below a roof edge; height above the lowest surface
from which only the bits decide on a floor; unit of the stored edges."""


class FieldLayers(NamedTuple):
    """Rasters of a map for the look-ups; tile 0 is empty and represents unsurveyed tiles."""

    table: I32
    """(R, C) number of each tile; 0 for none, as along the table's border."""
    base: F32
    """(T + 1,) base of a tile's heights, metres."""
    words: I64
    """(T + 1, 2, 32, 32) structure at height z, by ``32 h + k = floor(2 z) mod 64``: bit k of word h, near structure;
    bit k + 32, on structure."""
    surface: I32
    """(T + 1, 32, 32) ground in the lower half, centimetres; edge above it."""
    coarse: U16
    """(32, 2 C + 1, 16 R) a plane for each metre of height modulo 32, a word for every eight one-metre cells along a
    row: bit k says whether the k-th of the 16 cells from there on is within a metre of structure."""


class Plan(NamedTuple):
    """A scan, its parts for the levels, the number of fine levels (-1: no move), whether a coarse one comes first."""

    structure: F32
    low: F32
    free: F32
    few: F32
    some: F32
    lows: F32
    levels: int
    coarse: bool


def field_scores(layers: FieldLayers, plan: Plan, start: F64) -> tuple[F64, I32]:
    """Score hypotheses (H, 4), metres from the table's corner; twin of :func:`coview_kernels.field_scores`.

    Returns:
        Poses (H, 4), and counts (H, 7) in the order of :class:`coview_kernels.FieldScores`.
    """
    poses, counts = start.copy(), np.zeros((len(start), 7), dtype=np.int32)
    for pose, count in zip(poses, counts, strict=True):
        if plan.levels >= 0:
            _refine(layers, plan, pose)
        count[:] = _counts(layers, plan, pose)
    return poses, counts


def _refine(layers: FieldLayers, plan: Plan, pose: F64) -> None:
    step, angle = NEAR_STEP, NEAR_TURN
    if plan.coarse:
        pose += _coarse_shift(layers, plan, pose)
        step, angle = 0.5, 0.5 * TURN
    for reach in (2.0, 0.5):
        pose[2] += _rise(layers, plan.lows, pose, reach)
    for _ in range(plan.levels):
        best, move = -1, np.zeros(4)
        for i, j in np.ndindex(3, 3):
            there = np.array([step * (j - 1), step * (i - 1), 0.0, 0.0])
            value = 4 * _fine_hits(layers, plan.some, pose + there) - abs(i - 1) - abs(j - 1)
            if value > best:
                best, move = value, there
        pose += move
        turn = 0.0
        for k in (-1, 1):
            value = 4 * _fine_hits(layers, plan.some, pose + np.array([0.0, 0.0, 0.0, angle * k])) - 1
            if value > best:
                best, turn = value, angle * k
        pose[3] += turn
        step, angle = 0.5 * step, 0.5 * angle
    pose[2] += _rise(layers, plan.lows, pose, 0.5)


def _coarse_shift(layers: FieldLayers, plan: Plan, pose: F64) -> F64:
    best = -1
    shift = (0, 0, 0)
    for a in range(TURNS):
        hits = _coarse_hits(layers.coarse, plan.few, pose, float(pose[3]) + TURN * (a - TURNS // 2))
        for i, j in np.ndindex(hits.shape):
            value = 16 * int(hits[i, j]) - abs(i - REACH) - abs(j - REACH) - abs(a - TURNS // 2)
            if value > best:
                best, shift = value, (i - REACH, j - REACH, a - TURNS // 2)
    return np.array([shift[1], shift[0], 0.0, TURN * shift[2]])


def _placed(points: F32, pose: F64) -> F32:
    x, y, z, yaw = pose.astype(np.float32)
    c, s = np.cos(yaw), np.sin(yaw)
    u, v, w = points.T
    return np.stack([x + c * u - s * v, y + s * u + c * v, z + w], axis=1)


def _coarse_hits(planes: U16, structure: F32, pose: F64, yaw: float) -> I64:
    at = np.floor(_placed(structure, np.array([*pose[:3], yaw]))).astype(np.int64)
    _, blocks, high = planes.shape
    column, row = at[:, 0] - REACH, at[:, 1] - REACH
    inside = (row >= 0) & (row < high - 2 * REACH) & (column >= 0) & (column < 8 * blocks - 8)
    column, row, level = column[inside], row[inside], at[inside, 2] & 31
    side = np.arange(2 * REACH + 1)
    words = planes[level[:, None], (column >> 3)[:, None], row[:, None] + side].astype(np.int64)
    return np.asarray(((words[:, :, None] >> ((column & 7)[:, None, None] + side)) & 1).sum(axis=0, dtype=np.int64))


def _cells(layers: FieldLayers, points: F32) -> tuple[I64, I64, I64]:
    """Return tile, row and column (N,) of the cells that hold the points."""
    low = np.zeros(2, dtype=np.int64)
    limit = np.array(layers.table.shape) * TILE - 1
    cell = np.clip(np.floor(points[:, 1::-1] / np.float32(CELL)).astype(np.int64), low, limit)
    row, column = cell.T
    tile = layers.table[row // TILE, column // TILE].astype(np.int64)
    return tile, row % TILE, column % TILE


def _near_and_on(layers: FieldLayers, cell: tuple[I64, I64, I64], z: F32) -> tuple[Mask, Mask]:
    """Return whether heights z (N,) in cells are near structure, and on structure."""
    level = np.floor(z / np.float32(CELL)).astype(np.int64) & 63
    words = layers.words[cell[0], level >> 5, cell[1], cell[2]] >> (level & 31)
    return (words & 1).astype(bool), (words >> 32 & 1).astype(bool)


def _heights(layers: FieldLayers, cell: tuple[I64, I64, I64]) -> tuple[F32, Mask, Mask]:
    """Return the ground height, whether there is one, and whether the cell has been surveyed."""
    stored = layers.surface[cell].astype(np.int16).astype(np.int32)
    height = layers.base[cell[0]] + np.float32(0.01) * stored.astype(np.float32)
    return height, stored > NOT_SURVEYED, stored != NOT_SURVEYED


def ground_heights(layers: FieldLayers, points: F32) -> F32:
    """Return the ground height (N,) in the cells of points (N, 3); NaN without ground."""
    height, has, _ = _heights(layers, _cells(layers, points))
    return np.where(has, height, np.float32(np.nan))


def _rise(layers: FieldLayers, low: F32, pose: F64, reach: float) -> float:
    """Return the metres that the scan has to rise to the map's ground, from points within ``reach`` of it."""
    placed = _placed(low, pose)
    height, has, _ = _heights(layers, _cells(layers, placed))
    off = height - placed[:, 2]
    some = has & (np.abs(off) < reach)
    steps = np.floor(np.float32(RISE_STEPS) * off[some] + np.float32(0.5)).astype(np.int32).sum()
    return float(np.float32(steps) / np.float32(RISE_STEPS * max(int(some.sum()), 1)))


def _fine_hits(layers: FieldLayers, structure: F32, pose: F64) -> int:
    placed = _placed(structure, pose)
    near, on = _near_and_on(layers, _cells(layers, placed), placed[:, 2])
    return int(near.sum()) + int(on.sum())


def structure_at(layers: FieldLayers, structure: F32, pose: F64) -> tuple[Mask, Mask, Mask, Mask]:
    """Mask structure points (N, 3) at a pose (4,) that are surveyed, near map structure, covered by it, and on it."""
    placed = _placed(structure, pose)
    cell = _cells(layers, placed)
    _, _, surveyed = _heights(layers, cell)
    edge = layers.surface[cell] >> 16
    near, on = _near_and_on(layers, cell, placed[:, 2])
    near &= surveyed
    top = np.where(edge > 0, layers.base[cell[0]] + np.float32(EDGE_STEP) * edge.astype(np.float32), np.float32(-1e6))
    covered = (near | (top > placed[:, 2] - np.float32(UNDER_EDGE))) & surveyed
    return surveyed, near, covered, on & surveyed


def near_shifted(layers: FieldLayers, structure: F32, pose: F64, offsets: I64) -> Mask:
    """Mask (H, N) structure points (N, 3), at a pose (4,) moved by (H, 2) rows and columns, near map structure."""
    if not len(structure) or not len(offsets):
        return np.zeros((len(offsets), len(structure)), dtype=bool)
    placed = _placed(structure, pose)
    cell = np.floor(placed[:, 1::-1] / np.float32(CELL)).astype(np.int64)
    first = cell.min(axis=0) + offsets.min(axis=0)
    last = cell.max(axis=0) + offsets.max(axis=0)
    limits = np.array(layers.table.shape) * TILE - 1
    row, column = (np.clip(np.arange(first[k], last[k] + 1), 0, limits[k]) for k in range(2))
    tile = layers.table[row // TILE][:, column // TILE].astype(np.int64)
    at = (row % TILE)[:, None] * TILE + column % TILE
    known = layers.surface.reshape(-1).take(tile * TILE**2 + at).astype(np.int16) != NOT_SURVEYED
    words = np.where(known, [layers.words.reshape(-1).take((2 * tile + k) * TILE**2 + at) for k in range(2)], 0).ravel()
    width = np.array([len(column), 1])
    level = np.floor(placed[:, 2] / np.float32(CELL)).astype(np.int64) & 63
    index = (offsets @ width)[:, None] + (cell - first) @ width + (level >> 5) * known.size
    return np.asarray((words.take(index) >> (level & 31)) & 1, dtype=bool)


def _counts(layers: FieldLayers, plan: Plan, pose: F64) -> tuple[int, ...]:
    surveyed, near, covered, on = structure_at(layers, plan.structure, pose)
    lower = _placed(plan.low, pose)
    under = _cells(layers, lower)
    height, has, known = _heights(layers, under)
    off = lower[:, 2] - height
    upper = (off > UPPER_FLOOR) & _near_and_on(layers, under, lower[:, 2])[1]
    grounded = ((has & (np.abs(off) < ON_GROUND)) | upper) & known
    free = _placed(plan.free, pose)
    _, passed = _near_and_on(layers, _cells(layers, free), free[:, 2])
    masks = surveyed, near, covered, known, grounded, passed, on
    return tuple(int(mask.sum()) for mask in masks)
