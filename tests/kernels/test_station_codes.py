"""Coded stations: kernels equal their twins, scores are near the exact correlations, files and copies give the same."""

import copy
import os
import pickle

import numpy as np
import pytest

import coview_kernels as ck
from coview_kernels import StationCodes, reference, station_codes

M, R, S = 300, 8, 60
NATIVE = pytest.mark.skipif(os.environ.get("COVIEW_KERNELS") == "numpy", reason="the kernel itself")


def scene(seed=0, m=M, r=R, s=S, channels=2):
    """Smooth random descriptors and a query that is one of them, turned and noisy."""
    rng = np.random.default_rng(seed)
    rough = rng.gamma(1.0, 3.0, (channels, m, r, s)) * (rng.random((channels, m, r, s)) < 0.7)
    smooth = (rough + np.roll(rough, 1, axis=-1) + np.roll(rough, 2, axis=-1)).astype(np.float16)
    return list(smooth), rng


def stacked(query):
    return np.concatenate([ck.unit_columns(each) for each in query])


def exact(columns, descriptors):
    """Correlations (M, S) in float64, by the definition (eqs 7-9)."""
    stations = np.concatenate([ck.unit_columns(each) for each in descriptors], axis=1).astype(np.float64)
    sectors = columns.shape[1]
    turned = [np.roll(columns, -n, axis=1) for n in range(sectors)]
    return np.stack([np.einsum("rs,mrs->m", each, stations) for each in turned], axis=1) / sectors


@pytest.fixture(scope="module")
def known():
    descriptors, rng = scene()
    query = [np.roll(each[70], 11, axis=1).astype(np.float32) + rng.uniform(0, 1, (R, S)) for each in descriptors]
    return StationCodes.of(descriptors), stacked(query), exact(stacked(query), descriptors)


def test_all_shifts_are_near_the_exact_correlations(known):
    codes, columns, expected = known
    found = codes.all_shifts(codes.query(columns), np.arange(M))
    assert np.unravel_index(found.argmax(), found.shape) == (70, 11)
    # of noise, in which nothing can be left out; 0.12 of a standard deviation on simulated sites
    assert (found - expected).std() < 0.6 * expected.std()
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.8


@pytest.mark.parametrize(("tiers", "rings", "channels"), [(1, 4, 1), (2, 8, 2)])  # the first of two keeps 12 rings
def test_few_rings_and_sectors_are_kept_whole(tiers, rings, channels):
    """What fits the codes is only rounded to bytes."""
    descriptors, _ = scene(1, r=rings, s=24, channels=channels)
    columns = stacked([each[9] for each in descriptors])
    found = sum(each.all_shifts(each.query(columns), np.arange(M)) for each in StationCodes.tiers(descriptors, tiers))
    np.testing.assert_allclose(found, exact(columns, descriptors), atol=0.02)


def test_single_pairs_and_all_shifts_agree(known):
    codes, columns, _ = known
    query, rng = codes.query(columns), np.random.default_rng(2)
    station, shift = rng.integers(-1, M, 500), rng.integers(0, S, 500)
    every = codes.all_shifts(query, np.arange(M))
    expected = np.where(station < 0, 0.0, every[station, shift])
    np.testing.assert_allclose(codes.at(query, station, shift), expected, atol=2e-5)


def test_a_station_asks_for_those_like_it(known):
    descriptors, _ = scene()
    for each in descriptors:
        each[30] = np.roll(each[70], 11, axis=1)
    codes = StationCodes.of(descriptors)
    for query in (codes.query_of(70), codes.query(stacked([each[70] for each in descriptors]))):
        best = codes.best(query)
        assert set(best.argsort()[-2:]) == {30, 70}
        assert codes.all_shifts(query, [70, 30]).argmax(axis=1).tolist() == [0, S - 11]
    assert codes.lengths[70] == pytest.approx(np.linalg.norm(codes.query_of(70).numbers), rel=1e-5)


