"""Two published ways of finding a place without learning, as far as a page each goes, beside the product's.

Written after what the papers say, not after their code; the airborne map takes the place of a map from the ground. Both
are asked in the axes of the odometry, gravity up, heading unknown.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from coview_stream.descriptors.birds_eye_view import CELL, SLABS, Image, birds_eye_view
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, rot_z

REACH = 30.0  # metres around the robot
_GRID = 2.0  # metres between the places that are compared
_TOP = -3  # layer of the greatest heights


def drawn(points: Points, margin: float) -> tuple[Image, Floats]:
    """Draw a cloud (N, 3) from above with ``margin`` metres around it; the image and its lower corner (2,)."""
    low = np.floor((points[:, :2].min(axis=0).astype(np.float64) - margin) / _GRID) * _GRID
    high = points[:, :2].max(axis=0).astype(np.float64) + margin
    columns, rows = (4 * np.ceil((high - low) / _GRID).astype(int)).tolist()
    return birds_eye_view(points, low, (rows, columns)), low


def around(points: Points, centre: Floats) -> Image:
    """Draw what of a cloud (N, 3) lies around ``centre`` (K,), which is the image's middle."""
    cells = 4 * round((2 * REACH + 8.0) / _GRID)
    return birds_eye_view(points, centre[:2] - 0.5 * cells * CELL, (cells, cells))


class Occupancy:
    """Occupancy as a probability (PROBE, arXiv 2603.05965), at places 2 m apart and all headings.

    A cell of the view from above is a Bernoulli variable. The robot's unknown shift from the grid's place is
    marginalised by a Gaussian over the plane, which in polar cells is the paper's angular uncertainty ``shift /
    r``. The heading is that of the best cosine of heights; the score a Jaccard index in which a cell counts by
    ``exp(-KL)`` of the two probabilities, drawn toward one half by their uncertainty, and for less the less certain
    both are. Not the paper's, whose maps were seen from the ground: what the query has not seen counts for nothing,
    in the score and in the cosine.
    """

    RINGS, SECTORS, SHIFT = 20, 60, 1.0  # cells, and metres: the expected error of a place of the grid
    _HEADINGS = 3  # of the best cosine, that are scored

    def __init__(self, points: Points) -> None:
        """Describe all places of a map's cloud (N, 3), metres."""
        image, low = drawn(points, 0.0)
        rows, columns = (n // 4 for n in image.shape[1:])
        row, column = np.indices((rows, columns))
        # (M, 2) middles of the grid's cells, metres
        self.places = (np.stack([column.ravel(), row.ravel()], axis=1) + 0.5) * _GRID + low
        self._occupied, top, _ = self._described(image, (self.places - low) / CELL)
        self._spectra = fft.rfft(top, axis=2)
        self._squares = fft.rfft(top**2, axis=2)

    def search(self, image: Image) -> tuple[Floats, Floats]:
        """Compare a query's image, the robot in its middle; scores (M,) and headings (M,) radians of all places."""
        occupied, top, seen = self._described(image, 0.5 * np.array([image.shape[1:]], dtype=np.float64))
        cosine, squares = (
            fft.irfft((spectra * np.conj(fft.rfft(each, axis=2))).sum(axis=1), self.SECTORS, axis=1)
            for spectra, each in ((self._spectra, top * seen), (self._squares, seen))
        )
        cosine /= np.sqrt(np.maximum(squares, 1.0))
        best, turned = np.full(len(self.places), -np.inf), np.zeros(len(self.places), dtype=int)
        for shift in np.argsort(-cosine, axis=1)[:, : self._HEADINGS].T:
            sector = (np.arange(self.SECTORS) - shift[:, None]) % self.SECTORS
            theirs = (each[0][:, sector].transpose(1, 0, 2) for each in (occupied, seen))
            score = self._jaccard(self._occupied, *theirs)
            better = score > best
            best[better], turned[better] = score[better], shift[better]
        return best, turned * (2 * np.pi / self.SECTORS)

    def _described(self, image: Image, centre: Floats) -> tuple[Floats, Floats, Floats]:
        """Probabilities, heights and what was seen (M, RINGS, SECTORS) about cells (M, 2), column and row."""
        top = image[_TOP] * (SLABS[-1] / 255.0)
        occupied = gaussian_filter((top > SLABS[0]).astype(np.float32), self.SHIFT / CELL)
        heights = gaussian_filter(top.astype(np.float32), self.SHIFT / CELL)
        seen = maximum_filter(image[:-1].any(axis=0).astype(np.float32), 3)
        radius = (np.arange(self.RINGS) + 0.5) * (REACH / self.RINGS / CELL)
        angle = (np.arange(self.SECTORS) + 0.5) * (2 * np.pi / self.SECTORS)
        reach = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))])
        column, row = (np.floor(centre[:, k, None, None] + reach[k]).astype(np.int64) for k in (0, 1))
        inside = (column >= 0) & (column < image.shape[2]) & (row >= 0) & (row < image.shape[1])
        flat = np.where(inside, row * image.shape[2] + column, 0)
        probability, height, known = (np.where(inside, each.ravel()[flat], 0.0) for each in (occupied, heights, seen))
        return probability, height, known

    @staticmethod
    def _jaccard(one: Floats, other: Floats, seen: Floats) -> Floats:
        unsure = 4 * one * (1 - one), 4 * other * (1 - other)
        p, q = (
            np.clip(each + 0.5 * u * (0.5 - each), 0.02, 0.98) for each, u in zip((one, other), unsure, strict=True)
        )
        divergence = 0.5 * (p - q) * (np.log(p / q) - np.log((1 - p) / (1 - q)))
        weight = np.exp(-(unsure[0] + unsure[1])) * np.maximum(one, other) * seen
        return np.asarray((weight * np.exp(-divergence)).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1e-6))


