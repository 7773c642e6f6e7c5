"""Heads of cloud files, and the check, before any is read whole, that several files belong to one site."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coview_stream.clouds.cloud import Cloud
from coview_stream.clouds.files import check_format
from coview_stream.clouds.las import read_header, system_of
from coview_stream.clouds.reference_system import same_system, short_name
from coview_stream.clouds.survey_unit import SurveyUnit
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Bools, Floats

_MAX_GAP = 1000.0  # metres between tiles of one site; a lake or a field may lie between them
_FAR_GAP = 10_000.0  # metres: files farther apart are not one site
_MAX_AREA = 50e6  # square metres of a site's bounding box: limit of a build's rasters with cells of 0.5 m
_SAMPLED_POINTS = 100_000  # of a cloud, to measure its extent
_STRAY = 0.5  # per cent of the points at either end that the extent excludes


@dataclass(frozen=True, eq=False)
class CloudHead:
    """Facts about a cloud file.

    Attributes:
        path: path of the file.
        crs: reference system, as :attr:`Cloud.crs`.
        points: number of points; 0 if the format does not state it.
        unit: unit of the file, if its points are converted to metres.
        low, high: (3,) float64 corners of the extent, metres; None if the format does not state them.
    """

    path: Path
    crs: str | None = None
    low: Floats | None = None
    high: Floats | None = None
    points: int = 0
    unit: SurveyUnit | None = None


def read_head(path: str | os.PathLike[str]) -> CloudHead:
    """Return the head of a file, checked as far as possible without reading its points.

    CloudError as in :func:`~coview_stream.clouds.files.read_cloud`.
    """
    path = Path(path)
    if check_format(path) != "LAS":
        return CloudHead(path)
    header = read_header(path)
    low, high = header.mins, header.maxs
    stated = header.point_count > 0 and bool(np.isfinite([low, high]).all())
    crs, unit = system_of(path, header)
    if unit is not None:
        low, high = unit.to_metres(low), unit.to_metres(high)
    return CloudHead(path, crs, low if stated else None, high if stated else None, int(header.point_count), unit)


def extent_in_words(cloud: Cloud) -> str:
    """Return a cloud's extent without stray points: ``902 x 750 x 24 m``."""
    low, high = _extent(cloud)
    return " x ".join(f"{metres:.3g}" if metres < 100 else f"{metres:.0f}" for metres in high - low) + " m"


def _extent(cloud: Cloud) -> Floats:
    sample = cloud.points[:: max(1, len(cloud) // _SAMPLED_POINTS)].astype(np.float64)
    corners: Floats = np.percentile(sample, [_STRAY, 100.0 - _STRAY], axis=0) + cloud.origin
    return corners


def head_of(path: Path, cloud: Cloud) -> CloudHead:
    """Return the head of a file that was read, with its extent without stray points.

    CloudError if the extent is too large for a map.
    """
    low, high = _extent(cloud)
    wide = high - low
    if wide[0] * wide[1] > _MAX_AREA:
        raise CloudError(
            f"{path}: extends over {wide[0] / 1000:.0f} x {wide[1] / 1000:.0f} km, heights over {wide[2]:.0f} m; "
            f"a map holds {_MAX_AREA / 1e6:.0f} km2 at most: is it in millimetres or centimetres? Convert it to "
            "metres, or cut it into sites"
        )
    return CloudHead(path, cloud.crs, low, high)


def check_together(heads: Sequence[CloudHead]) -> str | None:
    """Check by their heads that files can be one site; return a sentence about an unusual gap, else None.

    CloudError names two files that have different reference systems or are too far apart for a map.
    """
    stated = [head for head in heads if head.crs is not None]
    for head in stated[1:]:
        if not same_system(stated[0].crs, head.crs):
            raise CloudError(
                f"{stated[0].path} is in {short_name(stated[0].crs)}, {head.path} in {short_name(head.crs)}; "
                "reproject one of them"
            )
    boxes = [(h.path, h.low[:2], h.high[:2]) for h in heads if h.low is not None and h.high is not None]
    if len(boxes) < 2:
        return None
    paths, low, high = (np.array(column) for column in zip(*boxes, strict=True))
    near = _connected(low, high)
    if near.all():
        return None
    far = ~near if near.sum() >= (~near).sum() else near
    gap, one, other = np.inf, 0, 0  # smallest gap between a file in ``far`` and another file
    for at in np.flatnonzero(far).tolist():
        gaps = np.where(far, np.inf, _gaps(low, high, at))
        if gaps.min() < gap:
            gap, one, other = float(gaps.min()), at, int(gaps.argmin())
    wide = high.max(axis=0) - low.min(axis=0)
    apart = f"{paths[one]} lies {gap / 1000:.1f} km from {paths[other]}, the nearest of the other files"
    if gap > _FAR_GAP or wide[0] * wide[1] > _MAX_AREA:
        raise CloudError(
            f"{apart}; they cannot be one map: leave out what does not belong, bring all into one reference system and "
            "unit, or build a map for each site"
        )
    return f"{apart}; the map holds both, and nothing between"


def _connected(low: Floats, high: Floats) -> Bools:
    """Mask the boxes, with corners (N, 2), that gaps below 1 km connect to the first."""
    reached = np.zeros(len(low), dtype=bool)
    reached[0] = True
    fresh = [0]
    while fresh:
        at = fresh.pop()
        neighbours = np.flatnonzero(~reached & (_gaps(low, high, at) < _MAX_GAP))
        reached[neighbours] = True
        fresh += neighbours.tolist()
    return reached


def _gaps(low: Floats, high: Floats, at: int) -> Floats:
    apart = np.maximum(np.maximum(low - high[at], low[at] - high), 0.0)
    gaps: Floats = np.hypot(apart[:, 0], apart[:, 1])
    return gaps
