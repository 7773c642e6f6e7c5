"""Feature map: the learned features of a base map, one byte a number, in square tiles where the map has points."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.descriptors.birds_eye_view import BIRDS_EYE_VIEW_VERSION
from coview_stream.descriptors.network import LOCAL_CELL, VIEW_NAMES, file_sha256, weights_file
from coview_stream.errors import InputError, MapError
from coview_stream.geometry.arrays import Floats, Floats32, Int8s, Ints, Reals

TILE = 32
"""Cells of 1 m along a tile's edge; tile (i, j) covers ``[32 i, 32 (i + 1))`` metres in x, likewise in y."""

_NAMES = ("local", "sigma", "tiles", "place", "place_at")
_SCALE = 127.0
_MIN_SIGMA, _MAX_SIGMA = 0.02, 50.0  # range of the stored sigmas; set by hand
_STEPS = 255.0 / np.log(_MAX_SIGMA / _MIN_SIGMA)  # of 3 %


@dataclass(frozen=True)
class Patch:
    """Features of a map around a place.

    Attributes:
        local: (C, h, w) float32 of unit norm, zero where the map has nothing; cells of 1 m.
        sigma: (h, w) float32, uncertainty of each cell as a keypoint; of no meaning where ``local`` is zero.
        corner: (2,) x and y of the lower corner of cell (0, 0), metres, map frame.
    """

    local: Floats32
    sigma: Floats32
    corner: Floats


