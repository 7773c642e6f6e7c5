"""Feature map: the learned features of a base map, one byte per number, in square tiles where the map has points.

The aerial network encodes bird's-eye views of the map in windows. These overlap by more than the network's reach, so
the result does not depend on their borders.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.descriptors.birds_eye_view import BIRDS_EYE_VIEW_VERSION, CELL, LAYERS, Image, birds_eye_view
from coview_stream.descriptors.network import (
    LOCAL_CELL,
    PLACE_CELL,
    VIEW_NAMES,
    Features,
    network,
    weights_file,
    weights_id,
)
from coview_stream.errors import InputError, MapError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Int8s, Ints
from coview_stream.geometry.transforms import Points

TILE = 32
"""Cells of 1 m along a tile's edge; tile (i, j) covers ``[32 i, 32 (i + 1))`` metres in x, likewise in y."""

_NAMES = ("local", "sigma", "tiles", "place", "place_at")  # of the arrays, after ``learned.``
_SCALE = 127.0  # the byte that stores 1
_MIN_SIGMA, _MAX_SIGMA = 0.02, 50.0  # range of the stored sigmas
_STEPS = 255.0 / np.log(_MAX_SIGMA / _MIN_SIGMA)  # of 3 %


class FeatureMap:
    """Learned features of a base map: its arrays ``learned.*``, which may be memory-mapped.

    Attributes:
        weights: :func:`weights_sha256` of the networks that computed them.
        index: numbers of the tiles.
        place: (K, P) int8 global descriptors times 127.
        place_at: (K, 2) float32 centres of their surroundings, metres, map frame.

    Raises:
        MapError: arrays are missing or inconsistent.
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
        """Number of components C of a local descriptor."""
        return int(self._local.shape[3])

    @property
    def bytes(self) -> int:
        """Size of all arrays."""
        return sum(int(a.nbytes) for a in (self._local, self._sigma, self.place, self.place_at))

    @cached_property
    def area(self) -> float:
        """Square metres with features; reads all of them once."""
        return float(sum(int(tile.any(axis=-1).sum()) for tile in self._local) * LOCAL_CELL**2)

    @property
    def tile_area(self) -> float:
        """Square metres of all tiles."""
        return len(self.index.tiles) * (TILE * LOCAL_CELL) ** 2

    @property
    def box_area(self) -> float:
        """Square metres of the rectangle around all tiles, the size of :meth:`coarse`."""
        return self.index.columns * self.index.rows * (TILE * LOCAL_CELL) ** 2

    @property
    def tile_centres(self) -> Floats:
        """(T, 2) centres of the tiles, metres, map frame."""
        return np.asarray((self.index.tiles + 0.5) * (TILE * LOCAL_CELL), dtype=np.float64)

    def sample(self, tiles: int) -> Floats32:
        """Return the features (C, N) of the cells of at most ``tiles`` tiles, evenly spread."""
        chosen = self._local[:: -(-len(self._local) // tiles) or 1]
        cells = np.asarray(chosen).reshape(-1, self.dimensions)
        return np.ascontiguousarray(dequantized(cells[cells.any(axis=1)]).T)

    def coarse(self, cell: float = 2.0, axes: Floats32 | None = None) -> tuple[Floats32, Floats]:
        """Return means (C, H, W) over cells of ``cell`` metres, a divisor of 32, and their lower corner (2,), metres.

        Cells without features count as zero. ``axes`` (D, C) projects the means: (D, H, W).
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
        """Check that the installed networks can be compared with these features.

        Raises:
            MapError: the features were computed by other weights, or from images of another version.
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
    """Average stored cells (h * ratio, w * ratio, C) over squares of ``ratio`` cells, (C, h, w)."""
    height, width, dimensions = (tile.shape[0] // ratio, tile.shape[1] // ratio, tile.shape[2])
    blocks = tile.reshape(height, ratio, width, ratio, dimensions).astype(np.float32)
    return np.ascontiguousarray(blocks.mean(axis=(1, 3)).transpose(2, 0, 1) * np.float32(1.0 / 127.0))


@lru_cache(maxsize=1)
def weights_sha256() -> str:
    """Return the sha256 of both networks' :func:`weights_id` and the images' version; empty if one has no weights."""
    try:
        parts = [weights_id(weights_file(view)) for view in VIEW_NAMES]
    except InputError:
        return ""
    return hashlib.sha256("\n".join([*parts, str(BIRDS_EYE_VIEW_VERSION)]).encode()).hexdigest()


def quantized(vectors: Floats32) -> Int8s:
    """Store numbers of magnitude 1 at most (any shape) as bytes, with an error of 0.004."""
    return np.asarray(np.rint(vectors * np.float32(_SCALE)), dtype=np.int8)


def dequantized(vectors: Int8s) -> Floats32:
    """Undo :func:`quantized`."""
    return np.asarray(vectors * np.float32(1.0 / _SCALE), dtype=np.float32)


def quantized_sigma(sigma: Floats32) -> npt.NDArray[np.uint8]:
    """Store positive sigmas (any shape) as bytes on a logarithmic scale, with 1.5 % error from 0.02 to 50."""
    steps = np.log(np.clip(sigma, _MIN_SIGMA, _MAX_SIGMA) / _MIN_SIGMA) * _STEPS
    return np.asarray(np.rint(steps), dtype=np.uint8)


class TileIndex:
    """Tile numbers (T, 2), column (x) and row (y), and the rectangle around them."""

    def __init__(self, tiles: npt.NDArray[np.int32]) -> None:
        self.tiles = np.array(tiles, dtype=np.int64).reshape(-1, 2)
        self.low = self.tiles.min(axis=0) if len(self.tiles) else np.zeros(2, dtype=np.int64)
        high = self.tiles.max(axis=0) + 1 if len(self.tiles) else self.low
        self.columns, self.rows = (int(n) for n in high - self.low)


def _overlap(begin: int, length: int, size: int) -> tuple[slice, slice]:
    """Return the overlap of an axis of ``size`` cells and ``length`` cells from ``begin``, as slices of both."""
    low, high = max(0, begin), max(0, min(size, begin + length))
    return slice(low, max(low, high)), slice(low - begin, max(low, high) - begin)


WINDOW = 256
"""Metres along the edge of a window, which is drawn and encoded at once; a multiple of a tile's edge."""

