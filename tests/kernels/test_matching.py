"""Pruned matching gives the exhaustive answer, on random and adversarial cases; bounds hold against float64."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

import coview_kernels as ck
from coview_kernels import matching, reference, runtime
from coview_kernels.matching import MatchKernel
from coview_kernels.matching_bounds import Bounds, QuantizedStations

TOLERANCE = 1e-6
SHAPES = ((4, 12), (3, 7), (20, 60), (5, 2), (2, 1), (7, 33))


NATIVE = pytest.mark.skipif(os.environ.get("COVIEW_KERNELS") == "numpy", reason="the kernel itself")


def native_bounds(stations: QuantizedStations, desc, query) -> Bounds:
    if ck.backend() == "numpy":
        return stations.bounds(query)

    def run():
        kernel = MatchKernel(stations, desc)
        kernel.candidates(query, 0)
        return kernel.bounds()

    return ck.submit(run)


def transforms(columns):
    """Transforms of whole unit columns, in float64."""
    columns = np.asarray(columns, dtype=np.float64)
    norm = np.sqrt((columns**2).sum(axis=-2, keepdims=True))
    return np.fft.rfft(np.divide(columns, norm, out=np.zeros_like(columns), where=norm > 0), axis=-1)


def correlations(query, descriptors):
    """Eqs 7-9 in float64, (M, S): an oracle of its own, by Fourier transforms; of descriptors or their transforms."""
    sectors = query.shape[1]
    b = descriptors if np.iscomplexobj(descriptors) else transforms(descriptors)
    return np.fft.irfft((transforms(query) * b.conj()).sum(axis=-2), n=sectors, axis=-1) / sectors


def agrees(found, query, descriptors, k):
    """Distances rank by rank, each station's own distance at its shift, no better one left out, ties by index."""
    distance = 1.0 - correlations(query, descriptors)
    best = distance.min(axis=1)
    k = min(k, len(best))
    assert found.station.shape == found.shift.shape == found.distance.shape == (k,)
    assert len(set(found.station.tolist())) == k
    np.testing.assert_allclose(found.distance, np.sort(best)[:k], atol=TOLERANCE)
    np.testing.assert_allclose(distance[found.station, found.shift], found.distance, atol=TOLERANCE)
    missing = np.setdiff1d(np.arange(len(best)), found.station)
    assert not len(missing) or not k or best[missing].min() >= best[found.station].max() - 3e-9
    same = np.diff(found.distance) == 0
    exact = np.abs(np.diff(best[found.station])) < 1e-12
    assert (np.diff(found.station)[same & exact] > 0).all()


