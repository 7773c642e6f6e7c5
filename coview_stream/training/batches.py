"""Training batches: pieces of maps with queries in them, rotated, mirrored and augmented at random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS, Image
from coview_stream.geometry.arrays import Floats, Indices, Ints
from coview_stream.geometry.transforms import rot_z
from coview_stream.training.worlds import QUERY_CELLS, WorldViews

_HEIGHTS = LAYERS - 3  # height layers, followed by greatest height, ground seen and relief
_TOP, _SEEN, _RELIEF = LAYERS - 3, LAYERS - 2, LAYERS - 1
# plausible probabilities and ranges of changes, not measured
_CHANCE = 0.5  # of each change
_MAX_FALLEN = 0.004  # disks per square metre: 40 per hectare
_RADII = (1.0, 2.5)  # metres


def augmented(image: Image, aerial: bool, rng: np.random.Generator) -> Image:
    """Return a copy of a bird's-eye view (LAYERS, H, W) with random changes to its trees, cells and layers."""
    image = image.copy()
    if rng.random() < _CHANCE:
        _fell(image, rng)
    if rng.random() < _CHANCE:  # a sparser scan
        image[:_HEIGHTS] *= rng.random(image[:_HEIGHTS].shape, dtype=np.float32) > rng.uniform(0.0, 0.5)
        image[_SEEN] *= rng.random(image[_SEEN].shape, dtype=np.float32) > rng.uniform(0.0, 0.5)
    if rng.random() < 0.5 * _CHANCE:
        if aerial:  # dense leaves hide lower layers
            image[: int(rng.integers(1, 4))] = 0
        else:  # the field of view ends below the upper layers
            image[int(rng.integers(3, _HEIGHTS)) : _HEIGHTS] = 0
            image[_TOP] = np.minimum(image[_TOP], int(255 * rng.uniform(0.1, 0.4)))
    if rng.random() < _CHANCE:
        power = np.exp(rng.uniform(-0.6, 0.6))
        shares = 255.0 * (np.arange(256) / 255.0) ** power
        image[:_HEIGHTS] = shares.astype(np.uint8)[image[:_HEIGHTS]]
    if rng.random() < 0.5 * _CHANCE:
        relief = image[_RELIEF].astype(np.float32) - 128.0
        relief *= 0.0 if rng.random() < 0.5 else np.float32(rng.uniform(0.3, 1.5))
        image[_RELIEF] = np.clip(128.0 + relief, 0.0, 255.0)
    return image


def _fell(image: Image, rng: np.random.Generator) -> None:
    """Clear disks in all height layers, as if trees had gone; the ground layers stay."""
    height, width = image.shape[1:]
    count = rng.poisson(rng.uniform(0.0, _MAX_FALLEN) * height * width * CELL**2)
    for row, column, radius in zip(
        rng.integers(height, size=count), rng.integers(width, size=count), rng.uniform(*_RADII, count), strict=True
    ):
        reach = int(radius / CELL) + 1
        rows = slice(max(0, row - reach), row + reach + 1)
        columns = slice(max(0, column - reach), column + reach + 1)
        y, x = np.ogrid[rows.start : min(rows.stop, height), columns.start : min(columns.stop, width)]
        near = np.hypot(y - row, x - column) * CELL < radius
        image[:_SEEN, rows, columns][:, near] = 0


PIECE = 272
"""Cells along an edge of a piece of the map, 136 m."""

_REACH = 36.0  # metres from a piece's centre within which queries lie, so that their 30 m are on the piece
_ROTATED = 0.5  # share of the pieces that are rotated by any angle, not only by quarter turns
_NARROWED = 0.4  # share of the queries that are cut at a random radius, 12 to 30 m
_SECTOR_LOST = 0.25  # share of the queries that lose a sector
_FROM_MAP = 0.1  # share of the queries cut from the map: driving all around a tree shows its whole crown too
_RADIUS = 30.0  # metres, of a query
_TRIES = 50  # centres drawn for a piece until enough queries are near


@dataclass(frozen=True)
class Batch:
    """G map pieces of different worlds, and Q queries."""

    pieces: Image  # (G, LAYERS, PIECE, PIECE)
    queries: Image  # (Q, LAYERS, 128, 128)
    piece_of: Ints  # (Q,) index of each query's piece
    poses: Floats  # (Q, 3) x, y and heading of the queries in their piece's frame, from its centre; metres, radians


