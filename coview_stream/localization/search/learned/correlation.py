"""Dense correlation of a query with a map at every cell and heading, by FFT in blocks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Complexes, Floats, Floats32, Ints, Reals
from coview_stream.localization.search.learned.feature_index import FeatureIndex, half_spectra

MIN_COVERAGE = 0.6
"""Least share of a query's weight on surveyed cells: there the scatter has grown by 1.3."""

_BATCH_BYTES = 32 << 20  # of the products that are transformed back together
_EPSILON = 1e-6  # a smaller weight counts as zero


def correlate(
    query: Floats32,
    weight: Floats32,
    index: FeatureIndex,
    yaws: npt.ArrayLike,
    blocks: Ints | None = None,
    min_coverage: float | None = MIN_COVERAGE,
) -> Floats32:
    """Return the mean inner products of a query's features with the map's, at all cells and headings.

    The mean is over surveyed cells: unsurveyed ones would count as dissimilar, and the right place at the map's edge
    would lose to a wrong one inside. A mean of few cells scatters more and would favour the rim, so a place with less
    than ``min_coverage`` of the weight on surveyed cells has no score: -inf, not 0, as wrong places may score below 0.
    To add up several queries, replace -inf by their median.

    Args:
        query: (C, h, h), h even, features times weights (see :func:`downsample`); row along y, column along x of the
            query's frame, the robot between the four cells in the middle.
        weight: (h, h) not negative; cells more than h / 2 from the middle are left out.
        index: of the same cells and dimensions, with a margin of at least h / 2.
        yaws: (K,) headings of the query's frame in the map, radians.
        blocks: blocks of the map to score (all); see :meth:`FeatureIndex.blocks_near`.
        min_coverage: smallest share of the weight on surveyed cells; None divides by all the weight.

    Returns:
        (K, H, W); -inf without a score. The memory's order is (H, W, K): headings of a cell lie together.

    Raises:
        ValueError: query and map do not fit, or no cell has a weight.
    """
    headings = np.asarray(yaws, dtype=np.float64)
    _check(query, weight, index, headings)
    size = len(headings) // 2
    in_pairs = len(headings) == 2 * size and np.allclose(
        np.exp(1j * headings[:size]), -np.exp(1j * headings[size:]), atol=1e-9
    )
    images = rotate_images(np.concatenate([query, weight[None]]), headings[:size] if in_pairs else headings)
    return correlate_turned(images, index, in_pairs, blocks, min_coverage)


