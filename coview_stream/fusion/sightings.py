"""Sightings: how often rays of the runs ended at points, and how often they went through where these are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.fusion.localized_run import PosedFrame
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.rasters import min_filter
from coview_stream.geometry.transforms import Points

REACH = 25.0
"""Metres within which rays are looked at, set by hand: farther off neighbouring rays miss what is between them."""

_PIXEL = np.radians(0.5)  # of the picture of ranges; 0.2 m at the reach. Set by hand
_COLUMNS, _ROWS = 720, 361
_NEAREST, _STEEPEST = 1.5, np.radians(70.0)
_TILE = 8.0  # metres, of the look-up of points; set by hand


Counts = npt.NDArray[np.uint32]


class Sightings:
    """Counts of the sightings of points that do not change.

    A ray goes through a point if it and all rays in the pixels around end well behind it: a ray that grazes the ground
    or an edge says nothing. Where no ray was measured nothing is known.

    Attributes:
        points: (N, 3) relative to the map's origin, sorted by tile.
        order: (N,) which of the points given each is.
        through: (N,) looks that saw through it.
        seen: (N,) looks that saw something there.
    """

    def __init__(self, points: Points, margin: float) -> None:
        """Take points (N, 3) relative to the map's origin; a ray has to end ``margin`` metres behind, or farther."""
        tiles = np.floor(points[:, :2].astype(np.float64) / _TILE).astype(np.int64)
        self.order: Ints = np.lexsort((tiles[:, 1], tiles[:, 0]))
        tiles = tiles[self.order]
        self.points = points[self.order]
        begin = np.flatnonzero(np.append(len(tiles) > 0, (np.diff(tiles, axis=0) != 0).any(axis=1)))
        self._begin = np.append(begin, len(tiles)).astype(np.int64)
        self._tiles = tiles[self._begin[:-1]]
        self._margin = margin
        self.through = np.zeros(len(points), dtype=np.uint32)
        self.seen = np.zeros(len(points), dtype=np.uint32)

    def look(self, frame: PosedFrame) -> None:
        """Count what one frame says of the points around it."""
        ranges = _picture(frame.points - frame.eye.astype(np.float32))
        nearest = _nearest_around(ranges)
        R, t = frame.T_map_body[:3, :3], frame.T_map_body[:3, 3]
        centre = t + R @ frame.eye
        middle = (self._tiles + 0.5) * _TILE - centre[:2]
        for k in np.flatnonzero(np.hypot(*middle.T) < REACH + _TILE):
            stretch = slice(int(self._begin[k]), int(self._begin[k + 1]))
            rays = ((self.points[stretch] - centre) @ R).astype(np.float32)
            pixel, far, valid = _pixels(rays)
            valid &= (far < REACH) & (far > _NEAREST)
            met, around = ranges.ravel()[pixel], nearest.ravel()[pixel]
            margin = self._margin + 0.01 * far
            self.through[stretch] += valid & np.isfinite(met) & (around > far + margin)
            self.seen[stretch] += valid & (np.abs(around - far) <= margin)

    def given(self, counts: Counts) -> Counts:
        """Return counts (N,), ordered by the points given."""
        out = np.empty_like(counts)
        out[self.order] = counts
        return out


def _picture(rays: Points) -> Floats32:
    """Return the shortest range by pixel; infinity where there is no ray."""
    pixel, far, valid = _pixels(rays)
    image = np.full(_ROWS * _COLUMNS, np.inf, dtype=np.float32)
    np.minimum.at(image, pixel[valid], far[valid])
    return image.reshape(_ROWS, _COLUMNS)


def _pixels(rays: Points) -> tuple[Ints, Floats32, Bools]:
    far = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    up = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    column = np.floor(np.arctan2(rays[:, 1], rays[:, 0]) / _PIXEL).astype(np.int64) % _COLUMNS
    row = np.clip(np.floor(up / _PIXEL).astype(np.int64) + _ROWS // 2, 0, _ROWS - 1)
    return row * _COLUMNS + column, far, (far > 0.3) & (np.abs(up) < _STEEPEST)


def _nearest_around(ranges: Floats32) -> Floats32:
    wide = np.concatenate([ranges[:, -1:], ranges, ranges[:, :1]], axis=1)
    return min_filter(wide, 3)[:, 1:-1]


def looks_at(stamps: Floats, positions: Floats, metres: float = 0.5, seconds: float = 1.0) -> Bools:
    """Choose frames (K,) to look from: ``metres`` or ``seconds`` after the one before."""
    chosen = np.zeros(len(stamps), dtype=bool)
    last = -1
    for k in range(len(stamps)):
        far = last < 0 or float(np.linalg.norm(positions[k] - positions[last])) >= metres
        if far or stamps[k] - stamps[last] >= seconds:
            chosen[k], last = True, k
    return chosen
