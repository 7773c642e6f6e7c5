"""Distance of a query to every candidate at every shift (eqs 7-9), exactly, by the correlation theorem.

Descriptors are compared by the cosines of their columns (sectors). A turn by n sectors shifts the columns, so all S
shifts are one circular correlation per ring: a product per frequency, summed over the rings, and one inverse FFT. BLAS
does the product at the speed of memory; a Taichi version was several times slower, so NumPy serves every backend.

One query, 9,527 candidates of 20 x 60, two shared cores (commit 731ba9db, bench/speed):

=============================================  ========
BLAS per frequency + irfft (here)              3 to 5 ms
einsum over the spectra + irfft                28 to 70 ms
Taichi: inner loop over rings, then one GEMM   16 to 20 ms
=============================================  ========
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.arrays import C64, F32, as_float32

_MAX_SERIAL = 4000  # elements of a complex matrix up to which OpenBLAS multiplies a vector on one thread (4096)
_BATCH = 1024  # candidates transformed at a time: 1.2 MB per 20 x 60 spectrum array stays near the cache


def _fft() -> Any:
    """Return NumPy's transforms, or before 2.0, where they return complex128, SciPy's (0.4 s to import)."""
    if np.lib.NumpyVersion(np.__version__) >= "2.0.0":
        return np.fft
    from scipy import fft

    return fft


def unit_columns(desc: npt.ArrayLike) -> F32:
    """Divide columns of (..., R, S) descriptors by their Euclidean norm, if any; ValueError for fewer than two axes."""
    columns = np.asarray(desc, dtype=np.float32)
    if columns.ndim < 2:
        raise ValueError(f"desc has shape {columns.shape}, expected (..., rings, sectors)")
    # float64, or the squares of small heights would underflow, and a column with a direction would count as empty
    norm = np.sqrt(np.einsum("...rs,...rs->...s", columns, columns, dtype=np.float64))[..., None, :]
    unit: F32 = np.divide(columns, norm, out=np.zeros_like(columns), where=norm > 0, casting="same_kind")
    return unit


def column_spectra(desc: npt.ArrayLike) -> C64:
    """Return the spectra over the sectors of unit columns of descriptors (M, R, S); ValueError unless 3 axes.

    Returns (F, M, R) complex64 with F = S // 2 + 1; each frequency is one contiguous matrix.
    """
    fft = _fft()
    candidates = as_float32("desc", desc, None, None, None)
    m, rings, sectors = candidates.shape
    spectra = np.empty((sectors // 2 + 1, m, rings), dtype=np.complex64)
    for start in range(0, m, _BATCH):
        part = unit_columns(candidates[start : start + _BATCH])
        spectra[:, start : start + len(part)] = fft.rfft(part, axis=-1).transpose(2, 0, 1)
    return spectra


def all_shift_distance(query: npt.ArrayLike, spectra: C64, sectors: int) -> F32:
    """Return the distance (eqs 7-9) of a query to M candidates at all S shifts.

    ``d[m, n] = 1 - (1 / S) sum_j q_unit[:, (j + n) % S] . c_unit[m][:, j]``; a column that is empty on either side
    costs 1, so that a nearly empty descriptor cannot win by default.

    At shift n sector j of the candidate meets sector j + n of the query. With candidates binned in map axes and the
    query in the robot's axes, the map heading (yaw) of the query's x axis is **-2 pi n / S** radians.

    Args:
        query: (R, S) descriptor, or (Q, R, S); normalised here.
        spectra: (F, M, R) complex64 from :func:`column_spectra`.
        sectors: S; the spectra alone do not distinguish an even number from the odd one above it.

    Returns:
        (M, S) float32 in [0, 2], or (Q, M, S).

    Raises:
        ValueError: the shapes or ``sectors`` do not fit together.
    """
    fft = _fft()
    unit = unit_columns(query)
    queries = unit[None] if unit.ndim == 2 else unit
    rings = queries.shape[-2]
    if queries.ndim != 3 or queries.shape[-1] != sectors:
        raise ValueError(f"query has shape {unit.shape}, expected ([Q,] rings, {sectors})")
    if spectra.ndim != 3 or spectra.shape[0] != sectors // 2 + 1 or spectra.shape[2] != rings:
        raise ValueError(f"spectra has shape {spectra.shape}, expected ({sectors // 2 + 1}, M, {rings})")
    # conj(C conj(Q)) = conj(C) Q: conjugating the small results spares a copy of the large operand
    q_conj = np.conj(fft.rfft(queries, axis=-1)).transpose(2, 1, 0)  # (F, R, Q)
    product = np.conj(_products(spectra, np.ascontiguousarray(q_conj)))  # (F, M, Q)
    correlation = fft.irfft(np.ascontiguousarray(product.transpose(2, 1, 0)), n=sectors, axis=-1)
    distance: F32 = np.subtract(1.0, correlation * np.float32(1.0 / sectors), dtype=np.float32)
    return distance[0] if unit.ndim == 2 else distance


def _products(spectra: C64, queries: C64) -> C64:
    """Multiply (F, M, R) by (F, R, Q), in blocks of candidates that BLAS multiplies on the calling thread.

    Larger products wake OpenBLAS's threads once per frequency, which is a third faster on idle cores (1.9 against
    2.8 ms), but on busy cores 31 wake-ups took 300 ms.
    """
    frequencies, m, rings = spectra.shape
    block = max(1, _MAX_SERIAL // rings)
    even = m // block * block
    out = np.empty((frequencies, m, queries.shape[2]), dtype=np.complex64)
    np.matmul(
        spectra[:, :even].reshape(frequencies, -1, block, rings),
        queries[:, None],
        out=out[:, :even].reshape(frequencies, -1, block, queries.shape[2]),
    )
    np.matmul(spectra[:, even:], queries, out=out[:, even:])
    return out