class FeatureMap:
    """Learned features of a base map: its arrays ``learned.*``, which may be memory-mapped.

    Attributes:
        weights: :func:`weights_sha256` of the networks that made them.
        place: (K, P) int8 global descriptors times 127.
        place_at: (K, 2) float32 where they were made, metres, map frame.

    Raises:
        MapError: some of the arrays are missing or do not fit together.
    """

    def __init__(self, arrays: dict[str, npt.NDArray[Any]], parameters: dict[str, Any]) -> None:
        try:
            local, sigma, tiles, place, place_at = (arrays[f"learned.{name}"] for name in _NAMES)
            self.weights = str(parameters["weights"])
            fits = local.ndim == 4 and local.shape[:3] == sigma.shape == (len(tiles), TILE, TILE)
            fits &= tiles.shape[1:] == (2,) and place.ndim == 2 and place_at.shape == (len(place), 2)
            if not fits or float(parameters["cell"]) != LOCAL_CELL:
                raise ValueError("their shapes do not fit together")
            self.index = TileIndex(tiles)
        except (KeyError, TypeError, ValueError, IndexError, MemoryError) as error:
            raise MapError(
                f"the map's learned features cannot be read ({error}); build it again with "
                "'coview-stream build --learned'"
            ) from error
        self._local, self._sigma, self.place, self.place_at = local, sigma, place, np.array(place_at)

    @property
    def dimensions(self) -> int:
        """Numbers C in a local descriptor."""
        return int(self._local.shape[3])

    @property
    def bytes(self) -> int:
        """Size of all arrays."""
        return sum(int(a.nbytes) for a in (self._local, self._sigma, self.place, self.place_at))

    @cached_property
    def area(self) -> float:
        """Square metres that have features; reads all of them once."""
        return float(sum(int(tile.any(axis=-1).sum()) for tile in self._local) * LOCAL_CELL**2)

    @property
    def tile_area(self) -> float:
        """Square metres of all tiles."""
        return len(self.index.tiles) * (TILE * LOCAL_CELL) ** 2

    @property
    def box_area(self) -> float:
        """Square metres of the rectangle around all tiles, which coarse features fill."""
        return self.index.columns * self.index.rows * (TILE * LOCAL_CELL) ** 2

    @property
    def tile_centres(self) -> Floats:
        """(T, 2) middles of the tiles, metres, map frame."""
        return np.asarray((self.index.tiles + 0.5) * (TILE * LOCAL_CELL), dtype=np.float64)

    def patch(self, centre: Reals, reach: float) -> Patch:
        """Return all within ``reach`` metres of ``centre`` (x and y, map frame), rounded outwards to whole cells."""
        low = np.floor((np.asarray(centre, dtype=np.float64)[:2] - reach) / LOCAL_CELL).astype(np.int64)
        high = np.ceil((np.asarray(centre, dtype=np.float64)[:2] + reach) / LOCAL_CELL).astype(np.int64)
        width, height = (int(n) for n in high - low)
        local = np.zeros((height, width, self.dimensions), dtype=np.int8)
        sigma = np.full((height, width), 255, dtype=np.uint8)
        self.index.gather(self._local, low, local)
        self.index.gather(self._sigma, low, sigma)
        vectors = np.ascontiguousarray(dequantized(local).transpose(2, 0, 1))
        return Patch(vectors, dequantized_sigma(sigma), np.asarray(low * LOCAL_CELL, dtype=np.float64))

    def sample(self, tiles: int) -> Floats32:
        """Return the features (C, N) of all cells that have any, of that many tiles or fewer, spread evenly."""
        chosen = self._local[:: -(-len(self._local) // tiles) or 1]
        cells = np.asarray(chosen).reshape(-1, self.dimensions)
        return np.ascontiguousarray(dequantized(cells[cells.any(axis=1)]).T)

    def coarse(self, cell: float = 2.0, axes: Floats32 | None = None) -> tuple[Floats32, Floats]:
        """Return means (C, H, W) over cells of ``cell`` metres, a divisor of 32, and their lower corner (2,), metres.

        Cells without features count as zero. With ``axes`` (D, C) their components along these are returned: (D, H, W).
        """
        ratio, side = round(cell / LOCAL_CELL), round(TILE * LOCAL_CELL / cell)
        dimensions = self.dimensions if axes is None else len(axes)
        shape = (dimensions, self.index.rows * side, self.index.columns * side)
        whole = np.zeros(shape, dtype=np.float32)
        for (column, row), tile in zip(self.index.tiles - self.index.low, self._local, strict=True):
            rows, columns = (slice(n * side, (n + 1) * side) for n in (int(row), int(column)))
            cells = means(np.asarray(tile), ratio)
            whole[:, rows, columns] = cells if axes is None else np.tensordot(axes, cells, 1)
        return whole, np.asarray(self.index.low * (TILE * LOCAL_CELL), dtype=np.float64)

    def check(self) -> None:
        """Refuse to compare these features with those of another network.

        Raises:
            MapError: they were made by other weights than the installed ones, or of images of another version.
            InputError: there are no weights.
        """
        for view in VIEW_NAMES:
            weights_file(view)
        here = weights_sha256()
        if here != self.weights:
            raise MapError(
                f"the map's learned features are of other weights ({self.weights[:12]}) than the installed ones "
                f"({here[:12]}); build it again, or go without them (--reloc coview)"
            )


def means(tile: Int8s, ratio: int) -> Floats32:
    """Average stored cells (h * ratio, w * ratio, C) over squares of ``ratio`` cells: (C, h, w)."""
    height, width, dimensions = (tile.shape[0] // ratio, tile.shape[1] // ratio, tile.shape[2])
    blocks = tile.reshape(height, ratio, width, ratio, dimensions).astype(np.float32)
    return np.ascontiguousarray(blocks.mean(axis=(1, 3)).transpose(2, 0, 1) * np.float32(1.0 / 127.0))


@lru_cache(maxsize=1)
def weights_sha256() -> str:
    """Return the sha256 of both networks' weights and the images' version; empty if a network has no weights."""
    try:
        parts = [file_sha256(weights_file(view)) for view in VIEW_NAMES]
    except InputError:
        return ""
    return hashlib.sha256("\n".join([*parts, str(BIRDS_EYE_VIEW_VERSION)]).encode()).hexdigest()


def quantized(vectors: Floats32) -> Int8s:
    """Store numbers of magnitude 1 at most (any shape) as bytes; off by 0.004 each."""
    return np.asarray(np.rint(vectors * np.float32(_SCALE)), dtype=np.int8)


def dequantized(vectors: Int8s) -> Floats32:
    """Undo :func:`quantized`."""
    return np.asarray(vectors * np.float32(1.0 / _SCALE), dtype=np.float32)


def quantized_sigma(sigma: Floats32) -> npt.NDArray[np.uint8]:
    """Store positive sigmas (any shape) as bytes on a logarithmic scale; off by 1.5 % between 0.02 and 50."""
    steps = np.log(np.clip(sigma, _MIN_SIGMA, _MAX_SIGMA) / _MIN_SIGMA) * _STEPS
    return np.asarray(np.rint(steps), dtype=np.uint8)


def dequantized_sigma(sigma: npt.NDArray[np.uint8]) -> Floats32:
    """Undo :func:`quantized_sigma`."""
    return np.asarray(_MIN_SIGMA * np.exp(sigma / _STEPS), dtype=np.float32)


class TileIndex:
    """Look-up of tiles by their place; made of (T, 2) tile numbers, column (x) and row (y)."""

    def __init__(self, tiles: npt.NDArray[np.int32]) -> None:
        self.tiles = np.array(tiles, dtype=np.int64).reshape(-1, 2)
        self.low = self.tiles.min(axis=0) if len(self.tiles) else np.zeros(2, dtype=np.int64)
        high = self.tiles.max(axis=0) + 1 if len(self.tiles) else self.low
        self.columns, self.rows = (int(n) for n in high - self.low)
        self._number = np.full((self.rows, self.columns), -1, dtype=np.int64)
        self._number[tuple((self.tiles - self.low).T[::-1])] = np.arange(len(self.tiles))

    def gather(self, values: npt.NDArray[Any], corner: Ints, out: npt.NDArray[Any]) -> None:
        """Copy ``values`` (T, 32, 32, ...) from cell ``corner`` (x, y) on into ``out`` (h, w, ...)."""
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
    """Return slices of an axis of ``size`` cells and of a tile that begins at its cell ``begin``: their overlap."""
    low, high = max(0, begin), min(size, begin + TILE)
    return slice(low, high), slice(low - begin, high - begin)
