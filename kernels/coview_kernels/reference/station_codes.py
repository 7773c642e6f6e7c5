"""Correlations of a query with coded stations: the kernels' results, in wider registers or whole matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.arrays import F32, I16, I32

_BATCH = 256
_LOW = 12  # rows of the first group


def best_codes(codes: I16, query: I16, turn: I16) -> I32:
    """Return the greatest correlation over the angles, (M,) int32, in units of the turn.

    Args:
        codes: (M, 16, 16) int16, two numbers each.
        query: (2, 16, 2, 16) int16, for real and imaginary products.
        turn: (65, 16) int16: zeros, cosines and sines of the blocks at the angles.
    """
    wide, t = query.astype(np.int32), turn[1:].astype(np.int32)
    even = np.r_[0:8, 16:24]
    cosine, sine = t[:32], t[32:]
    out = np.empty(len(codes), dtype=np.int32)
    for start in range(0, len(codes), _BATCH):
        pair = codes[start : start + _BATCH]
        part = np.stack([pair << 8, pair], axis=2).astype(np.int32)
        x, y = (
            np.hstack(
                [
                    _upper_half(part[:, rows], w[rows]).sum(axis=(1, 2)) + (rows.stop - rows.start)
                    for rows in (slice(0, _LOW), slice(_LOW, codes.shape[1]))
                ]
            )
            for w in wide
        )
        a, c = (_upper_half(x[:, s, None], cosine[s]).sum(axis=1) + 8 for s in (even, even + 8))
        b, d = (_upper_half(y[:, s, None], sine[s]).sum(axis=1) + 8 for s in (even, even + 8))
        best = np.maximum(a + c + np.abs(b + d), a - c + np.abs(b - d))
        out[start : start + len(part)] = best.max(axis=1)
    return out


def code_products(codes: I16, query: F32, stations: I32) -> F32:
    """Return the products (K, 2, 2, 16) of a query's spectrum with stations (K,), by group, real/imaginary and lane.

    Args:
        codes: (M, 16, 16) int16.
        query: (16, 4, 16) float32: factors of the real and the whole number, for real and then imaginary products.
        stations: (K,) indices.
    """
    pair = codes[stations]
    real, whole = pair.astype(np.int8).astype(np.float32), pair.astype(np.float32)
    each = np.stack([real * query[:, 2 * i] + whole * query[:, 2 * i + 1] for i in range(2)], axis=1)
    sums: F32 = np.stack([each[:, :, :_LOW].sum(axis=2), each[:, :, _LOW:].sum(axis=2)], axis=1)
    return sums


def codes_at(codes: I16, table: F32, stations: I32, shifts: I32) -> F32:
    """Return the correlations (K,) of stations (K,) at shifts (K,); 0 for station -1.

    Args:
        codes: (M, 16, 16) int16.
        table: (S, 16, 2, 16) float32: factors of the real and the whole number at every shift.
        stations: (K,) indices.
        shifts: (K,) numbers of sectors.
    """
    found = np.zeros(len(stations), dtype=np.float32)
    known = np.flatnonzero(stations >= 0)
    for start in range(0, len(known), _BATCH):
        part = known[start : start + _BATCH]
        pair, factor = codes[stations[part]], table[shifts[part]]
        found[part] = (pair.astype(np.int8) * factor[:, :, 0] + pair * factor[:, :, 1]).sum(axis=(1, 2))
    return found


def _upper_half(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[Any]:
    upper: npt.NDArray[Any] = (a * b) >> 16
    return upper
