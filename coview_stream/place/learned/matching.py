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
    most: int = 300,
    possible: npt.NDArray[np.bool_] | None = None,
) -> tuple[Pairs, F32]:
    """Pair descriptors each of which is the most similar to the other, by inner product.

    Args:
        query: (N, C) unit descriptors.
        known: (M, C) unit descriptors.
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
    row, forth, back = np.arange(len(query)), similarity.argmax(axis=1), similarity.argmax(axis=0)
    row = row[(back[forth] == row) & np.isfinite(similarity[row, forth])]
    values = similarity[row, forth[row]]
    order = np.argsort(-values, kind="stable")[:most]
    return np.stack([row, forth[row]], axis=1)[order], values[order]
