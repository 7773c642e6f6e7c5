"""Building of a map's learned features: bird's-eye views of its cloud, and the aerial network over them, by windows.

Windows overlap by more than the network's reach, so the result does not depend on where they lie.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS, Image, birds_eye_view
from coview_stream.descriptors.feature_map import TILE, quantized, quantized_sigma, weights_sha256
from coview_stream.descriptors.network import LOCAL_CELL, PLACE_CELL, Features, network
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Int8s, Ints
from coview_stream.geometry.transforms import Points

WINDOW = 256
"""Metres along the edge of a window, drawn and encoded at a time; a multiple of a tile's edge; set by hand."""

_DRAW_MARGIN = 48  # metres around a window whose points determine its ground; set by hand
_NET_MARGIN = 64  # metres around a window that the network sees: 30 m for its layers, 28 for GeM's disk
_KNOWN_RADIUS = 4  # metres from the nearest point within which the map is known, to bridge shadows; set by hand
_CELLS = round(1 / CELL)  # image cells a metre
_PER_PLACE = 2  # cells of the network's global descriptors along the edge of a stored one's

Windows = dict[tuple[int, int], Image]


def feature_arrays(
    points: Points, progress: Callable[[int, int], None] | None = None, window: int = WINDOW
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return the arrays ``learned.*`` of a map, and the parameters that name the weights and the cell.

    Args:
        points: (N, 3) the map's cloud, metres, z up, relative to the map's origin.
        progress: called with windows done and all windows.
        window: metres at a time, a multiple of 32.

    Raises:
        DependencyError: no onnxruntime. InputError: no weights.
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
    """Return the features of one square of a map, by the names of :class:`FeatureMap` without ``learned.``.

    Args:
        points: (N, 3) of the square and 112 m around it, metres, relative to the map's origin.
        corner: (2,) its lower corner, multiples of 32 m.
        size: its edge, a multiple of 32 m.

    Raises:
        DependencyError: no onnxruntime. InputError: no weights.
    """
    edge = (size + 2 * (_NET_MARGIN + _DRAW_MARGIN)) * _CELLS
    whole = birds_eye_view(points, (corner - _NET_MARGIN - _DRAW_MARGIN).astype(np.float32), (edge, edge))
    rim = _DRAW_MARGIN * _CELLS
    around = whole[:, rim:-rim, rim:-rim].copy()
    # one thread: sums in another order could round another way
    return _stored(network("aerial", 1)(around), around, corner, (size, size))


def _drawn(points: Points, low: Ints, high: Ints, window: int) -> Windows:
    """Draw bird's-eye views of the windows that have points, by column and row."""
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
    """Return a window's view with :data:`_NET_MARGIN` metres of its neighbours' on every side."""
    image = np.zeros((LAYERS, (height + 2 * _NET_MARGIN) * _CELLS, (width + 2 * _NET_MARGIN) * _CELLS), dtype=np.uint8)
    image[-1] = 128  # nothing is known of the ground there
    reach = -(-_NET_MARGIN // window)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            other = views.get((column + i, row + j))
            if other is not None:
                x, y = ((k * window + _NET_MARGIN) * _CELLS for k in (i, j))
                to_x, of_x = _clipped(x, other.shape[2], image.shape[2])
                to_y, of_y = _clipped(y, other.shape[1], image.shape[1])
                image[:, to_y, to_x] = other[:, of_y, of_x]
    return image


def _clipped(begin: int, length: int, size: int) -> tuple[slice, slice]:
    low, high = max(0, begin), max(0, min(size, begin + length))
    return slice(low, max(low, high)), slice(low - begin, max(low, high) - begin)


def _stored(features: Features, image: Image, corner: Ints, shape: tuple[int, int]) -> dict[str, npt.NDArray[Any]]:
    """Quantize the features without their margin, of the tiles that have points."""
    height, width = shape
    known = _known(image)
    core = (slice(_NET_MARGIN, _NET_MARGIN + height), slice(_NET_MARGIN, _NET_MARGIN + width))
    vectors = quantized(features.local[:, core[0], core[1]].transpose(1, 2, 0))
    local = np.where(known[core][..., None], vectors, np.int8(0))
    sigma = np.where(known[core], quantized_sigma(features.sigma[core]), 255).astype(np.uint8)
    numbers = np.stack(np.meshgrid(np.arange(width // TILE), np.arange(height // TILE)), axis=-1)
    full = _in_tiles(known[core]).any(axis=(1, 2))
    place, place_at = _places(features.place, known[core], shape)
    return {
        "local": _in_tiles(local)[full],
        "sigma": _in_tiles(sigma)[full],
        "tiles": (numbers.reshape(-1, 2)[full] + corner // TILE).astype(np.int32),
        "place": place,
        "place_at": (place_at + corner).astype(np.float32),
    }


def _known(image: Image) -> Bools:
    """Mask the 1 m cells (H, W) of an image that are near points."""
    filled = image[:-1].any(axis=0)
    rows, columns = (n // _CELLS for n in filled.shape)
    coarse = filled.reshape(rows, _CELLS, columns, _CELLS).any(axis=(1, 3))
    if not coarse.any():
        return np.asarray(coarse)
    return np.asarray(ndimage.distance_transform_edt(~coarse) <= _KNOWN_RADIUS)


def _in_tiles(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Cut cells (H, W, ...) into tiles (T, 32, 32, ...), row by row."""
    height, width, *rest = values.shape
    blocks = values.reshape(height // TILE, TILE, width // TILE, TILE, *rest)
    return np.asarray(blocks.swapaxes(1, 2).reshape(-1, TILE, TILE, *rest))


def _places(place: Floats32, known: Bools, shape: tuple[int, int]) -> tuple[Int8s, Floats]:
    """Pool global descriptors (K, P) over squares of 8 m, as a query does its four middle cells; also their middles."""
    edge, side = round(_NET_MARGIN / PLACE_CELL), round(PLACE_CELL * _PER_PLACE)
    height, width = (n // side for n in shape)
    inner = place[:, edge : edge + _PER_PLACE * height, edge : edge + _PER_PLACE * width]
    mean = inner.reshape(len(place), height, _PER_PLACE, width, _PER_PLACE).mean(axis=(2, 4))
    mean /= np.linalg.norm(mean, axis=0) + np.float32(1e-9)
    wanted = known.reshape(height, side, width, side).any(axis=(1, 3))
    row, column = np.nonzero(wanted)
    at = np.asarray((np.column_stack([column, row]) + 0.5) * side, dtype=np.float64)
    return quantized(mean[:, row, column].T), at
