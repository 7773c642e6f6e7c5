"""The fine grid finds poses between its cells and headings."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from coview_stream.geometry import wrap_angle
from coview_stream.place.learned.fine_search import refine_on_grid


def world(seed, shape=(150, 170)):
    values = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(8, *shape)), (0, 1.5, 1.5))
    return (values / np.linalg.norm(values, axis=0)).astype(np.float32)


def seen_from(known, corner, x, y, yaw, size=64):
    at = np.arange(size) - (size - 1) / 2
    v, u = np.meshgrid(at, at, indexing="ij")
    c, s = np.cos(yaw), np.sin(yaw)
    where = [y + s * u + c * v - corner[1] - 0.5, x + c * u - s * v - corner[0] - 0.5]
    query = np.stack([ndimage.map_coordinates(channel, where, order=1) for channel in known])
    weight = (np.hypot(u, v) <= 30.0).astype(np.float32)
    return (query * weight).astype(np.float32), weight


@pytest.mark.parametrize(
    "truth", [(431.3, -20.6, 0.4), (470.0, 12.25, -2.9), (425.2, 40.4, 3.1), (480.5, -49.0, 1.57)]
)
def test_it_finds_the_pose_between_cells(truth):
    known, corner = world(0), np.array([380.0, -80.0])
    query, weight = seen_from(known, corner, *truth)
    start = (truth[0] + 3.1, truth[1] - 2.4, truth[2] + 0.13)
    found = refine_on_grid(query, weight, known, corner, start, steps=6)
    assert found is not None
    assert np.hypot(found.x - truth[0], found.y - truth[1]) < 0.15
    assert abs(wrap_angle(found.yaw - truth[2])) < np.radians(0.5)
    assert -np.pi <= found.yaw <= np.pi
    assert found.score > 0.8


def test_the_answer_stays_within_the_radius():
    known, corner = world(1), np.zeros(2)
    query, weight = seen_from(known, corner, 80.0, 70.0, 0.0)
    found = refine_on_grid(query, weight, known, corner, (90.0, 70.0, 0.0), radius=4.0)
    assert found is not None
    assert np.hypot(found.x - 90.0, found.y - 70.0) < 4.0 + 1.25
    assert found.score < 0.5


@pytest.mark.parametrize("start", [(500.0, 70.0, 0.0), (-500.0, 70.0, 0.0), (0.0, 0.0, 0.0)])
def test_off_the_map_there_is_none(start):
    known, corner = world(1), np.zeros(2)
    query, weight = seen_from(known, corner, 80.0, 70.0, 0.0)
    assert refine_on_grid(query, weight, known, corner, start) is None


def test_what_was_not_surveyed_gives_none_even_with_features():
    known, corner = world(1), np.zeros(2)
    query, weight = seen_from(known, corner, 80.0, 70.0, 0.0)
    surveyed = np.zeros(known.shape[1:], bool)
    assert refine_on_grid(query, weight, known, corner, (80, 70, 0), surveyed=surveyed) is None
    surveyed[:, :] = True
    assert refine_on_grid(query, weight, known, corner, (80, 70, 0), surveyed=surveyed) is not None


def test_no_steps_are_refused():
    known = world(1)
    query, weight = seen_from(known, np.zeros(2), 80.0, 70.0, 0.0)
    with pytest.raises(ValueError, match="0 steps"):
        refine_on_grid(query, weight, known, (0, 0), (80, 70, 0), steps=0)