def scene(rng, kind, m, shape, dtype=np.float16):
    """Descriptors and a query of one kind of difficulty."""
    rings, sectors = shape
    desc = rng.uniform(0.2, 12, (m, rings, sectors)) * (rng.random((m, rings, sectors)) < 0.6)
    query = rng.uniform(0.2, 12, (rings, sectors)) * (rng.random((rings, sectors)) < 0.6)
    if kind == "zero columns":
        desc *= rng.random((m, 1, sectors)) < 0.3
        query *= rng.random((1, sectors)) < 0.5
    elif kind == "empty":
        desc[rng.random(m) < 0.5] = 0.0
        query *= rng.random() < 0.7
    elif kind == "duplicates":
        desc = desc[rng.integers(0, max(1, m // 6), m)]
        query = desc[0] if rng.random() < 0.5 else query
    elif kind == "turned duplicates":
        desc = np.stack([np.roll(desc[0], int(n), axis=1) for n in rng.integers(0, sectors, m)])
    elif kind == "near ties":
        desc = desc[:1] * (1 + 1e-3 * rng.standard_normal(desc.shape))
        query = desc[0] if rng.random() < 0.5 else query
    elif kind == "negative":
        desc, query = rng.standard_normal(desc.shape), rng.standard_normal(query.shape)
    elif kind == "tiny and huge":
        desc *= 10.0 ** rng.integers(-6, 4, (m, 1, 1))
        query *= 1e-30
    elif kind == "one bin":
        desc *= rng.random(desc.shape) < 1.5 / desc[0].size
        query *= rng.random(query.shape) < 3.0 / query.size
    elif kind == "outlier":
        desc = np.abs(np.roll(query, 1, axis=1) + 0.1 * rng.standard_normal(desc.shape))
        desc[-1] = rng.standard_normal(shape)
    elif kind == "constant":
        desc, query = np.ones_like(desc), np.ones_like(query)
    return desc.astype(dtype), query.astype(np.float32)


KINDS = (
    *("random", "zero columns", "empty", "duplicates", "turned duplicates", "near ties", "negative"),
    *("tiny and huge", "one bin", "outlier", "constant"),
)


SPREAD = 1200  # stations; a thread takes 512 at least


@pytest.mark.slow
@pytest.mark.parametrize("way", ["serial", pytest.param("parallel", marks=NATIVE), "float32"])
@pytest.mark.parametrize("kind", KINDS)
def test_top_k_equals_exhaustive_search(kind, way, monkeypatch):
    # 11 kinds x (6 shapes serial, 3 parallel, 3 float32) x 4 maps x 24 queries: 12,672 cases
    if way == "parallel":
        monkeypatch.setattr(matching, "_MIN_PARALLEL", 1)
    rng = np.random.default_rng(KINDS.index(kind))
    serial = set()
    for shape in SHAPES if way == "serial" else SHAPES[:3]:
        for trial in range(4):
            m = SPREAD if way == "parallel" and trial == 0 else int(rng.integers(1, 60))
            desc, query = scene(rng, kind, m, shape, np.float32 if way == "float32" else np.float16)
            index, oracle = ck.MatchIndex(desc), transforms(desc)
            for turn in range(24):
                asked = np.roll(query, turn, axis=1) * (rng.random(query.shape) < 0.97)
                k = int(rng.choice([1, 2, 10, m, m + 3]))
                agrees(index.top_k(asked, k), asked, oracle, k)
            if index._kernel is not None:
                serial.add(index._kernel._serial)
    if ck.backend() != "numpy":
        assert serial == {way != "parallel" or runtime.workers() == 1}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_bounds_contain_the_exact_correlation(kind):
    rng = np.random.default_rng(100 + KINDS.index(kind))
    for shape in SHAPES:
        desc, query = scene(rng, kind, 40, shape)
        best = correlations(query, desc).max(axis=1)
        stations = QuantizedStations(desc)
        for bounds in (stations.bounds(query), native_bounds(stations, desc, query)):
            assert (np.abs(bounds.estimate - best) <= bounds.error).all()


def test_bounds_are_tight_enough_to_prune():
    rng = np.random.default_rng(5)
    desc, _ = scene(rng, "random", 3000, (20, 60))
    query = np.roll(desc[700], 9, axis=1) + rng.normal(0, 2, (20, 60)).astype(np.float32)
    bounds = native_bounds(QuantizedStations(desc), desc, query)
    assert bounds.error.max() < 0.03
    assert (bounds.estimate + bounds.error > (bounds.estimate - bounds.error).max()).sum() == 1
    found = ck.MatchIndex(desc).top_k(query, 3)
    assert (found.station[0], found.shift[0]) == (700, 9)


@pytest.mark.slow
@NATIVE
@pytest.mark.parametrize("shape", [(20, 60), (3, 7), (1, 63), (40, 34)])
def test_kernel_agrees_with_numpy_to_the_bit(shape):
    rng = np.random.default_rng(6)
    desc = rng.normal(size=(50, *shape))
    stations = QuantizedStations(desc)
    kernel = ck.submit(MatchKernel, stations, desc)
    query = rng.integers(-2000, 2001, kernel.query.shape).astype(np.int16)
    turn = rng.integers(-600, 601, kernel.turn.shape).astype(np.int16)
    turn[5] = 0
    best = ck.submit(kernel.best, query, turn)
    np.testing.assert_array_equal(best, reference.best_correlations(stations.stations, query, turn))


@pytest.mark.parametrize("scale", [1.0, 0.0])
def test_top_k_of_near_duplicates_with_and_without_spectra(scale):
    rng = np.random.default_rng(7)
    desc = (rng.uniform(1, 9, (1, 6, 20)) + scale * 1e-2 * rng.standard_normal((2500, 6, 20))).astype(np.float16)
    index, spectra = ck.MatchIndex(desc), ck.column_spectra(desc)
    query = rng.uniform(1, 9, (6, 20)).astype(np.float32)
    for k in (1, 7, 400):
        agrees(index.top_k(query, k), query, desc, k)
        agrees(index.top_k(query, k, spectra=spectra), query, desc, k)


def test_index_takes_less_than_1300_bytes_a_station_and_keeps_a_memory_map(tmp_path):
    file = np.lib.format.open_memmap(tmp_path / "d.npy", "w+", np.float16, (300, 20, 60))
    file[:] = np.random.default_rng(8).uniform(0, 9, file.shape)
    index = ck.MatchIndex(file)
    assert index.nbytes / len(index) < 1300
    assert index.descriptors is file


@pytest.mark.slow
def test_queries_and_frames_from_many_threads_during_a_shutdown():
    rng = np.random.default_rng(9)
    desc, _ = scene(rng, "random", 200, (6, 20))
    index = ck.MatchIndex(desc)
    queries = [desc[n].astype(np.float32) for n in range(24)]
    cloud = rng.uniform(-9, 9, (400, 3)).astype(np.float32)
    points = ck.VoxelFilter(1.0)(cloud, np.eye(4))[0].copy()
    half_way = Barrier(5, timeout=60)

    def ask(_):
        voxel_filter = ck.VoxelFilter(1.0)
        answers = []
        for n, query in enumerate(queries):
            if n == 12:
                half_way.wait()
            # the frame runs on the owner thread, the query on this one, while others do the same
            np.testing.assert_array_equal(voxel_filter(cloud, np.eye(4))[0], points)
            answers.append(index.top_k(query, 5))
        return answers

    def stop():
        half_way.wait()
        ck.shutdown()

    alone = [index.top_k(query, 5) for query in queries]
    with ThreadPoolExecutor(5) as pool:
        stopping = pool.submit(stop)
        together = list(pool.map(ask, range(4)))
        stopping.result()
    for answers in (*together, [index.top_k(query, 5) for query in queries]):
        np.testing.assert_array_equal([f.station for f in answers], [f.station for f in alone])
        np.testing.assert_array_equal([f.shift for f in answers], [f.shift for f in alone])
        # while the owner starts again NumPy may answer
        distances = [f.distance for f in answers], [f.distance for f in alone]
        np.testing.assert_allclose(*distances, rtol=0, atol=TOLERANCE)


def test_empty_map_and_empty_query():
    none = ck.MatchIndex(np.empty((0, 4, 8), dtype=np.float16)).top_k(np.ones((4, 8)), 5)
    assert none.station.shape == none.shift.shape == none.distance.shape == (0,)
    found = ck.MatchIndex(np.ones((6, 4, 8), dtype=np.float16)).top_k(np.zeros((4, 8)), 3)
    np.testing.assert_array_equal(found.station, [0, 1, 2])
    np.testing.assert_array_equal(found.distance, 1.0)


def test_errors_name_the_argument():
    index = ck.MatchIndex(np.ones((3, 4, 6), dtype=np.float16))
    with pytest.raises(ValueError, match="query has shape"):
        index.top_k(np.ones((4, 7)), 1)
    with pytest.raises(ValueError, match="query holds"):
        index.top_k(np.full((4, 6), np.nan), 1)
    with pytest.raises(ValueError, match="k must"):
        index.top_k(np.ones((4, 6)), 0)
    with pytest.raises(ValueError, match="descriptors have"):
        ck.MatchIndex(np.ones((4, 6)))
    with pytest.raises(ValueError, match="descriptors have"):
        ck.MatchIndex(np.ones((3, 4, 64)))
    with pytest.raises(ValueError, match="descriptors hold"):
        ck.MatchIndex(np.full((3, 4, 6), np.inf, dtype=np.float16))


@pytest.mark.parametrize("kind", [np.float64, np.int32])
def test_descriptors_of_another_type_raise(kind):
    with pytest.raises(ValueError, match="expected float16 or float32"):
        ck.MatchIndex(np.ones((3, 20, 60), dtype=kind))
