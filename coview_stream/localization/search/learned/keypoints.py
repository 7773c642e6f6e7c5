"""Keypoints, the cells of which the network is least uncertain, and their mutual nearest pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints, Reals


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one image.

    Attributes:
        xy: (N, 2) metres.
        descriptors: (N, C), unit norm.
        sigma: (N,) uncertainty.
    """

    xy: Floats
    descriptors: Floats32
    sigma: Floats32

    def __post_init__(self) -> None:
        count = len(self.xy)
        shapes = [self.xy.shape, self.descriptors.shape, self.sigma.shape]
        if shapes[0] != (count, 2) or any(shape[0] != count for shape in shapes):
            raise ValueError(f"keypoints of different numbers: {shapes}; xy has to be (N, 2)")

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.xy)

    def select(self, chosen: Bools | Ints) -> Keypoints:
        """Return those that a mask (N,) or indices name."""
        return Keypoints(self.xy[chosen], self.descriptors[chosen], self.sigma[chosen])

    def around(self, xy: npt.ArrayLike, radius: float) -> Keypoints:
        """Return those within ``radius`` metres of ``xy`` (2,)."""
        step = self.xy - np.asarray(xy, dtype=np.float64)
        return self.select(np.hypot(step[:, 0], step[:, 1]) <= radius)


def keypoints(
    local: Reals,
    sigma: Floats32,
    corner: npt.ArrayLike,
    *,
    mask: Bools | None = None,
    count: int | None = 200,
    cell: float = 1.0,
) -> Keypoints:
    """Find the cells that are less uncertain than their eight neighbours, the ``count`` best of them, best first.

    Args:
        local: (C, H, W) descriptors; row along y, column along x.
        sigma: (H, W) uncertainty.
        corner: (2,) x and y of the lower corner of cell (0, 0), metres; the keypoints are in its frame.
        mask: (H, W) cells that may be keypoints, and be compared with (all).
        count: None for all.
        cell: edge of a cell, metres.

    Raises:
        ValueError: the shapes do not belong to one image.
    """
    for name, image in (("sigma", sigma), ("mask", mask)):
        if image is not None and image.shape != local.shape[1:]:
            raise ValueError(f"{name} is {image.shape}, the descriptors are {local.shape}")
    row, col = np.nonzero(local_minima(sigma if mask is None else np.where(mask, sigma, np.inf)))
    order = np.argsort(sigma[row, col], kind="stable")[:count]
    row, col = row[order], col[order]
    xy = np.stack([col + 0.5, row + 0.5], axis=1) * cell + np.asarray(corner, dtype=np.float64)
    return Keypoints(xy, np.ascontiguousarray(local[:, row, col].T, dtype=np.float32), sigma[row, col])


def local_minima(values: Reals) -> Bools:
    """Mask (H, W) finite values that none of their eight neighbours is below; of equal ones the first counts."""
    height, width = values.shape
    padded = np.pad(values, 1, constant_values=np.inf)
    lowest = np.isfinite(values)
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            other = padded[down : down + height, right : right + width]
            if (down, right) < (1, 1):
                lowest &= values < other
            elif (down, right) > (1, 1):
                lowest &= values <= other
    return np.asarray(lowest)


def nearest_pairs(
    query: Floats32, known: Floats32, *, max_pairs: int = 300, possible: Bools | None = None
) -> tuple[Ints, Floats32]:
    """Pair descriptors each of which is the most similar to the other, by inner product.

    Args:
        query: (N, C) unit descriptors.
        known: (M, C) unit descriptors.
        max_pairs: the most similar ones are kept.
        possible: (N, M) which pairs may be (all).

    Returns:
        Pairs (P, 2) and their similarities (P,), most similar first.

    Raises:
        ValueError: the descriptors have different lengths.
    """
    if query.ndim != 2 or known.ndim != 2 or query.shape[1] != known.shape[1]:
        raise ValueError(f"descriptors of a query {query.shape} and of a map {known.shape} do not compare")
    if not len(query) or not len(known):
        return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.float32)
    similarity = query @ known.T
    if possible is not None:
        similarity[~possible] = -np.inf
    row, forth, back = np.arange(len(query)), similarity.argmax(axis=1), similarity.argmax(axis=0)
    row = row[(back[forth] == row) & np.isfinite(similarity[row, forth])]
    values = similarity[row, forth[row]]
    order = np.argsort(-values, kind="stable")[:max_pairs]
    return np.stack([row, forth[row]], axis=1)[order], values[order]
