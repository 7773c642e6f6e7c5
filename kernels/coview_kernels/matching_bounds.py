r"""Upper and lower bounds of a query's best correlation with every station, from one byte per number.

The correlation at shift n is a sum over the frequencies f of :math:`Re(conj(c_f) . q_f e^{i 2 pi f n / S})`, where
c and q are spectra of unit columns, weighted so that both have a norm of at most 1. A station's numbers are
kept as int8, the products are 16-bit integers and so exact; what the integers miss is bounded:

====================================  ==============================================================
what is rounded                       bound of its share in any correlation
====================================  ==============================================================
the station, c = s int8 + e           \|e\| \|q\| (Cauchy-Schwarz), \|e\| is kept per station
the query, q = int16 / (s g)          sum over blocks of \|int8\| \|rounding\| / g
upper halves of K products            K / 2 units on either side of their mean, which is added back
the rotation: table and upper halves  0.75 units for each of the 2 L + 1 terms
====================================  ==============================================================

So the best correlation over all shifts lies within ``error`` (M,) of ``estimate`` (M,), for every input; tests
compare both with float64. On maps of real sites the error is 0.02, and 10 to 20 of 10,000 stations need a closer
look for the best ten.

Layout: block 0 holds the frequencies 0 and S / 2, whose spectra are real; block f the real and imaginary
parts of frequency f. A station is (R, L) int16 of L blocks, padded to 16 lanes, and stands for K = 2 R rows: the
lower byte is a real part, the whole in units of 256 an imaginary one. To multiply either takes no unpacking but
one shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels import reference
from coview_kernels.arrays import F32, F64, I16
from coview_kernels.similarity import unit_columns

MAX_SECTORS = 63
"""Shifts 0 to S / 2 fit two registers of 16 lanes; longer local vectors compile slowly."""

_BATCH = 512
_MAX_SAMPLE = 1024
_INT8_RANGE = 6.0  # standard deviations that int8 spans: 5 to 8 differ by a tenth in error on simulated sites
_FLOAT32_ERROR = 3e-5  # float32 spectra, sums and products on the way to the integers
_MAX_SUM = 32_600.0  # of int16, with room for what rounding adds


@dataclass(frozen=True)
class Bounds:
    """For M stations: the best correlation over all shifts is ``estimate`` plus or minus ``error``; float64 (M,)."""

    estimate: F64
    error: F64


class QuantizedStations:
    """The spectra of M stations' descriptors (R, S), one byte per number, and what that rounding costs.

    Args:
        descriptors: (M, R, S), finite; S at most :data:`MAX_SECTORS`.
    """

    def __init__(self, descriptors: npt.NDArray[Any]) -> None:
        m, self.rings, self.sectors = descriptors.shape
        self._frequency = _frequencies(self.sectors)
        self.blocks = len(self._frequency)
        # a sum for shift n serves -n too and, if odd frequencies are summed apart, half a turn on from both
        self.shifts = self.sectors // (4 if self.sectors % 4 == 0 else 2) + 1
        self.lanes = -(-self.shifts // 16) * 16
        self.rotations = self._rotations()
        self.fourier = self._fourier()
        self.step = self._quantization_steps(descriptors[:: -(-m // _MAX_SAMPLE) or 1])  # evenly, at most _MAX_SAMPLE
        self.stations = aligned_zeros((m, self.rings, self.blocks))
        self.residual = np.empty(m, dtype=np.float32)
        norm = np.zeros(self.blocks)
        for start in range(0, m, _BATCH):
            part = slice(start, start + _BATCH)
            numbers = self._spectra(descriptors[part])
            numbers /= self.step
            pair = _pack(numbers)
            self.stations[part] = pair
            whole = _unpack(pair)
            numbers -= whole
            numbers *= self.step
            self.residual[part] = np.sqrt(np.einsum("mrpl,mrpl->m", numbers, numbers)) * np.float32(1.0001)
            norm = np.maximum(norm, np.einsum("mrpl,mrpl->ml", whole, whole).max(axis=0, initial=0.0))
        self.block_norm = np.sqrt(norm * 1.0001)
        self.max_norm = 1.0 + float(self.residual.max(initial=0.0))  # of a station, as it is kept

    @property
    def nbytes(self) -> int:
        """Bytes kept for all stations."""
        return self.stations.nbytes + self.residual.nbytes

    def bounds(self, query: F32) -> Bounds:
        """Bounds for a query (R, S), finite: the NumPy twin of :meth:`coview_kernels.matching.MatchKernel.bounds`."""
        numbers = self._spectra(query[None])[0].astype(np.float64)
        size = float(np.sqrt((numbers * numbers).sum()))
        whole, gain, rounding = self._quantize_query(numbers)
        turn, unit, error = self._rotation_table(gain, size + rounding)
        best = reference.best_correlations(self.stations, whole, turn)
        per_station: F64 = self.residual.astype(np.float64) * size + (rounding + error + _FLOAT32_ERROR)
        return Bounds(best.astype(np.float64) * unit, per_station)

    def _spectra(self, descriptors: npt.NDArray[Any]) -> F32:
        """(m, R, 2, L) float32: the weighted spectra of the unit columns of (m, R, S), real and imaginary."""
        # a product for each station: OpenBLAS wakes its threads for larger ones, which costs more than they save
        product: F32 = np.matmul(unit_columns(descriptors), self.fourier.astype(np.float32))
        return product.reshape(len(descriptors), self.rings, 2, self.blocks)

    def _quantization_steps(self, sample: npt.NDArray[Any]) -> F32:
        """(R, 2, L) what one unit of int8 stands for; what exceeds the range is clipped, and counts as rounding."""
        numbers = self._spectra(sample).astype(np.float64)
        square = (numbers * numbers).mean(axis=0) if len(sample) else np.zeros(numbers.shape[1:])
        min_square = 1e-3 * square.max(initial=0.0) + 1e-12  # rows that are empty in the sample
        return np.asarray(np.sqrt(np.maximum(square, min_square)) * (_INT8_RANGE / 127.0), dtype=np.float32)

    def max_query_norm(self) -> F64:
        """(L,) greatest norm of a query's int16 with which no sum of upper halves leaves int16.

        |sum| <= |int8| |int16| / 256 + K, by Cauchy-Schwarz.
        """
        norm: F64 = (_MAX_SUM - 8.0 * self.rings) * 256.0 / np.maximum(self.block_norm, 1.0)
        return np.minimum(norm, 32_000.0)

    def _quantize_query(self, numbers: F64) -> tuple[I16, F64, float]:
        """Return the query (2, R, 2, L), for real and imaginary products; its gain (L,); the error of its rounding."""
        pair = np.stack([numbers, np.stack([numbers[:, 1], -numbers[:, 0]], axis=1)])
        pair[0, :, 1, 0] = pair[1, :, 0, 0] = 0.0
        pair[1, :, 1, 0] = numbers[:, 1, 0]
        pair *= self.step
        size = np.sqrt((pair * pair).sum(axis=(1, 2))).max(axis=0)
        gain = self.max_query_norm() / np.maximum(size, 1e-30)
        whole = np.rint(pair * gain)
        missed = np.sqrt(((whole - pair * gain) ** 2).sum(axis=(0, 1, 2)))
        return whole.astype(np.int16), gain, float(np.sqrt(2.0) * (self.block_norm * missed / gain).sum())

    def _rotations(self) -> F64:
        """(2 L + 1, W) factors of the blocks at the shifts 0 to S - 1: cosines, sines, cosine of frequency S / 2."""
        shift = np.arange(-(-max(self.lanes, self.sectors) // 16) * 16)
        angle = 2.0 * np.pi / self.sectors * np.outer(self._frequency, shift)
        used = np.outer(self._frequency >= 0, shift < self.sectors)
        nyquist = (-1.0) ** shift * (shift < self.sectors) * (self.sectors % 2 == 0)
        return np.concatenate([np.cos(angle) * used, -np.sin(angle) * used, nyquist[None]])

    def _fourier(self) -> F64:
        """(S, 2 L) matrix from a ring to its weighted spectrum: real parts, then imaginary ones."""
        blocks, sectors = self.blocks, self.sectors
        fourier = self.rotations[: 2 * blocks, :sectors].T * (np.sqrt(2.0) / sectors)
        fourier[:, 0] = 1.0 / sectors
        fourier[:, blocks] = self.rotations[2 * blocks, :sectors] / sectors
        return np.ascontiguousarray(fourier)

    def _rotation_table(self, gain: F64, size: float) -> tuple[I16, float, float]:
        """Return the table, its unit and the error.

        Rows: means of upper halves (4), frequency S / 2, zeros, cosines (L), sines (L).
        """
        rows, blocks, half = 2 * self.rings, self.blocks, self.blocks // 2
        scale = np.where(self._frequency >= 0, 256.0 / gain, 0.0)  # of one unit of a product
        # either side of the mean, in a pair whose rotation has a norm of 1, or is (1, 1) in block 0
        error = rows / 2.0 * (np.sqrt(2.0) * float(scale.sum()) + float(scale[0]))
        unit = max(2.01 * float(scale.max()), (self.max_norm * size + error) / 31_000.0)
        factor = (65_536.0 / unit * scale)[:, None]
        rotations = self.rotations[:, : self.lanes] * (np.arange(self.lanes) < self.shifts)
        turn = np.empty((6 + 2 * blocks, self.lanes))
        turn[5] = 0.0
        turn[4] = rotations[2 * blocks] * factor[0]
        turn[6:] = rotations[: 2 * blocks] * np.concatenate([factor, factor])
        turn[:4] = turn[6:].reshape(4, half, -1).sum(axis=1)
        turn[0] += turn[4]
        turn[:4] = turn[:4] * (rows / 2.0 / 65_536.0) + half / 2.0
        turn[0, self.shifts :] = -30_000.0
        return np.rint(turn).astype(np.int16), unit, error + (0.75 * (2 * blocks + 1) + 4.0) * unit


def aligned_zeros(shape: tuple[int, ...]) -> I16:
    """Zeros (int16) that begin with a cache line: a load across two lines costs two."""
    memory = np.zeros(2 * int(np.prod(shape)) + 64, dtype=np.uint8)
    start = -memory.__array_interface__["data"][0] % 64
    return memory[start : start + len(memory) - 64].view(np.int16).reshape(shape)


def _pack(numbers: F32) -> I16:
    """(..., L) int16 of (..., 2, L): the second in the upper byte, rounded with regard to the lower one."""
    low = np.clip(np.rint(numbers[..., 0, :]), -127, 127).astype(np.int16) & 255
    high = np.clip(np.rint(numbers[..., 1, :] - low * np.float32(1.0 / 256.0)), -127, 127).astype(np.int16)
    packed: I16 = (high << 8) | low
    return packed


def _unpack(pair: I16) -> F32:
    """(..., 2, L) numbers that (..., L) int16 stand for: the lower byte, and the whole of it in units of 256."""
    whole = np.empty((*pair.shape[:-1], 2, pair.shape[-1]), dtype=np.float32)
    whole[..., 0, :] = pair.astype(np.int8)
    np.multiply(pair, np.float32(1.0 / 256.0), out=whole[..., 1, :])
    return whole


def _frequencies(sectors: int) -> npt.NDArray[np.int64]:
    """Frequency of each block (L,), -1 for none: even ones in the first half, odd ones in the second.

    Half a turn changes the sign of the odd ones, so that one sum serves two shifts. If S is no multiple of 4,
    all are in the first half.
    """
    every = np.arange((sectors + 1) // 2)
    parts = (every[::2], every[1::2]) if sectors % 4 == 0 else (every, every[:0])
    half = -(-len(parts[0]) // 8) * 8
    out = np.full((2, half), -1, dtype=np.int64)
    for row, part in zip(out, parts, strict=True):
        row[: len(part)] = part
    return out.reshape(-1)
