"""Argument checks: every public kernel fails here, by name, before any arithmetic."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.arrays import F32, F64, I32


def _array(name: str, value: npt.ArrayLike, dtype: Any, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
    array = np.ascontiguousarray(value, dtype=dtype)
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name} has shape {np.shape(value)}, expected {wanted}")
    return array


def float32(name: str, value: npt.ArrayLike, *shape: int | None) -> F32:
    """``value`` as a C-contiguous float32 array of ``shape`` (None: any length); ValueError otherwise."""
    return _array(name, value, np.float32, shape)


def int32(name: str, value: npt.ArrayLike, *shape: int | None) -> I32:
    """``value`` as a C-contiguous int32 array of ``shape``; ValueError otherwise."""
    return _array(name, value, np.int32, shape)


def finite64(name: str, value: npt.ArrayLike, *shape: int | None) -> F64:
    """``value`` as a C-contiguous float64 array of ``shape`` without NaN or inf; ValueError otherwise."""
    array: F64 = _array(name, value, np.float64, shape)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or inf")
    return array


def grid_size(rings: int, sectors: int, r_max: float) -> None:
    """Raise ValueError unless there is at least one ring and sector and ``r_max`` is finite and positive."""
    if rings < 1 or sectors < 1:
        raise ValueError(f"rings and sectors must be at least 1, got {rings} and {sectors}")
    if not (math.isfinite(r_max) and r_max > 0):
        raise ValueError(f"r_max must be finite and positive, got {r_max}")


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise ValueError unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")


def same_shape(name: str, array: npt.NDArray[Any], other: str, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless ``array`` has ``shape``, which is that of ``other``."""
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, but {other} has {shape}")


def visibility(vertical: str, mode: str, eye: float) -> None:
    """Raise ValueError unless the options of co-visibility are known and ``eye`` is finite."""
    one_of("vertical", vertical, ("max", "mean", "off"))
    one_of("mode", mode, ("paper", "eye", "off"))
    if not math.isfinite(eye):
        raise ValueError(f"eye must be finite, got {eye}")
