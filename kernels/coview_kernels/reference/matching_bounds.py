"""Best correlation of a query with every station in integers: the kernel's numbers, in wider registers."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.arrays import I16, I32

_BATCH = 256


def best_correlations(stations: I16, query: I16, turn: I16) -> I32:
    """Greatest correlation over the shifts, (M,) int32, in units of the turn.

    The layout is that of :mod:`coview_kernels.matching_bounds`.

    Args:
        stations: (M, R, L) int16, two numbers in each.
        query: (2, R, 2, L) int16, for real and imaginary products.
        turn: (6 + 2 L, N) int16, the table of rotations.
    """
    wide, t = query.astype(np.int32), turn.astype(np.int32)
    blocks = stations.shape[2]
    even, odd = slice(0, blocks // 2), slice(blocks // 2, blocks)
    cosine, sine = t[6 : 6 + blocks], t[6 + blocks :]
    out = np.empty(len(stations), dtype=np.int32)
    for start in range(0, len(stations), _BATCH):
        pair = stations[start : start + _BATCH]
        part = np.stack([pair << 8, pair], axis=2).astype(np.int32)
        x, y = (_upper_half(part, w).sum(axis=(1, 2)) for w in wide)
        a, c = (_upper_half(x[:, s, None], cosine[s]).sum(axis=1) + t[i] for i, s in enumerate((even, odd)))
        b, d = (_upper_half(y[:, s, None], sine[s]).sum(axis=1) + t[2 + i] for i, s in enumerate((even, odd)))
        a += _upper_half(y[:, 0, None], t[4])
        best = np.maximum(a + c + np.abs(b + d), a - c + np.abs(b - d))
        out[start : start + len(part)] = best.max(axis=1)
    return out


def _upper_half(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    upper: npt.NDArray[Any] = (a * b) >> 16
    return upper
