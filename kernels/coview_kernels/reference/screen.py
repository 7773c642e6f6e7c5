"""Twin of :mod:`coview_kernels.screen`'s kernel: the same integers, in wider registers."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.arrays import I32

_PORTION = 256


def screen(stations: npt.NDArray[np.int8], query: npt.NDArray[np.int16], turn: npt.NDArray[np.int16]) -> I32:
    """Greatest C + |S| over the shifts, (M,) int32, for stations (M, K, L), query (2, K, L), turn (3 + 2L, N)."""
    wide, t = query.astype(np.int32), turn.astype(np.int32)
    blocks = stations.shape[2]
    out = np.empty(len(stations), dtype=np.int32)
    for start in range(0, len(stations), _PORTION):
        part = stations[start : start + _PORTION].astype(np.int32) << 8
        x, y = (((part * w) >> 16).sum(axis=1) for w in wide)
        cosine = t[0] + _high(y[:, 0, None], t[2]) + _high(x[:, :, None], t[3 : 3 + blocks]).sum(axis=1)
        sine = t[1] + _high(y[:, :, None], t[3 + blocks :]).sum(axis=1)
        out[start : start + len(part)] = (cosine + np.abs(sine)).max(axis=1)
    return out


def _high(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    upper: npt.NDArray[Any] = (a * b) >> 16
    return upper
