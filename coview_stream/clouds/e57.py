"""E57 files: all their scans, each by its pose, in the file's frame. Needs ``pye57`` (extra ``e57``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.reference_system import flaw_of_system
from coview_stream.errors import CloudError, require_library
from coview_stream.geometry.arrays import Floats

CHUNK = 500_000
"""Points that are read at a time, set by hand."""

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = {_CARTESIAN: "cartesianInvalidState", _SPHERICAL: "sphericalInvalidState"}


def require_pye57() -> Any:
    """Return pye57; DependencyError where it is not installed."""
    return require_library("pye57", "pye57>=0.4", "E57 files")


def decode(path: Path, make: Callable[[str | None], CloudBuilder]) -> CloudBuilder:
    """Read a file, chunk by chunk, in this process, into ``make`` of its reference system.

    Points that the scanner calls invalid are dropped and counted.

    Raises:
        CloudError: the file is damaged, or not in metres. DependencyError: there is no pye57.
    """
    pye57 = require_pye57()
    try:
        file = pye57.E57(str(path))
        crs = _reference_system(file)
        builder = make(crs)
        extent = np.array([[np.inf] * 3, [-np.inf] * 3])
        for index in range(file.scan_count):
            for points, dropped in _scan(file, index):
                if len(points):
                    extent = np.stack(
                        [np.minimum(extent[0], points.min(axis=0)), np.maximum(extent[1], points.max(axis=0))]
                    )
                builder.add(points, np.zeros(len(points), np.uint8), dropped)
    except (CloudError, MemoryError):
        raise
    except Exception as error:  # the library's own, which derive from none of Python's but Exception
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise CloudError(f"{path}: damaged or truncated E57 ({reason}); export the file again") from error
    flaw = flaw_of_system(crs, {}, *extent) if np.isfinite(extent).all() else None
    if flaw is not None:
        raise CloudError(f"{path}: {flaw}")
    return builder


def _reference_system(file: Any) -> str | None:
    try:
        text = str(file.root["coordinateMetadata"].value()).strip()
    except Exception:  # absent, or no text
        return None
    return text or None


def _scan(file: Any, index: int) -> Any:
    """Yield the points (N, 3) of a scan in the file's frame, chunk by chunk, and how many were invalid."""
    header = file.get_header(index)
    names = next((kind for kind in (_CARTESIAN, _SPHERICAL) if set(kind) <= set(header.point_fields)), None)
    if names is None:
        raise ValueError(f"scan {index} has neither cartesian nor spherical coordinates")
    invalid = _INVALID[names]
    fields = [*names, *([invalid] if invalid in header.point_fields else [])]
    values, buffers = file.make_buffers(fields, CHUNK)
    rotation, translation = _pose(header)
    reader = header.points.reader(buffers)
    while (count := reader.read()) > 0:
        columns = [np.asarray(values[name][:count], dtype=np.float64) for name in names]
        valid = np.asarray(values[invalid][:count]) == 0 if invalid in fields else np.ones(count, dtype=bool)
        points = np.stack(columns, axis=1)[valid]
        if names == _SPHERICAL:
            points = _cartesian(points)
        yield points @ rotation.T + translation, int(count - valid.sum())


def _pose(header: Any) -> tuple[Floats, Floats]:
    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    return np.asarray(header.rotation_matrix, dtype=np.float64), np.asarray(header.translation, dtype=np.float64)


def _cartesian(spherical: Floats) -> Floats:
    """Return (N, 3) x, y, z of ranges, azimuths and elevations (N, 3), metres and radians."""
    reach, azimuth, elevation = spherical.T
    flat = reach * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(elevation)], axis=1)