_DRAW_MARGIN = 48  # metres around a window whose points determine its ground
_NET_MARGIN = 64  # metres around a window, the network's reach: 30 for its layers, 28 to pool global descriptors
_KNOWN_RADIUS = 4  # metres around a point within which the map has features, to bridge shadows
_CELLS = round(1 / CELL)  # image cells a metre
_PER_PLACE = 2  # network's place cells along the edge of a stored one

Windows = dict[tuple[int, int], Image]


def feature_arrays(
    points: Points, progress: Callable[[int, int], None] | None = None, window: int = WINDOW
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return the arrays ``learned.*`` of a map, and the parameters ``weights`` and ``cell``.

    ``points`` (N, 3) are the map's, metres, z up, relative to its origin. ``progress`` is called with (windows done,
    windows). ``window`` is in metres, a multiple of 32.

    Raises:
        InputError: no weights.
    """
    encoder = network("aerial")
    low = np.floor(points[:, :2].min(axis=0) / TILE).astype(np.int64) * TILE
    high = (np.floor(points[:, :2].max(axis=0) / TILE).astype(np.int64) + 1) * TILE
    drawn = _drawn(points, low, high, window)
    parts: list[dict[str, npt.NDArray[Any]]] = []
    for done, (column, row) in enumerate(drawn):
        corner = low + np.array([column, row]) * window
        width, height = np.minimum(window, high - corner).tolist()
        around = _with_margin(drawn, column, row, width, height, window)
        parts.append(_stored(encoder(around), around, corner, (height, width)))
        if progress:
            progress(done + 1, len(drawn))
    arrays = {f"learned.{name}": np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return arrays, {"weights": weights_sha256(), "cell": LOCAL_CELL}


def features_of_square(points: Points, corner: Ints, size: int) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of :func:`feature_arrays` for one square of a map, without ``learned.`` in their names.

    ``points`` (N, 3) are those of the square and 112 m around it, metres, relative to the map's origin. Its lower
    ``corner`` (2,) and edge ``size`` are multiples of 32 m.

    Raises:
        InputError: no weights.
    """
    edge = (size + 2 * (_NET_MARGIN + _DRAW_MARGIN)) * _CELLS
    whole = birds_eye_view(points, (corner - _NET_MARGIN - _DRAW_MARGIN).astype(np.float32), (edge, edge))
    rim = _DRAW_MARGIN * _CELLS
    around = whole[:, rim:-rim, rim:-rim].copy()
    # one thread, as processes encode several squares at once
    return _stored(network("aerial", 1)(around), around, corner, (size, size))