def correlate_turned(
    images: Floats32,
    index: FeatureIndex,
    opposite: bool,
    blocks: Ints | None = None,
    min_coverage: float | None = MIN_COVERAGE,
) -> Floats32:
    """Correlate a rotated query as :func:`correlate` does.

    Args:
        images: (h + 1, h + 1, K, C + 1), the query at K headings; the weight comes last.
        index: as for :func:`correlate`.
        opposite: whether the images are also compared at the opposite headings.
        blocks: as for :func:`correlate`.
        min_coverage: as for :func:`correlate`.

    Returns:
        (K, H, W), or (2 K, H, W): the opposite headings come last.

    Raises:
        ValueError: no cell has a weight.
    """
    transforms = _query_spectra(images, index, opposite)
    headings = len(transforms) * images.shape[2]
    chosen = np.arange(len(index)) if blocks is None else np.unique(blocks)
    scores = np.full((index.height, index.width, headings), -np.inf, dtype=np.float32)
    per_block = 8 * len(transforms[0].spectra) * headings
    for group in np.array_split(chosen, max(1, -(-len(chosen) * per_block // _BATCH_BYTES))):
        if len(group):
            for transform, part in zip(transforms, np.split(scores, len(transforms), axis=2), strict=True):
                _score(part, group, index, transform, min_coverage)
    return np.asarray(scores.transpose(2, 0, 1))


@dataclass(frozen=True)
class _QuerySpectra:
    """Spectra (bins, K, C + 1) of a query, and the first row and column of the valid part of the product."""

    spectra: Complexes
    first: int


def _query_spectra(
    images: Floats32, index: FeatureIndex, opposite: bool
) -> tuple[_QuerySpectra] | tuple[_QuerySpectra, _QuerySpectra]:
    """Return the query's spectra at its headings, divided by the sum of the weights; the weight's comes last."""
    half = images.shape[0] // 2
    total = images[..., -1].sum(axis=(0, 1), dtype=np.float64).astype(np.float32)
    if not (total > _EPSILON).all():
        raise ValueError("no cell of the query has a weight")
    spectra = half_spectra(images * (1.0 / total)[:, None], index.block)
    before = _QuerySpectra(np.conjugate(spectra), index.margin - half)
    # a correlation with an image rotated by 180 degrees is a convolution: the same spectra, not conjugate
    return (before, _QuerySpectra(spectra, index.margin + half)) if opposite else (before,)


def _check(query: Floats32, weight: Floats32, index: FeatureIndex, yaws: Floats) -> None:
    if query.ndim != 3 or weight.shape != query.shape[1:] or yaws.ndim != 1 or not len(yaws):
        raise ValueError(f"a query {query.shape} with weights {weight.shape} at headings {yaws.shape} does not fit")
    if len(query) != index.dimensions:
        raise ValueError(f"the query has {len(query)} dimensions, the map {index.dimensions}")
    if query.shape[1] > 2 * index.margin:
        raise ValueError(f"the query has {query.shape[1]} cells a side, the map allows for {2 * index.margin}")


def _score(
    scores: Floats32, group: Ints, index: FeatureIndex, query: _QuerySpectra, min_coverage: float | None
) -> None:
    """Fill in the scores (H, W, K) of the valid parts of some blocks."""
    spectra = query.spectra
    mean = _inverse(np.matmul(index.spectra(group), spectra[..., :-1].transpose(0, 2, 1)), index, query)
    if min_coverage is not None:
        gaps = np.flatnonzero(~index.gapless(group))
        if len(gaps):
            share = _inverse(index.surveyed_spectra(group[gaps]) * spectra[:, None, :, -1], index, query)
            # a share equal to the minimum must not depend on how the transforms round
            enough = share >= max(min_coverage - 1e-5, _EPSILON)
            mean[:, :, gaps] = np.where(enough, mean[:, :, gaps] / np.maximum(share, _EPSILON), -np.inf)
    for k, block in enumerate(group):
        rows, cols = index.cells_of(block)
        scores[rows, cols] = mean[: rows.stop - rows.start, : cols.stop - cols.start, k]


def _inverse(product: Complexes, index: FeatureIndex, query: _QuerySpectra) -> Floats32:
    """Transform products of spectra (bins, blocks, K) back to correlations (valid, valid, blocks, K)."""
    from scipy import fft

    size, last = index.block, query.first + index.valid
    grid = product.reshape(size, -1, *product.shape[1:])
    rows = fft.ifft(grid, axis=0, overwrite_x=True)[query.first : last]
    return np.asarray(fft.irfft(rows, size, axis=1)[:, query.first : last])


def downsample(local: Reals, weight: Floats32 | None = None, ratio: int = 2) -> tuple[Floats32, Floats32]:
    """Average ``ratio`` x ``ratio`` cells of features (C, H, W), each times its weight (H, W), and the weights.

    Returns:
        (C, H / ratio, W / ratio), (H / ratio, W / ratio): the input of :func:`correlate`.

    Raises:
        ValueError: the ratio does not divide the sides, or the weights have another shape.
    """
    dimensions, height, width = local.shape
    if height % ratio or width % ratio:
        raise ValueError(f"{height} x {width} cells cannot be taken together {ratio} by {ratio}")
    if weight is None:
        weight = np.ones((height, width), dtype=np.float32)
    if weight.shape != (height, width):
        raise ValueError(f"weights {weight.shape} for {height} x {width} cells")
    parts = (height // ratio, ratio, width // ratio, ratio)
    weighted = (local * weight).reshape(dimensions, *parts).mean(axis=(2, 4), dtype=np.float32)
    return np.asarray(weighted), np.asarray(weight.reshape(parts).mean(axis=(1, 3), dtype=np.float32))


def rotate_images(images: Floats32, yaws: Floats) -> Floats32:
    """Sample rotated images on a grid of odd size about their middle.

    Args:
        images: (C, h, h), h even: the middle lies between cells. Cells more than h / 2 from it are left out, as only
            some headings would show them; outside the image is 0.
        yaws: (K,) radians, counter-clockwise from x (columns) to y (rows).

    Returns:
        (h + 1, h + 1, K, C): at [h/2 + v, h/2 + u, k] the bilinear value at R(-yaw_k) (u, v) from the middle.

    Raises:
        ValueError: the images are not square, or have an odd number of cells.
    """
    dimensions, size, width = images.shape
    if size != width or size % 2:
        raise ValueError(f"a query of {size} x {width} cells: it has to be square, its sides even")
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1))).transpose(1, 2, 0).reshape(-1, dimensions)
    corners, shares = _corners(size, tuple(np.asarray(yaws, dtype=np.float64).tolist()))
    out = padded.take(corners[0], axis=0) * shares[0]
    for corner, share in zip(corners[1:], shares[1:], strict=True):
        out += padded.take(corner, axis=0) * share
    return np.asarray(out.reshape(size + 1, size + 1, len(yaws), dimensions))


@lru_cache(maxsize=4)
def _corners(size: int, yaws: tuple[float, ...]) -> tuple[Ints, Floats32]:
    """Return the four cells (4, N) around the samples of a rotated image, and their weights (4, N, 1)."""
    half = size // 2
    v, u = np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1), indexing="ij")
    c, s = np.cos(yaws), np.sin(yaws)
    # one more cell of zeros on every side takes the values beyond the image
    col = u[..., None] * c + v[..., None] * s + (half + 0.5)
    row = v[..., None] * c - u[..., None] * s + (half + 0.5)
    inside = (np.hypot(u, v) <= half)[..., None]
    i, j = (np.clip(np.floor(position), 0, size).astype(np.int64) for position in (row, col))
    down, right = row - i, col - j
    at = (i * (size + 2) + j).ravel()
    shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]) * inside
    return at + np.array([[0], [1], [size + 2], [size + 3]]), shares.reshape(4, -1, 1).astype(np.float32)
