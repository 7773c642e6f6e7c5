"""Batches: the poses say where the queries stand after every rotation and reflection."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS
from coview_stream.training.batches import PIECE, draw_batch
from coview_stream.training.worlds import QUERY_CELLS, WorldViews

SIDE = 400


def world(seed: int) -> WorldViews:
    """Dots at random; queries are exact looks at them."""
    rng = np.random.default_rng(seed)
    aerial = np.zeros((LAYERS, SIDE, SIDE), dtype=np.uint8)
    aerial[0] = 255 * (rng.random((SIDE, SIDE)) < 0.03)
    corner = np.array([-100.0, -100.0])
    at = (np.arange(QUERY_CELLS) + 0.5 - QUERY_CELLS / 2) * CELL
    x, y = np.meshgrid(at, at)
    queries, poses = [], []
    for _ in range(12):
        px, py, yaw = rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-np.pi, np.pi)
        column = np.floor((np.cos(yaw) * x - np.sin(yaw) * y + px - corner[0]) / CELL).astype(int)
        row = np.floor((np.sin(yaw) * x + np.cos(yaw) * y + py - corner[1]) / CELL).astype(int)
        queries.append(aerial[:, row, column])
        poses.append([px, py, yaw])
    sensor = np.array(["os64"] * 12)
    return WorldViews(aerial, corner, np.stack(queries), np.array(poses), sensor, "dots", np.zeros(12), {})


def agreement(piece: np.ndarray, query: np.ndarray, pose: np.ndarray) -> float:
    """Share of a query's dots that lie within a cell of a dot of the piece."""
    row, column = np.nonzero(query[0])
    x, y = (column + 0.5 - QUERY_CELLS / 2) * CELL, (row + 0.5 - QUERY_CELLS / 2) * CELL
    c, s = np.cos(pose[2]), np.sin(pose[2])
    at = np.stack([s * x + c * y + pose[1], c * x - s * y + pose[0]])
    i, j = np.floor(at / CELL + PIECE / 2).astype(int)
    inside = (i > 0) & (j > 0) & (i < PIECE - 1) & (j < PIECE - 1)
    i, j = i[inside], j[inside]
    hits = [piece[0, i + di, j + dj] > 0 for di in (-1, 0, 1) for dj in (-1, 0, 1)]
    return float(np.any(hits, axis=0).mean())


@pytest.mark.parametrize("seed", range(4))
def test_batch_poses_match_query_positions_in_map_pieces(seed: int) -> None:
    worlds = [world(k) for k in range(3)]
    batch = draw_batch(worlds, 3, 4, np.random.default_rng(seed), augment=False)
    right = [
        agreement(batch.pieces[owner], query, pose)
        for owner, query, pose in zip(batch.piece_of, batch.queries, batch.poses, strict=True)
    ]
    assert min(right) > 0.8  # turning by any angle drops some dots
    turned = batch.poses + np.array([0.0, 0.0, 0.5])
    wrong = [
        agreement(batch.pieces[owner], query, pose)
        for owner, query, pose in zip(batch.piece_of, batch.queries, turned, strict=True)
    ]
    assert max(wrong) < 0.5


def test_equal_seeds_give_equal_batches() -> None:
    worlds = [world(k) for k in range(2)]
    first, second = (draw_batch(worlds, 2, 3, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.queries, second.queries)
    assert np.array_equal(first.poses, second.poses)
    other = draw_batch(worlds, 2, 3, np.random.default_rng(6))
    assert not np.array_equal(first.poses, other.poses)