class StemTriangles:
    """Triangles of trees (TreeLoc, arXiv 2602.01501): sides that agree name a place and a heading, trees confirm it.

    A tree of the map is a top of its canopy, since stems are hardly seen from above; one of the query a column that is
    full between one and four metres. Tops of what the query saw did worse.
    """

    _NEAR, _LONGEST, _AGREE = 6, 18.0, 0.5  # neighbours of a tree in triangles; metres; metres between sides
    _STEM, _CROWN = slice(1, 3), 4.0  # layers of a stem; metres, below which is no tree's top
    _FULL = 0.6  # of a stem's layers
    _CONFIRM, _NAMED = 1.0, 60  # metres between trees; poses of most votes that are confirmed

    def __init__(self, points: Points) -> None:
        """Find the trees of a map's cloud (N, 3), metres."""
        image, low = drawn(points, 0.0)
        self._trees = (self._tops(image) + 0.5) * CELL + low
        self._tree = cKDTree(self._trees)
        self._corners, self._sides = self._triangles(self._trees)
        self._shapes = cKDTree(self._sides if len(self._sides) else np.full((1, 3), 1e9))

    def search(self, image: Image) -> tuple[Floats, Floats, Floats]:
        """Places (K, 2), scores (K,) and headings (K,) that the trees of a query's image name; robot in the middle."""
        trees = (self._stems(image) + 0.5 - 0.5 * np.array(image.shape[:0:-1])) * CELL
        trees = trees[np.hypot(*trees.T) < REACH]
        corners, sides = self._triangles(trees)
        named = []
        for k, alike in enumerate(self._shapes.query_ball_point(sides, self._AGREE) if len(sides) else []):
            if alike and len(self._sides):
                named.append(_poses(trees[corners[k]], self._trees[self._corners[alike]]))
        if not named:
            return np.empty((0, 2)), np.empty(0), np.empty(0)
        poses = np.concatenate(named)
        wide = np.stack([poses[:, 0] / 2.0, poses[:, 1] / 2.0, poses[:, 2] * (180 / np.pi / 6.0)], axis=1)
        _, where, votes = np.unique(np.round(wide).astype(int), axis=0, return_inverse=True, return_counts=True)
        found = []
        for bin_ in np.argsort(-votes)[: self._NAMED]:
            pose = poses[where.ravel() == bin_]
            x, y = np.median(pose[:, :2], axis=0)
            yaw = float(np.angle(np.exp(1j * pose[:, 2]).mean()))
            at = trees @ rot_z(yaw)[:2, :2].T + np.array([x, y])
            off = self._tree.query(at, distance_upper_bound=self._CONFIRM)[0]
            found.append((x, y, np.isfinite(off).mean(), yaw))
        x, y, score, yaw = np.array(found).T
        return np.stack([x, y], axis=1), score, yaw

    def _tops(self, image: Image) -> Floats:
        top = gaussian_filter(image[_TOP] * np.float32(SLABS[-1] / 255.0), 0.75 / CELL)
        row, column = np.nonzero((top == maximum_filter(top, 5)) & (top > self._CROWN))
        return np.stack([column, row], axis=1).astype(np.float64)

    def _stems(self, image: Image) -> Floats:
        full = image[self._STEM].mean(axis=0, dtype=np.float32) / 255.0
        row, column = np.nonzero((full == maximum_filter(full, 3)) & (full > self._FULL))
        return np.stack([column, row], axis=1).astype(np.float64)

    def _triangles(self, trees: Floats) -> tuple[Ints, Floats]:
        """Trees (T, 3) of each triangle, opposite to its sides from the shortest, and the sides (T, 3), metres."""
        if len(trees) < 3:
            return np.empty((0, 3), dtype=int), np.empty((0, 3))
        _, near = cKDTree(trees).query(trees, min(self._NEAR + 1, len(trees)))
        found = {tuple(sorted((k, *two))) for k, row in enumerate(near) for two in combinations(row[1:].tolist(), 2)}
        corners = np.array(sorted(found))
        a, b, c = (trees[corners[:, k]] for k in range(3))
        sides = np.stack([np.hypot(*(b - c).T), np.hypot(*(c - a).T), np.hypot(*(a - b).T)], axis=1)
        order = np.argsort(sides, axis=1)
        corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(sides, order, axis=1)
        kept = sides[:, 2] < self._LONGEST
        return corners[kept], sides[kept]


def _poses(ours: Floats, theirs: Floats) -> Floats:
    """Places and headings (K, 3) that put a triangle (3, 2) best onto others (K, 3, 2)."""
    us, them = ours - ours.mean(axis=0), theirs - theirs.mean(axis=1, keepdims=True)
    one, other = us[:, 0] + 1j * us[:, 1], them[..., 0] + 1j * them[..., 1]
    yaw = np.angle((np.conj(one) * other).sum(axis=1))
    c, s = np.cos(yaw), np.sin(yaw)
    middle = ours.mean(axis=0)
    turned = np.stack([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]], axis=1)
    return np.column_stack([theirs.mean(axis=1) - turned, yaw])
