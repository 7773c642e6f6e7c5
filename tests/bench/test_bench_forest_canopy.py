"""The canopy baseline finds planted shifts and headings, and says nothing where too little overlaps."""

import numpy as np
import pytest

from bench.forest.canopy import COARSE, Canopy, heights, seen_from

CORNER = np.array([-40.0, 20.0])


@pytest.fixture(scope="module")
def canopy():
    rng = np.random.default_rng(3)
    top = rng.uniform(0.0, 25.0, (60, 70))
    return top, Canopy.of(top, np.ones(top.shape, dtype=bool), CORNER)


def planted(top, row, column, yaw, radius=24.0):
    """What is seen around the middle of a cell at some heading: cells and heights, in the robot's axes."""
    rows, columns = np.indices(top.shape)
    apart = np.stack([columns - column, rows - row], axis=-1) * COARSE
    near = np.hypot(apart[..., 0], apart[..., 1]) < radius
    c, s = np.cos(yaw), np.sin(yaw)
    return apart[near] @ np.array([[c, -s], [s, c]]), top[near]


@pytest.mark.parametrize(("row", "column", "turns"), [(30, 33, 0), (22, 40, 18), (35, 25, 54)])
def test_a_planted_place_and_heading_is_found(canopy, row, column, turns):
    top, searched = canopy
    yaw = 2 * np.pi * turns / 72
    xy, seen = planted(top, row, column, yaw)
    score, heading = searched.search(xy, 2.0 * seen + 3.0)  # neither gain nor offset matters
    best = np.unravel_index(int(score.argmax()), score.shape)
    assert best == (row, column)
    assert score[best] == pytest.approx(1.0, abs=1e-6)
    assert heading[best] == pytest.approx(yaw)
    place = searched.places.reshape(*score.shape, 2)[best]
    np.testing.assert_allclose(place, CORNER + (np.array([column, row]) + 0.5) * COARSE)
    score[best] = -np.inf
    assert score.max() < 0.6


def test_correlation_is_that_of_the_overlap_alone(canopy):
    """Compared with the textbook formula, cell by cell, on a map with holes."""
    top, _ = canopy
    known = np.random.default_rng(4).random(top.shape) < 0.85
    searched = Canopy.of(top, known, CORNER)
    xy, seen = planted(top + np.random.default_rng(5).normal(0, 5, top.shape), 30, 30, 0.0, radius=10.0)
    image, mask = searched._turned(xy, seen, 0.0)
    score = searched._at(image, mask)
    half = len(mask) // 2
    for row, column in ((30, 30), (20, 41), (17, 18)):
        part = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
        both = (mask > 0) & known[part]
        expected = np.corrcoef(image[both], top[part][both])[0, 1]
        assert score[row, column] == pytest.approx(expected, abs=1e-9)


def test_where_the_map_knows_too_little_nothing_is_scored(canopy):
    top, _ = canopy
    known = np.ones(top.shape, dtype=bool)
    known[:, :35] = False
    searched = Canopy.of(top, known, CORNER)
    xy, seen = planted(top, 30, 50, 0.0)
    score, _ = searched.search(xy, seen)
    assert np.isneginf(score[30, 20])
    assert np.isfinite(score[30, 50])


def test_two_clouds_of_a_forest_meet():
    """From points: a query cut out of the map's own cloud, turned and shifted, is found within a cell."""
    rng = np.random.default_rng(6)
    stems = rng.uniform(-60, 60, (220, 2))
    tall = rng.uniform(5, 25, 220)
    flat = np.column_stack([rng.uniform(-60, 60, (40_000, 2)), rng.normal(0, 0.02, 40_000)])
    spots = np.repeat(stems, 60, axis=0) + rng.normal(0, 1.2, (220 * 60, 2))
    crowns = np.column_stack([spots, np.repeat(tall, 60) * rng.uniform(0.8, 1.0, 220 * 60)])
    cloud = np.concatenate([flat, crowns]).astype(np.float32)
    yaw, at = np.radians(35.0), np.array([12.0, -9.0])
    c, s = np.cos(yaw), np.sin(yaw)
    moved = cloud.copy()
    moved[:, :2] = (cloud[:, :2] - at) @ np.array([[c, -s], [s, c]])
    searched = Canopy(cloud)
    score, heading = searched.search(*seen_from(moved, np.zeros(3)))
    best = int(score.argmax())
    assert np.linalg.norm(searched.places[best] - at) < COARSE
    assert heading.ravel()[best] == pytest.approx(yaw, abs=np.radians(5.1))


def test_heights_are_above_the_ground():
    xy = np.stack(np.meshgrid(np.arange(0.25, 16, 0.5), np.arange(0.25, 16, 0.5)), axis=-1).reshape(-1, 2)
    slope = np.column_stack([xy, 0.3 * xy[:, 0]])
    crown = np.array([[8.1, 8.1, 0.3 * 8.1 + 10.0]])
    top, seen = heights(np.concatenate([slope, crown]).astype(np.float32), np.zeros(2), (32, 32))
    assert seen.all()
    assert top[16, 16] == pytest.approx(10.0, abs=0.5)
    assert np.median(top) < 0.5
