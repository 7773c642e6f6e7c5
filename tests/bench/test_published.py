"""The published methods find what is plainly there: a crop of their own map, turned."""

from __future__ import annotations

import numpy as np
import pytest

from bench.forest.published import REACH, Occupancy, StemTriangles, around

YAW = np.radians(-150.0)  # of the odometry frame in the map


@pytest.fixture(scope="module")
def stand():
    """A stand of 120 m, 160 trees on flat ground: stems, and crowns of different heights."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(0, 120, (60_000, 2)), np.zeros(60_000)])
    parts = [ground]
    for x, y in rng.uniform(2, 118, (160, 2)):
        top = rng.uniform(8, 20)
        parts.append(np.column_stack([rng.normal((x, y), 0.05, (200, 2)), rng.uniform(0, top, 200)]))
        crown = rng.normal(0, 0.8, (200, 2))
        parts.append(np.column_stack([crown + np.array([x, y]), top - np.hypot(*crown.T)]))
    return np.concatenate(parts).astype(np.float32)


def query(stand):
    """What lies around (70, 48) as odometry has it, the robot at (5, -3) of it; image and robot."""
    robot, at = np.array([5.0, -3.0]), np.array([70.0, 48.0])
    near = stand[np.hypot(*(stand[:, :2] - at).T) < REACH]
    c, s = np.cos(-YAW), np.sin(-YAW)
    turned = (near[:, :2] - at) @ np.array([[c, s], [-s, c]]) + robot
    return around(np.column_stack([turned, near[:, 2]]).astype(np.float32), robot), at


def turn(one, other):
    return abs(np.degrees(np.angle(np.exp(1j * (one - other)))))


def test_occupancy_finds_place_and_heading(stand):
    image, at = query(stand)
    occupancy = Occupancy(stand)
    score, heading = occupancy.search(image)
    best = int(score.argmax())
    assert np.hypot(*(occupancy.places[best] - at)) < 3.0
    assert turn(heading[best], YAW) <= 7.0


def test_triangles_find_place_and_heading(stand):
    image, at = query(stand)
    xy, score, heading = StemTriangles(stand).search(image)
    best = int(score.argmax())
    assert np.hypot(*(xy[best] - at)) < 1.5
    assert turn(heading[best], YAW) <= 4.0
    assert score[best] > 0.6


def test_triangles_of_nothing_name_nothing(stand):
    bare = stand[stand[:, 2] < 0.1]
    image, _ = query(bare)
    assert len(StemTriangles(stand).search(image)[0]) == 0
    image, _ = query(stand)
    assert len(StemTriangles(bare).search(image)[0]) == 0
