import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coview_kernels import all_shift_distance, column_spectra, polar_bin, unit_columns


@st.composite
def descriptors(draw, min_candidates=0):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rings, sectors = draw(st.integers(1, 8)), draw(st.integers(1, 13))
    candidates, queries = draw(st.integers(min_candidates, 5)), draw(st.integers(1, 3))
    desc = rng.normal(0, 3, (candidates + queries, rings, sectors)).astype(np.float32)
    desc[rng.random(desc.shape) < draw(st.sampled_from([0.0, 0.5, 0.95]))] = 0.0
    return desc[:queries], desc[queries:]


def loops(query, candidate):
    """Eqs 7-9, letter by letter; a column that is empty on either side costs 1."""
    sectors = query.shape[1]
    out = np.zeros(sectors)
    for n in range(sectors):
        for j in range(sectors):
            q, c = query[:, (j + n) % sectors].astype(float), candidate[:, j].astype(float)
            norms = np.linalg.norm(q) * np.linalg.norm(c)
            out[n] += 1.0 - (q @ c / norms if norms > 0 else 0.0)
    return out / sectors


@given(descriptors())
def test_all_shift_distance_agrees_with_loops(pair):
    queries, candidates = pair
    sectors = queries.shape[2]
    spectra = column_spectra(candidates)
    assert spectra.dtype == np.complex64
    assert spectra.shape == (sectors // 2 + 1, len(candidates), queries.shape[1])
    distance = all_shift_distance(queries, spectra, sectors)
    assert distance.dtype == np.float32
    expected = np.array([[loops(q, c) for c in candidates] for q in queries])
    np.testing.assert_allclose(distance, expected.reshape(distance.shape), atol=2e-6)
    np.testing.assert_allclose(all_shift_distance(queries[0], spectra, sectors), distance[0], atol=1e-6)


@pytest.mark.parametrize("steps", [0, 1, 7, 31, 59])
def test_shift_n_means_a_yaw_of_minus_n_sectors(steps):
    # bin centres, so that turning by whole sectors moves no point across an edge
    rng = np.random.default_rng(3)
    ring, sector = rng.integers(0, 20, 500), rng.integers(0, 60, 500)
    radius, azimuth = (ring + 0.5) * 2.5, (sector + 0.5) * 2 * np.pi / 60
    in_map = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), rng.uniform(1, 9, 500)], axis=1)
    yaw = -2 * np.pi * steps / 60
    heading = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    in_robot = in_map @ heading  # inverse rotation of rows: the robot's x axis points along yaw in the map
    map_grid, _ = polar_bin(in_map, (0, 0, 0), 20, 60, 50.0)
    robot_grid, _ = polar_bin(in_robot, (0, 0, 0), 20, 60, 50.0)
    distance = all_shift_distance(robot_grid.max_height, column_spectra(map_grid.max_height[None]), 60)
    assert distance.argmin() == steps
    occupied = np.count_nonzero(map_grid.count.sum(axis=0))
    assert distance.min() == pytest.approx(1 - occupied / 60, abs=1e-5)


@given(descriptors(min_candidates=1))
def test_unit_columns_have_length_one_or_stay_zero(pair):
    desc = pair[1]
    norm = np.linalg.norm(unit_columns(desc).astype(float), axis=-2)
    np.testing.assert_allclose(norm, desc.any(axis=-2).astype(float), atol=1e-6)


def test_unit_columns_of_tiny_values():
    np.testing.assert_allclose(unit_columns(np.full((4, 1), 1e-30)), 0.5)


@pytest.mark.parametrize("rings", [3, 5000])
def test_all_shift_distance_of_many_candidates(rings):
    rng = np.random.default_rng(8)
    desc = rng.normal(size=(12 if rings > 100 else 3000, rings, 4)).astype(np.float32)
    spectra = column_spectra(desc)
    distance = all_shift_distance(desc[:2], spectra, 4)
    unit = unit_columns(desc).astype(float)
    for q in range(2):
        for n in range(4):
            same = np.einsum("rs,mrs->m", np.roll(unit[q], -n, axis=1), unit) / 4
            np.testing.assert_allclose(distance[q, :, n], 1 - same, atol=1e-5)


def test_errors_name_the_argument():
    spectra = column_spectra(np.ones((3, 4, 6)))
    with pytest.raises(ValueError, match="query"):
        all_shift_distance(np.ones((4, 7)), spectra, 6)
    with pytest.raises(ValueError, match="spectra"):
        all_shift_distance(np.ones((5, 6)), spectra, 6)
    with pytest.raises(ValueError, match="desc"):
        column_spectra(np.ones((4, 6)))
    with pytest.raises(ValueError, match="desc"):
        unit_columns(np.ones(4))
