"""Where a learned query fits: dense correlation with a map, and the pairs of keypoints that agree.

Dense correlation: 32 dimensions on cells of 2 m, a query of 64 m at 36 headings, maps of random features. Turning the
query is part of every side; ``fftconvolve`` is timed at one heading and multiplied by 36. The clique: 300 pairs of
which 10 % are right, at 0.3 m noise, as in a forest; and pairs that are all wrong. All sides must agree
(docs/performance.md). BLAS has the threads of OPENBLAS_NUM_THREADS, the transforms one.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from scipy import fft
from scipy.signal import fftconvolve

from bench.harness.rows import Row, against, bounded, informs, medians
from coview_stream.config.search import LearnedMatchConfig
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.geometry.transforms import rot_z
from coview_stream.localization.search.learned import consistent_pairs as pairs
from coview_stream.localization.search.learned.correlation import correlate, rotate_images
from coview_stream.localization.search.learned.feature_index import FeatureIndex

CHANNELS, HEADINGS, QUERY = 32, 36, 32
SIDES = {"0.1 km2": (158, 250.0), "1 km2": (500, 1500.0)}  # cells on a side and the milliseconds allowed
PAIRS = 300


class OneFft:
    """Baseline: per channel over the whole map, its spectra kept."""

    def __init__(self, features: Floats32) -> None:
        self._shape = features.shape[1:]
        self._size = tuple(fft.next_fast_len(side + QUERY, real=True) for side in self._shape)
        self._spectra = fft.rfft2(features, self._size)

    def __call__(self, query: Floats32, weight: Floats32, yaws: Floats) -> Floats32:
        """Return sums (K, H, W) over all weights."""
        half, (height, width) = QUERY // 2, self._shape
        out = np.empty((len(yaws), height, width), dtype=np.float32)
        for k, grid in enumerate(_turned(query, weight, yaws)):
            product = (np.conj(fft.rfft2(grid, self._size)) * self._spectra).sum(axis=0)
            out[k] = np.roll(fft.irfft2(product, self._size), (half, half), axis=(0, 1))[:height, :width]
        return out


def _convolved(features: Floats32, query: Floats32, weight: Floats32, yaws: Floats) -> Floats32:
    """Baseline: ``scipy.signal.fftconvolve`` along the map's axes, then the sum over dimensions (K, H, W)."""
    grids = _turned(query, weight, yaws)[..., ::-1, ::-1]
    return np.stack([fftconvolve(features, grid, mode="same", axes=(1, 2)).sum(axis=0) for grid in grids])


def _turned(query: Floats32, weight: Floats32, yaws: Floats) -> Floats32:
    """Turn a query (K, C, h + 1, h + 1), over the sum of its weights."""
    images = rotate_images(np.concatenate([query, weight[None]]), yaws).transpose(2, 3, 0, 1)
    return np.ascontiguousarray(images[:, :-1] / images[:, -1:].sum(axis=(2, 3), keepdims=True))


def rows(asked: Namespace) -> Iterator[Row]:
    """Dense correlation, then cliques."""
    yield from _dense(asked.quick)
    yield from _cliques(5 if asked.quick else 15)


