"""A map's learned features as they are stored: one byte a number, in square tiles, only where the map has points."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.int8]

TILE = 32
"""Cells of 1 m along a tile's edge; tile (i, j) covers ``[32 i, 32 (i + 1))`` metres in x, likewise in y."""

_SCALE = 127.0
_LEAST, _MOST = 0.02, 50.0  # sigmas that a byte can tell: steps of 3 %
_STEPS = 255.0 / np.log(_MOST / _LEAST)


def packed(vectors: npt.NDArray[np.float32]) -> Bytes:
    """Numbers of magnitude 1 at most (any shape) as bytes; off by 0.004 each."""
    return np.asarray(np.rint(vectors * np.float32(_SCALE)), dtype=np.int8)


def unpacked(vectors: npt.NDArray[np.int8]) -> npt.NDArray[np.float32]:
    """Undo :func:`packed`."""
    return np.asarray(vectors * np.float32(1.0 / _SCALE), dtype=np.float32)


def packed_sigma(sigma: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Positive sigmas (any shape) as bytes on a logarithmic scale; off by 1.5 % between 0.02 and 50."""
    steps = np.log(np.clip(sigma, _LEAST, _MOST) / _LEAST) * _STEPS
    return np.asarray(np.rint(steps), dtype=np.uint8)


def unpacked_sigma(sigma: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Undo :func:`packed_sigma`."""
    return np.asarray(_LEAST * np.exp(sigma / _STEPS), dtype=np.float32)


class TileIndex:
    """Finds tiles by place; made of (T, 2) tile numbers, column (x) and row (y)."""

    def __init__(self, tiles: npt.NDArray[np.int32]) -> None:
        self.tiles = np.array(tiles, dtype=np.int64).reshape(-1, 2)
        self.low = self.tiles.min(axis=0) if len(self.tiles) else np.zeros(2, dtype=np.int64)
        high = self.tiles.max(axis=0) + 1 if len(self.tiles) else self.low
        self.columns, self.rows = (int(n) for n in high - self.low)
        self._number = np.full((self.rows, self.columns), -1, dtype=np.int64)
        self._number[tuple((self.tiles - self.low).T[::-1])] = np.arange(len(self.tiles))

    def gather(self, values: npt.NDArray[Any], corner: npt.NDArray[np.int64], out: npt.NDArray[Any]) -> None:
        """Copy into ``out`` (h, w, ...) what ``values`` (T, 32, 32, ...) have from cell ``corner`` (x, y) on."""
        height, width = out.shape[:2]
        first = np.floor_divide(corner, TILE) - self.low
        last = np.floor_divide(corner + np.array([width - 1, height - 1]), TILE) - self.low
        for row in range(max(0, int(first[1])), min(self.rows - 1, int(last[1])) + 1):
            for column in range(max(0, int(first[0])), min(self.columns - 1, int(last[0])) + 1):
                number = self._number[row, column]
                if number >= 0:
                    x, y = (np.array([column, row]) + self.low) * TILE - corner
                    to_x, of_x = _overlap(int(x), width)
                    to_y, of_y = _overlap(int(y), height)
                    out[to_y, to_x] = values[number, of_y, of_x]


def _overlap(begin: int, size: int) -> tuple[slice, slice]:
    """Where a tile that begins at ``begin`` lies in an axis of ``size`` cells, and which of its cells that are."""
    low, high = max(0, begin), min(size, begin + TILE)
    return slice(low, high), slice(low - begin, high - begin)