def draw_batch(
    worlds: Sequence[WorldViews], pieces: int, each: int, rng: np.random.Generator, augment: bool = True
) -> Batch:
    """Draw ``pieces`` map pieces of different worlds with ``each`` queries; ``augment`` changes the images."""
    images, queries, owners, poses = [], [], [], []
    for owner, k in enumerate(rng.choice(len(worlds), pieces, replace=False)):
        world = worlds[int(k)]
        centre, near = _middle(world, each, rng)
        chosen = rng.choice(near, each, replace=len(near) < each)
        turn = rng.uniform(-np.pi, np.pi) if rng.random() < _ROTATED else 0.5 * np.pi * rng.integers(4)
        mirrored = bool(rng.random() < 0.5)
        piece = _piece(world, centre, turn, mirrored)
        images.append(augmented(piece, True, rng) if augment else piece)
        for index in chosen:
            x, y, yaw = world.poses[index]
            at = rot_z(-turn)[:2, :2] @ (np.array([x, y]) - centre)
            view = world.queries[index]
            if rng.random() < _FROM_MAP:
                view = _piece(world, world.poses[index, :2], yaw, False, QUERY_CELLS)
            image, quarter = _query(view, mirrored, rng)
            heading = yaw - turn
            if mirrored:
                at, heading = at * (1.0, -1.0), -heading
            poses.append([*at, heading + quarter])
            queries.append(augmented(image, False, rng) if augment else image)
            owners.append(owner)
    return Batch(np.stack(images), np.stack(queries), np.array(owners), np.array(poses))


def _middle(world: WorldViews, count: int, rng: np.random.Generator) -> tuple[Floats, Indices]:
    """Draw the centre (2,) of a piece near ``count`` queries, or near the most, and the queries' indices (K,)."""
    best, most = np.zeros(2), np.zeros(0, dtype=np.intp)
    for _ in range(_TRIES):
        centre = world.poses[rng.integers(len(world.poses)), :2] + rng.uniform(-0.7, 0.7, 2) * _REACH
        near = np.flatnonzero(np.linalg.norm(world.poses[:, :2] - centre, axis=1) < _REACH)
        if len(near) > len(most):
            best, most = centre, near
        if len(near) >= count:
            break
    return best, most


def _piece(world: WorldViews, centre: Floats, turn: float, mirrored: bool, size: int = PIECE) -> Image:
    """Cut a piece around ``centre``: ``p_world = R(turn) p_piece + centre``, then negate the piece's y if mirrored."""
    at = (np.arange(size) + 0.5 - size / 2) * CELL
    x, y = np.meshgrid(at, -at if mirrored else at, indexing="xy")
    column = (np.cos(turn) * x - np.sin(turn) * y + centre[0] - world.corner[0]) / CELL
    row = (np.sin(turn) * x + np.cos(turn) * y + centre[1] - world.corner[1]) / CELL
    column, row = np.floor(column + 1e-6).astype(np.intp), np.floor(row + 1e-6).astype(np.intp)
    height, width = world.aerial.shape[1:]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    piece = world.aerial[:, row.clip(0, height - 1), column.clip(0, width - 1)] * inside
    piece[-1][~inside] = 128
    return np.asarray(piece.astype(np.uint8))


def _query(image: Image, mirrored: bool, rng: np.random.Generator) -> tuple[Image, float]:
    """Mirror a query, rotate it by quarter turns and hide parts; return it and its heading change, radians."""
    if mirrored:
        image = image[:, ::-1]
    quarters = int(rng.integers(4))
    image = np.rot90(image, quarters, axes=(1, 2)).copy()
    at = (np.arange(QUERY_CELLS) + 0.5 - QUERY_CELLS / 2) * CELL
    distance = np.hypot(at[:, None], at[None])
    hidden = distance > (rng.uniform(12.0, _RADIUS) if rng.random() < _NARROWED else _RADIUS)
    if rng.random() < _SECTOR_LOST:
        direction = np.arctan2(at[:, None], at[None]) - rng.uniform(-np.pi, np.pi)
        hidden |= np.abs((direction + np.pi) % (2 * np.pi) - np.pi) < rng.uniform(0.2, 1.0)
    image[:, hidden] = 0
    image[-1][hidden] = 128
    # rot90 turns towards lower rows, i.e. clockwise seen from above; the heading compensates
    return image, 0.5 * np.pi * quarters
