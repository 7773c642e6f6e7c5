"""How alike a query is to every place of the map at every heading: dense correlation, by FFT in blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import fft

from coview_stream.place.learned.coarse_map import CoarseMap, transformed
from coview_stream.place.learned.turning import turned

F32 = npt.NDArray[np.float32]
C64 = npt.NDArray[np.complex64]
Indices = npt.NDArray[np.int64]

COVERED = 0.6
"""Share of a query's weight that has to lie on surveyed cells."""

_AT_ONCE = 32 << 20  # bytes of the products that are transformed back together
_LEAST = 1e-6  # weight of nothing


def correlate(
    query: F32,
    weight: F32,
    coarse_map: CoarseMap,
    yaws: npt.ArrayLike,
    blocks: Indices | None = None,
    covered: float | None = COVERED,
) -> F32:
    """Mean inner product of a query's cells with the map's, for its middle at every cell's centre, at every heading.

    A query that reaches beyond the map has less to be compared with. Its sum over all weights would count what nobody
    surveyed as cells that do not look alike, and lose the right place at the map's edge to a wrong one inside. With
    ``covered``, the mean is over what lies on surveyed cells: the right place scores what it would score anywhere. A
    mean of few cells scatters more, though, and chance would favour the map's rim; below a share of 0.6 a place is
    not scored (at it, scatter has grown by 1.3). That is -inf, not 0: wrong places may well score less than 0, and no
    evidence is none against it. Who adds up several queries takes -inf for their median.

    Args:
        query: (C, h, h), h even, each cell's features times its weight (see :func:`~.turning.coarser`); row along
            y, column along x of the query's frame, the robot between the four cells in the middle.
        weight: (h, h) not negative. What lies more than h / 2 cells from the middle is left out.
        coarse_map: of the same cells and channels, with a margin of at least h / 2.
        yaws: (K,) headings of the query's frame in the map, radians.
        blocks: blocks of the map to score (all); see :meth:`CoarseMap.blocks_near`.
        covered: least share of the weight on surveyed cells; None divides by all the weight, wherever it lies.

    Returns:
        (K, H, W); -inf where nothing was scored. The memory's order is (H, W, K): headings of a cell lie together.

    Raises:
        ValueError: query and map do not fit, or no cell has a weight.
    """
    headings = np.asarray(yaws, dtype=np.float64)
    _check(query, weight, coarse_map, headings)
    waves = _waves(query, weight, coarse_map, headings)
    chosen = np.arange(len(coarse_map)) if blocks is None else np.unique(blocks)
    scores = np.full((coarse_map.height, coarse_map.width, len(headings)), -np.inf, dtype=np.float32)
    per_block = 8 * len(waves[0].spectra) * len(headings)
    for group in np.array_split(chosen, max(1, -(-len(chosen) * per_block // _AT_ONCE))):
        if len(group):
            for wave, part in zip(waves, np.split(scores, len(waves), axis=2), strict=True):
                _score(part, group, coarse_map, wave, covered)
    return np.asarray(scores.transpose(2, 0, 1))


@dataclass(frozen=True)
class _Wave:
    """Spectra (bins, K, C + 1) to multiply a map's with, and the row and column at which its margin's end is found."""

    spectra: C64
    first: int


def _waves(
    query: F32, weight: F32, coarse_map: CoarseMap, yaws: npt.NDArray[np.float64]
) -> tuple[_Wave] | tuple[_Wave, _Wave]:
    """Spectra of a turned query, the weight's last, over the sum of the weights."""
    half, size = len(weight) // 2, len(yaws) // 2
    # a correlation with what is turned by half a turn is a convolution: the same spectra, not conjugate
    twice = len(yaws) == 2 * size and np.allclose(
        np.exp(1j * yaws[:size]), -np.exp(1j * yaws[size:]), atol=1e-9
    )
    images = turned(np.concatenate([query, weight[None]]), yaws[:size] if twice else yaws)
    total = images[..., -1].sum(axis=(0, 1), dtype=np.float64).astype(np.float32)
    if not (total > _LEAST).all():
        raise ValueError("no cell of the query has a weight")
    images *= (1.0 / total)[:, None]
    spectra = transformed(images, coarse_map.block, coarse_map.workers)
    before = _Wave(np.conjugate(spectra), coarse_map.margin - half)
    return (before, _Wave(spectra, coarse_map.margin + half)) if twice else (before,)


def _check(query: F32, weight: F32, coarse_map: CoarseMap, yaws: npt.NDArray[np.float64]) -> None:
    if query.ndim != 3 or weight.shape != query.shape[1:] or yaws.ndim != 1 or not len(yaws):
        raise ValueError(
            f"a query {query.shape} with weights {weight.shape} at headings {yaws.shape} does not fit"
        )
    if len(query) != coarse_map.channels:
        raise ValueError(f"the query has {len(query)} channels, the map {coarse_map.channels}")
    if query.shape[1] > 2 * coarse_map.margin:
        raise ValueError(
            f"the query has {query.shape[1]} cells a side, the map allows for {2 * coarse_map.margin}"
        )


def _score(scores: F32, group: Indices, coarse_map: CoarseMap, wave: _Wave, covered: float | None) -> None:
    """Fill in the places (H, W, K) that some blocks answer for."""
    spectra = wave.spectra
    mean = _back(np.matmul(coarse_map.spectra(group), spectra[..., :-1].transpose(0, 2, 1)), coarse_map, wave)
    if covered is not None:
        gaps = np.flatnonzero(~coarse_map.whole(group))
        if len(gaps):
            share = _back(
                coarse_map.surveyed_spectra(group[gaps]) * spectra[:, None, :, -1], coarse_map, wave
            )
            # a share of just so much must not depend on how the transforms round
            enough = share >= max(covered - 1e-5, _LEAST)
            mean[:, :, gaps] = np.where(enough, mean[:, :, gaps] / np.maximum(share, _LEAST), -np.inf)
    for k, block in enumerate(group):
        rows, cols = coarse_map.place_of(block)
        scores[rows, cols] = mean[: rows.stop - rows.start, : cols.stop - cols.start, k]


def _back(product: C64, coarse_map: CoarseMap, wave: _Wave) -> F32:
    """Correlations (places, places, blocks, K) from products of spectra (bins, blocks, K)."""
    size, last = coarse_map.block, wave.first + coarse_map.places
    grid = product.reshape(size, -1, *product.shape[1:])
    rows = fft.ifft(grid, axis=0, overwrite_x=True, workers=coarse_map.workers)[wave.first : last]
    return np.asarray(fft.irfft(rows, size, axis=1, workers=coarse_map.workers)[:, wave.first : last])