def _drawn(points: Points, low: Ints, high: Ints, window: int) -> Windows:
    """Draw bird's-eye views of the windows with points, by column and row."""
    columns, rows = (-(-(high - low) // window)).tolist()
    views: Windows = {}
    for row in range(rows):
        band = points[_within(points[:, 1], low[1] + row * window, window, _DRAW_MARGIN)]
        for column in range(columns):
            part = band[_within(band[:, 0], low[0] + column * window, window, _DRAW_MARGIN)]
            corner = low + np.array([column, row]) * window
            inside = _within(part[:, 0], corner[0], window) & _within(part[:, 1], corner[1], window)
            if inside.any():
                width, height = np.minimum(window, high - corner).tolist()
                shape = ((height + 2 * _DRAW_MARGIN) * _CELLS, (width + 2 * _DRAW_MARGIN) * _CELLS)
                whole = birds_eye_view(part, (corner - _DRAW_MARGIN).astype(np.float32), shape)
                edge = _DRAW_MARGIN * _CELLS
                views[column, row] = whole[:, edge:-edge, edge:-edge].copy()
    return views


def _within(values: Floats32, begin: np.int64, size: int, margin: int = 0) -> Bools:
    low, high = float(begin - margin), float(begin + size + margin)
    return np.asarray((values >= low) & (values < high))


def _with_margin(views: Windows, column: int, row: int, width: int, height: int, window: int) -> Image:
    """Return a window's view with a margin of :data:`_NET_MARGIN` metres from its neighbours' views."""
    image = np.zeros((LAYERS, (height + 2 * _NET_MARGIN) * _CELLS, (width + 2 * _NET_MARGIN) * _CELLS), dtype=np.uint8)
    image[-1] = 128  # the relief is unknown
    reach = -(-_NET_MARGIN // window)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            other = views.get((column + i, row + j))
            if other is not None:
                x, y = ((k * window + _NET_MARGIN) * _CELLS for k in (i, j))
                to_x, of_x = _overlap(x, other.shape[2], image.shape[2])
                to_y, of_y = _overlap(y, other.shape[1], image.shape[1])
                image[:, to_y, to_x] = other[:, of_y, of_x]
    return image


def _stored(features: Features, image: Image, corner: Ints, shape: tuple[int, int]) -> dict[str, npt.NDArray[Any]]:
    """Quantize the features of tiles with points, without the margin."""
    height, width = shape
    mapped = _known(image)
    core = (slice(_NET_MARGIN, _NET_MARGIN + height), slice(_NET_MARGIN, _NET_MARGIN + width))
    vectors = quantized(features.local[:, core[0], core[1]].transpose(1, 2, 0))
    local = np.where(mapped[core][..., None], vectors, np.int8(0))
    sigma = np.where(mapped[core], quantized_sigma(features.sigma[core]), 255).astype(np.uint8)
    numbers = np.stack(np.meshgrid(np.arange(width // TILE), np.arange(height // TILE)), axis=-1)
    full = _in_tiles(mapped[core]).any(axis=(1, 2))
    place, place_at = _places(features.place, mapped[core], shape)
    return {
        "local": _in_tiles(local)[full],
        "sigma": _in_tiles(sigma)[full],
        "tiles": (numbers.reshape(-1, 2)[full] + corner // TILE).astype(np.int32),
        "place": place,
        "place_at": (place_at + corner).astype(np.float32),
    }


def _known(image: Image) -> Bools:
    """Return a mask of the 1 m cells (H, W) of an image within ``_KNOWN_RADIUS`` of a point."""
    filled = image[:-1].any(axis=0)
    rows, columns = (n // _CELLS for n in filled.shape)
    coarse = filled.reshape(rows, _CELLS, columns, _CELLS).any(axis=(1, 3))
    if not coarse.any():
        return np.asarray(coarse)
    from scipy import ndimage  # not needed to open a map

    return np.asarray(ndimage.distance_transform_edt(~coarse) <= _KNOWN_RADIUS)


def _in_tiles(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Cut cells (H, W, ...) into tiles (T, 32, 32, ...), row by row."""
    height, width, *rest = values.shape
    blocks = values.reshape(height // TILE, TILE, width // TILE, TILE, *rest)
    return np.asarray(blocks.swapaxes(1, 2).reshape(-1, TILE, TILE, *rest))


def _places(place: Floats32, mapped: Bools, shape: tuple[int, int]) -> tuple[Int8s, Floats]:
    """Pool global descriptors (P, h, w) over mapped squares of 8 m, like a query's: (K, P), with the centres (K, 2)."""
    edge, side = round(_NET_MARGIN / PLACE_CELL), round(PLACE_CELL * _PER_PLACE)
    height, width = (n // side for n in shape)
    inner = place[:, edge : edge + _PER_PLACE * height, edge : edge + _PER_PLACE * width]
    mean = inner.reshape(len(place), height, _PER_PLACE, width, _PER_PLACE).mean(axis=(2, 4))
    mean /= np.linalg.norm(mean, axis=0) + np.float32(1e-9)
    row, column = np.nonzero(mapped.reshape(height, side, width, side).any(axis=(1, 3)))
    at = np.asarray((np.column_stack([column, row]) + 0.5) * side, dtype=np.float64)
    return quantized(mean[:, row, column].T), at