def test_best_is_the_maximum_over_the_shifts(known):
    codes, columns, _ = known
    query = codes.query(columns)
    spread = np.abs(codes.all_shifts(query, np.arange(M))).max()
    np.testing.assert_allclose(codes.best(query), codes.all_shifts(query, np.arange(M)).max(axis=1), atol=0.02 * spread)


@pytest.mark.parametrize("sectors", [4, 7, 36, 61, 90, 120])
def test_any_number_of_sectors_finds_the_station_and_its_heading(sectors):
    descriptors, _ = scene(3, m=120, s=sectors)
    codes = StationCodes.of(descriptors)
    turn = sectors // 3
    query = codes.query(stacked([np.roll(each[50], turn, axis=1) for each in descriptors]))
    assert codes.best(query).argmax() == 50
    assert codes.all_shifts(query, [50]).argmax() == turn
    assert codes.query(np.zeros_like(stacked([each[0] for each in descriptors]))).screen.unit > 0


@NATIVE
@pytest.mark.parametrize("parallel", [False, True])
def test_kernels_agree_with_numpy(known, monkeypatch, parallel):
    codes, columns, _ = known
    if parallel:
        monkeypatch.setattr(station_codes, "_MIN_PARALLEL", 1)
    native, rng = StationCodes(codes.codes, codes.basis, codes.step, codes.norm, S), np.random.default_rng(4)
    query = native.query(columns)
    if ck.backend() == "numpy":
        pytest.skip("no kernels here")
    best = reference.best_codes(codes.codes, query.screen.integers, query.screen.turn)
    np.testing.assert_array_equal(native.best(query), best * np.float32(query.screen.unit))
    monkeypatch.setattr(station_codes, "_CHUNK", 64)
    native = StationCodes(codes.codes, codes.basis, codes.step, codes.norm, S)
    station, shift = rng.integers(-1, M, 150).astype(np.int32), rng.integers(0, S, 150).astype(np.int32)
    expected = reference.codes_at(codes.codes, query.table, station, shift)
    np.testing.assert_allclose(native.at(query, station, shift), expected, atol=1e-5)
    every = native.all_shifts(query, np.abs(station))[np.arange(150), shift]
    np.testing.assert_allclose(np.where(station < 0, 0.0, every), expected, atol=2e-5)


def test_integers_never_leave_16_bits():
    """Stations far from what the codes were learned from, and a query that is one of them."""
    descriptors, rng = scene(5, m=2100, channels=1)
    descriptors[0][1::2] = 0
    descriptors[0][1::2, 3] = rng.uniform(5, 9, (1050, S))  # every second one is not in the sample
    codes = StationCodes.of(descriptors)
    for station in (0, 1, 801):
        query = codes.query(stacked([descriptors[0][station]]))
        every = codes.all_shifts(query, np.arange(0, 2100, 3)).max(axis=1)
        np.testing.assert_allclose(codes.best(query)[::3], every, atol=0.02)


def test_copies_and_pickles_compute_the_same(known):
    codes, columns, _ = known
    query = codes.query(columns)
    for other in (copy.deepcopy(codes), pickle.loads(pickle.dumps(codes))):
        np.testing.assert_array_equal(other.best(other.query(columns)), codes.best(query))


def test_second_tier_adds_what_the_first_leaves_out(known):
    _, columns, expected = known
    first, second = StationCodes.tiers(scene()[0], 2)
    alone = first.all_shifts(first.query(columns), np.arange(M))
    np.testing.assert_array_equal(alone, known[0].all_shifts(known[0].query(columns), np.arange(M)))
    both = alone + second.all_shifts(second.query(columns), np.arange(M))
    assert (both - expected).std() < 0.95 * (alone - expected).std()


def test_channels_of_different_shapes_raise():
    descriptors, _ = scene()
    with pytest.raises(ValueError, match="expected one for all"):
        StationCodes.of([descriptors[0], descriptors[1][:, :4]])
    codes = StationCodes.of(descriptors)
    with pytest.raises(ValueError, match="columns has shape"):
        codes.query(np.ones((3, S)))