def _dense(quick: bool) -> Iterator[Row]:
    rng = np.random.default_rng(0)
    query, weight = _unit(rng, QUERY), np.ones((QUERY, QUERY), dtype=np.float32)
    yaws = np.arange(HEADINGS) * (2 * np.pi / HEADINGS)
    for label, (side, most) in list(SIDES.items())[: 1 if quick else None]:
        features = _unit(rng, side)
        known, one = FeatureIndex(features, (0.0, 0.0)), OneFft(features)
        near = known.blocks_near([known.corner + (side // 2 + 0.5) * known.cell], 50.0)
        plain = partial(correlate, query, weight, known, yaws, min_coverage=None)
        _same(plain(), one(query, weight, yaws))
        _same(plain()[:1], _convolved(features, query, weight, yaws[:1]))
        mean, ours, restricted, whole, single = medians(
            partial(correlate, query, weight, known, yaws),
            plain,
            partial(correlate, query, weight, known, yaws, near),
            partial(one, query, weight, yaws),
            partial(_convolved, features, query, weight, yaws[:1]),
            repeat=3 if quick or side > 200 else 7,
            warm_up=0,  # they have just run
        )
        yield bounded(f"learned_match/dense correlation, {label}, 36 headings", mean, "ms", most)
        yield against(f"learned_match/sums only, beside one FFT per channel, {label}", ours, whole, "ms", 2.0)
        yield against(f"learned_match/the same beside fftconvolve, {label}", ours, single * HEADINGS, "ms", 5.0)
        yield informs(f"learned_match/within 50 m of a place, {label}", restricted, "ms")
        yield informs(f"learned_match/spectra kept, {label}", known.nbytes / 1e6, "MB")


def _cliques(repeat: int) -> Iterator[Row]:
    config = LearnedMatchConfig()
    for label, share in (("1 in 10 right", 0.1), ("none right", 0.0)):
        here, there = _pairs(np.random.default_rng(1), share)
        weights = pairs.consistency_graph(here, there, config)
        found, most = pairs.maximum_clique(weights, config.nodes), enumerated(weights > 0)
        if found.exact and len(found) != most:
            raise RuntimeError(f"a clique of {len(found)}, there is one of {most}")
        nothing = np.empty(0, dtype=np.int64)
        graph, relaxing, ours, search, listing = medians(
            partial(pairs.consistency_graph, here, there, config),
            partial(pairs.relaxed_clique, weights),
            partial(pairs.maximum_clique, weights, config.nodes),
            partial(pairs.largest_clique, weights > 0, nothing, config.nodes),
            partial(enumerated, weights > 0),
            repeat=repeat,
        )
        name = f"{PAIRS} pairs, {label}"
        yield informs(f"learned_match/consistency graph, {name}", graph, "ms")
        yield informs(f"learned_match/relaxed clique, {name}", relaxing, "ms")
        # where nothing is planted the relaxation has nothing to find, and listing a thin graph is quick as well
        yield against(f"learned_match/maximum clique, {name}", ours, listing, "ms", 1.0 if share else None)
        yield against(f"learned_match/search from nothing, {name}", search, listing, "ms", None)


def enumerated(adjacent: Bools) -> int:
    """Baseline: size of the largest of all maximal cliques, listed by Bron and Kerbosch with Tomita's pivots."""
    near = [set(np.flatnonzero(row).tolist()) - {i} for i, row in enumerate(adjacent)]
    most = 0

    def extend(size: int, free: set[int], done: set[int]) -> None:
        nonlocal most
        if not free and not done:
            most = max(most, size)
            return
        pivot = max(free | done, key=lambda node: len(near[node] & free))
        for node in list(free - near[pivot]):
            extend(size + 1, free & near[node], done & near[node])
            free.remove(node)
            done.add(node)

    extend(0, set(range(len(near))), set())
    return most


def _unit(rng: np.random.Generator, side: int) -> Floats32:
    values = rng.standard_normal((CHANNELS, side, side), dtype=np.float32)
    return np.asarray(values / np.linalg.norm(values, axis=0))


def _pairs(rng: np.random.Generator, share: float) -> tuple[Floats, ...]:
    """Points of pairs in a disk's square, ``share`` of them the same from either side but for the heading."""
    here, there = rng.uniform(-30.0, 30.0, (2, PAIRS, 2))
    right = round(share * PAIRS)
    there[:right] = here[:right] @ rot_z(0.7)[:2, :2].T + rng.normal(0.0, 0.3, (right, 2))
    return here, there


def _same(ours: Any, other: Any) -> None:
    """Raise ``RuntimeError`` where the sides of a comparison do not agree."""
    apart = float(np.abs(ours - other).max())
    if not apart < 1e-4:
        raise RuntimeError(f"the formulations differ by {apart:g}")
