"""E57 files: all scans, transformed by their poses to the file's frame. Needs ``pye57`` (extra ``e57``)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.reference_system import flaw_of_system
from coview_stream.errors import CloudError, require_library
from coview_stream.geometry.arrays import Floats

_CHUNK = 500_000  # points read at a time
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = {_CARTESIAN: "cartesianInvalidState", _SPHERICAL: "sphericalInvalidState"}


def require_pye57() -> Any:
    """Return pye57; DependencyError if it is not installed."""
    return require_library("pye57", "pye57>=0.4", "E57 files")


def decode(path: Path, builder: CloudBuilder) -> None:
    """Read a file chunk by chunk into a builder, in this process, with its reference system.

    Points that the scanner marks as invalid are dropped and counted. CloudError if it is damaged, or not in metres.
    """
    pye57 = require_pye57()
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    try:
        file = pye57.E57(str(path))
        with contextlib.suppress(Exception):  # absent, or no text
            builder.crs = str(file.root["coordinateMetadata"].value()).strip() or None
        for index in range(file.scan_count):
            for points, dropped in _scan(file, index):
                if len(points):
                    low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
                builder.add(points, np.zeros(len(points), np.uint8), dropped)
    except (CloudError, MemoryError):
        raise
    except Exception as error:  # pye57 raises exceptions of its own
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise CloudError(f"{path}: damaged or truncated E57 ({reason}); export the file again") from error
    flaw = flaw_of_system(builder.crs, {}, low, high) if np.isfinite([low, high]).all() else None
    if flaw is not None:
        raise CloudError(f"{path}: {flaw}")


def _scan(file: Any, index: int) -> Iterator[tuple[Floats, int]]:
    """Yield a scan's points (N, 3) in the file's frame and the number of invalid points, chunk by chunk."""
    header = file.get_header(index)
    names = next((kind for kind in (_CARTESIAN, _SPHERICAL) if set(kind) <= set(header.point_fields)), None)
    if names is None:
        raise ValueError(f"scan {index} has neither cartesian nor spherical coordinates")
    invalid = _INVALID[names]
    fields = [*names, *([invalid] if invalid in header.point_fields else [])]
    values, buffers = file.make_buffers(fields, _CHUNK)
    rotation, translation = np.eye(3), np.zeros(3)
    if header.has_pose():
        rotation = np.asarray(header.rotation_matrix, dtype=np.float64)
        translation = np.asarray(header.translation, dtype=np.float64)
    reader = header.points.reader(buffers)
    while (count := reader.read()) > 0:
        columns = [np.asarray(values[name][:count], dtype=np.float64) for name in names]
        valid = np.asarray(values[invalid][:count]) == 0 if invalid in fields else np.ones(count, dtype=bool)
        points = np.stack(columns, axis=1)[valid]
        if names == _SPHERICAL:
            distance, azimuth, elevation = points.T  # metres and radians
            flat = distance * np.cos(elevation)
            columns = [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)]
            points = np.stack(columns, axis=1)
        yield points @ rotation.T + translation, int(count - valid.sum())
