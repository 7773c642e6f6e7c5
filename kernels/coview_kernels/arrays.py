"""Array types that the kernels share, and the checks of their arguments.

Every public kernel checks its arguments here before any arithmetic; the error names the argument.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
I8 = npt.NDArray[np.int8]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U64 = npt.NDArray[np.uint64]
C64 = npt.NDArray[np.complex64]
Mask = npt.NDArray[np.bool_]


class PolarGrid(NamedTuple):
    """Heights and counts in rings x sectors around a centre; bins without points hold 0 in all."""

    max_height: F32
    """(..., R, S) greatest height above the centre, metres."""
    count: I32  # type: ignore[assignment]  # hides tuple.count, which is not needed here
    """(..., R, S) number of points, which alone shows that a bin is occupied, as 0 is a valid height."""
    mean_height: F32 | None = None
    """(..., R, S) mean height above the centre, metres, for :func:`paper_context`; None if not requested."""


class Raster(NamedTuple):
    """Values (NX, NY) of square cells."""

    values: npt.NDArray[Any]
    corner: F64
    """(2,) x and y of the first cell's corner, metres."""
    cell: float
    """Edge of a cell, metres."""


class OverheadGrid(NamedTuple):
    """Square cells seen from above; row along y, column along x."""

    x: float
    y: float
    """Lower corner of cell (0, 0), metres; float32 in use."""
    cell: float
    """Edge of a cell, metres."""
    shape: tuple[int, int]
    """Rows and columns."""


def as_float32(name: str, value: npt.ArrayLike, *shape: int | None) -> F32:
    """Return ``value`` as a C-contiguous float32 array of ``shape`` (None: any length); ValueError otherwise."""
    return _as_array(name, value, np.float32, shape)


def as_int32(name: str, value: npt.ArrayLike, *shape: int | None) -> I32:
    """Return ``value`` as a C-contiguous int32 array of ``shape`` (None: any length); ValueError otherwise."""
    return _as_array(name, value, np.int32, shape)


def as_finite64(name: str, value: npt.ArrayLike, *shape: int | None) -> F64:
    """Return ``value`` as a C-contiguous float64 array of ``shape`` without NaN or inf; ValueError otherwise."""
    array: F64 = _as_array(name, value, np.float64, shape)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or inf")
    return array


def _as_array(name: str, value: npt.ArrayLike, dtype: Any, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
    array = np.ascontiguousarray(value, dtype=dtype)
    fits = array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name} has shape {np.shape(value)}, expected {wanted}")
    return array


def check_same_shape(name: str, array: npt.NDArray[Any], other: str, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless ``array`` has the ``shape`` of ``other``."""
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, but {other} has {shape}")


def check_grid_size(rings: int, sectors: int, r_max: float) -> None:
    """Raise ValueError unless ``r_max`` is finite and positive, with 1 to 100,000 bins, which float32 resolves."""
    if rings < 1 or sectors < 1 or rings * sectors > 100_000:
        raise ValueError(f"rings and sectors must be at least 1, with 100,000 bins at most, got {rings} and {sectors}")
    if not (math.isfinite(r_max) and r_max > 0):
        raise ValueError(f"r_max must be finite and positive, got {r_max}")
