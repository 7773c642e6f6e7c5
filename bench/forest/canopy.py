"""The strong baseline without learning: heights of the canopy, correlated at every place and heading.

Both views give the greatest height above the ground in cells of 2 m. At every cell and heading the normalised
cross-correlation is taken over the cells that both have seen (Padfield 2012, "Masked object registration in the
Fourier domain"): means and variances are those of the overlap, at that place.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import fft

from coview_stream.geometry import Points
from coview_stream.place.learned.bird_view import CELL, SLABS, bird_view

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

COARSE = 2.0
"""Edge of a cell, metres."""
HEADINGS = 72
REACH = 30.0
"""Metres around the robot."""
COVERED = 0.6
"""Share of the query's cells that the map must have for a place to be scored."""

_RATIO = round(COARSE / CELL)
_WINDOW, _MARGIN = 128.0, 48.0  # metres: large maps are drawn piece by piece
_TOP, _FLAT = -3, 1e-3


def heights(points: Points, corner: Floats, shape: tuple[int, int]) -> tuple[Floats, Mask]:
    """Greatest heights (H, W) above the ground, metres, and which cells of 0.5 m were seen at all."""
    image = bird_view(points, corner, shape)
    return image[_TOP] * (SLABS[-1] / 255.0), np.asarray(image[:-1].any(axis=0))


class Canopy:
    """A map's canopy, ready to be searched."""

    def __init__(self, points: Points) -> None:
        """Draw a cloud (N, 3), metres."""
        low = np.floor(points[:, :2].min(axis=0).astype(np.float64) / COARSE) * COARSE
        high = points[:, :2].max(axis=0).astype(np.float64)
        columns, rows = (np.floor((high - low) / COARSE).astype(int) + 1).tolist()
        top, seen = np.zeros((rows, columns)), np.zeros((rows, columns), dtype=bool)
        step = round(_WINDOW / COARSE)
        for row in range(0, rows, step):
            for column in range(0, columns, step):
                part = _window(points, low + np.array([column, row]) * COARSE, step)
                here = slice(row, row + step), slice(column, column + step)
                shape = top[here].shape
                top[here], seen[here] = part[0][: shape[0], : shape[1]], part[1][: shape[0], : shape[1]]
        self._prepare(top, seen, low)

    @classmethod
    def of(cls, top: Floats, seen: Mask, corner: Floats) -> Canopy:
        """Take heights (H, W) on cells of 2 m as they are; ``corner`` (2,) is that of cell (0, 0), metres."""
        made = cls.__new__(cls)
        made._prepare(top, seen, corner)
        return made

    def _prepare(self, top: Floats, seen: Mask, corner: Floats) -> None:
        self.shape, self.corner = top.shape, corner
        self._half = round(REACH / COARSE)
        self._size = tuple(fft.next_fast_len(n + 2 * self._half, real=True) for n in self.shape)
        values = np.where(seen, top, 0.0)
        images = np.stack([seen.astype(np.float64), values, values**2])
        self._spectra = fft.rfft2(images, self._size)

    @property
    def places(self) -> Floats:
        """(H * W, 2) middles of the cells, metres."""
        row, column = np.indices(self.shape)
        at = np.stack([column.ravel(), row.ravel()], axis=1)
        return np.asarray((at + 0.5) * COARSE + self.corner)

    def search(self, xy: Floats, top: Floats) -> tuple[Floats, Floats]:
        """Correlate heights ``top`` (N,) seen at ``xy`` (N, 2), metres from the robot, axes of the odometry.

        Returns:
            (H, W) the best correlation at each cell over all headings, -inf where too little overlaps, and (H, W) the
            heading of the odometry frame in the map that gives it, radians.
        """
        best, heading = np.full(self.shape, -np.inf), np.zeros(self.shape)
        for yaw in np.arange(HEADINGS) * (2 * np.pi / HEADINGS):
            score = self._at(*self._turned(xy, top, yaw))
            better = score > best
            best[better], heading[better] = score[better], yaw
        return best, heading

    def _turned(self, xy: Floats, top: Floats, yaw: float) -> tuple[Floats, Floats]:
        """Greatest heights (2h + 1, 2h + 1) of the query's cells about its middle, and which were seen."""
        c, s = np.cos(yaw), np.sin(yaw)
        side = 2 * self._half + 1
        cell = np.rint(xy @ np.array([[c, s], [-s, c]]) / COARSE).astype(np.int64) + self._half
        inside = ((cell >= 0) & (cell < side)).all(axis=1)
        flat = cell[inside, 1] * side + cell[inside, 0]
        seen, image = np.zeros(side * side), np.zeros(side * side)
        seen[flat] = 1.0
        np.maximum.at(image, flat, top[inside])
        return image.reshape(side, side), seen.reshape(side, side)

    def _at(self, image: Floats, seen: Floats) -> Floats:
        """Masked normalised cross-correlation (H, W) of a query with its middle at each cell."""
        mask, first, second = np.conj(fft.rfft2(np.stack([seen, image, image**2]), self._size))
        known, values, squares = self._spectra
        products = np.stack(
            [mask * known, mask * values, mask * squares, first * known, second * known, first * values]
        )
        # the query's middle is its cell (h, h): what lies at a shift of -h is found at the end of the grid
        sums = np.roll(fft.irfft2(products, self._size), (self._half, self._half), axis=(1, 2))
        count, theirs, theirs2, ours, ours2, both = sums[:, : self.shape[0], : self.shape[1]]
        enough = count >= COVERED * seen.sum() - 0.5
        n = np.maximum(count, 1.0)
        spread = (theirs2 - theirs**2 / n) * (ours2 - ours**2 / n)
        score = (both - ours * theirs / n) / np.sqrt(np.maximum(spread, _FLAT))
        return np.where(enough & (spread > _FLAT), score, -np.inf)


def seen_from(points: Points, centre: Floats) -> tuple[Floats, Floats]:
    """Where a scan (N, 3) has seen anything within 30 m of ``centre`` (K, 2), metres from it, and the heights (K,)."""
    cells = 2 * round((REACH + COARSE) / CELL)
    corner = centre[:2] - 0.5 * cells * CELL
    top, seen = heights(points, corner, (cells, cells))
    row, column = np.nonzero(seen)
    xy = (np.stack([column, row], axis=1) + 0.5) * CELL - 0.5 * cells * CELL
    near = np.hypot(xy[:, 0], xy[:, 1]) < REACH
    return xy[near], top[row[near], column[near]]


def _window(points: Points, corner: Floats, cells: int) -> tuple[Floats, Mask]:
    """Draw cells (n, n) of 2 m from ``corner`` on, the ground found with a margin of points around them."""
    low, high = corner - _MARGIN, corner + cells * COARSE + _MARGIN
    part = points[((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1)]
    edge = round(_MARGIN / CELL)
    side = cells * _RATIO + 2 * edge
    top, seen = heights(part, low, (side, side))
    inner = slice(edge, -edge)
    blocks = (cells, _RATIO, cells, _RATIO)
    return (
        top[inner, inner].reshape(blocks).max(axis=(1, 3)),
        np.asarray(seen[inner, inner].reshape(blocks).any(axis=(1, 3))),
    )
