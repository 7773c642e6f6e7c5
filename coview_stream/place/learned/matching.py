"""Which keypoints of a scan look like which of the map."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
Pairs = npt.NDArray[np.int64]
"""(P, 2) indices: the query's keypoint, the map's."""


def nearest_pairs(
    query: F32,
    known: F32,
    *,
    nearest: int = 1,
    mutual: bool = True,
    most: int = 300,
    possible: npt.NDArray[np.bool_] | None = None,
) -> tuple[Pairs, F32]:
    """Pair descriptors that are most similar, by inner product.

    Args:
        query: (N, C) unit descriptors.
        known: (M, C) unit descriptors.
        nearest: a pair joins a descriptor with one of so many nearest of the other side.
        mutual: in both directions; else one is enough, which finds more right pairs and more wrong ones.
        most: pairs at most.
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
    forth, back = _nearest(similarity, nearest), _nearest(similarity.T, nearest).T
    kept = (forth & back) if mutual else (forth | back)
    row, col = np.nonzero(kept & np.isfinite(similarity))
    values = similarity[row, col]
    order = np.argsort(-values, kind="stable")[:most]
    return np.stack([row[order], col[order]], axis=1), values[order]


def _nearest(similarity: F32, count: int) -> npt.NDArray[np.bool_]:
    """Mark the ``count`` greatest of each row."""
    marked = np.zeros(similarity.shape, dtype=bool)
    if count >= similarity.shape[1]:
        marked[:] = True
    else:
        found = np.argpartition(-similarity, count - 1, axis=1)[:, :count]
        np.put_along_axis(marked, found, True, axis=1)
    return marked
