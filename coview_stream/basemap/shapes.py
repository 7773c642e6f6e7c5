"""Shapes and types of a map's arrays, compared once when it is loaded: what is used later may rely on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.reference.field import TILE as FIELD_TILE
from coview_stream.config import MapConfig
from coview_stream.errors import MapError

_Shape = tuple[str | int, ...]

_EXPECTED: dict[str, tuple[str, _Shape]] = {
    "origin": ("<f8", (3,)),
    "stations": ("<f4", ("stations", 3)),
    "points": ("<f4", ("points", 3)),
    "normals": ("|i1", ("points", 3)),
    "tile_index": ("<i8", ("tiles", 4)),
    "surveyed": ("|u1", ("rows", "columns")),
    "surveyed_corner": ("<f8", (2,)),
    **{
        f"station_codes{tier}{part}": what
        for tier in ("", ".rest")
        for part, what in {
            "": ("<i2", ("stations", 16, 16)),
            ".basis": ("<f4", (16, 16, "columns of the basis", 2)),
            ".step": ("<f4", (16, 2, 16)),
            ".norm": ("<f4", (33,)),
        }.items()
    },
    "field.tiles": ("<i4", ("field tiles", 3)),
    "field.occupied": ("<i8", ("field tiles", FIELD_TILE, FIELD_TILE)),
    "field.ground": ("<i2", ("field tiles", FIELD_TILE, FIELD_TILE)),
    "field.edge": ("|u1", ("field tiles", FIELD_TILE, FIELD_TILE)),
    "learned.local": ("|i1", ("learned tiles", "learned rows", "learned columns", "features")),
    "learned.sigma": ("|u1", ("learned tiles", "learned rows", "learned columns")),
    "learned.tiles": ("<i4", ("learned tiles", 2)),
    "learned.place": ("|i1", ("places", "numbers")),
    "learned.place_at": ("<f4", ("places", 2)),
}
"""Type and shape of each array; a dimension with a name is as long wherever it occurs."""

_MAX_METRES = 1e7  # set by hand, of a corner or a station: no map of the Earth is larger


def check_arrays(arrays: Mapping[str, npt.NDArray[Any]], config: MapConfig) -> None:
    """Compare type, shape and what else is read as an index.

    Raises:
        MapError: an array is not what a map of this configuration has; the message names it.
    """
    descriptor = ("<f2", ("stations", config.descriptor.rings, config.descriptor.sectors))
    expected = _EXPECTED | {f"descriptor.{name}": descriptor for name in config.descriptor.channels}
    known: dict[str, int] = {}
    for name, (kind, dimensions) in expected.items():
        array = arrays.get(name)
        if array is None:
            continue  # which ones there have to be, the map says itself
        if array.dtype != np.dtype(kind) or array.ndim != len(dimensions):
            raise _refused(
                name, f"is {array.dtype} {array.shape}, not {np.dtype(kind)} in {len(dimensions)} dimensions"
            )
        for found, dimension in zip(array.shape, dimensions, strict=True):
            length = dimension if isinstance(dimension, int) else known.setdefault(dimension, found)
            if found != length:
                raise _refused(name, f"has the shape {array.shape}, with {found} where {length} were expected")
    _check_values(arrays)


def _check_values(arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    if not np.isfinite(arrays["origin"]).all():
        raise _refused("origin", "is not finite")
    for name in ("surveyed_corner", "stations"):
        with np.errstate(invalid="ignore"):
            # false for NaN as well
            if not (np.abs(arrays[name]) < _MAX_METRES).all():
                raise _refused(name, f"is not finite, or beyond {_MAX_METRES:g} m")
    begin, end = arrays["tile_index"][:, 2], arrays["tile_index"][:, 3]
    if not ((begin >= 0) & (begin <= end) & (end <= len(arrays["points"]))).all():
        raise _refused("tile_index", "names points that are not there")


def _refused(name: str, what: str) -> MapError:
    return MapError(f"the map's {name} {what}; copy or build it again")
