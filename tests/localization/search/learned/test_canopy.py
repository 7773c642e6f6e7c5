"""A canopy seen from below is found where the map has it, at its heading; too little of it names nothing."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.config import LearnedConfig
from coview_stream.geometry.transforms import rot_z
from coview_stream.localization.search.consensus import yaw_of_shift
from coview_stream.localization.search.learned.canopy import CanopyMatcher, encoded, map_canopy

TREES = 260
SIZE = 150.0  # metres


@pytest.fixture(scope="module")
def forest():
    """Crowns of many heights over level ground, (N, 3)."""
    rng = np.random.default_rng(4)
    at, height, radius = rng.uniform(0, SIZE, (TREES, 2)), rng.uniform(4, 28, TREES), rng.uniform(1.5, 4.0, TREES)
    parts = [np.column_stack([rng.uniform(0, SIZE, (60_000, 2)), rng.normal(0, 0.02, 60_000)])]
    for xy, top, r in zip(at, height, radius, strict=True):
        turn, out = rng.uniform(0, 2 * np.pi, 400), r * np.sqrt(rng.random(400))
        crown = xy + out[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        parts.append(np.column_stack([crown, top - 0.3 * out**2 + rng.normal(0, 0.05, 400)]))
    return np.concatenate(parts).astype(np.float32)


@pytest.fixture(scope="module")
def matcher(forest):
    axis = np.arange(1.0, SIZE, 2.0)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    stations = np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32)
    return CanopyMatcher(forest, stations, LearnedConfig())


def around(forest, robot, yaw):
    """What stands within 28 m of the robot, in an odometry frame that is turned by ``yaw`` in the map."""
    near = forest[np.hypot(*(forest[:, :2] - robot).T) < 28.0] - np.array([*robot, 0.0])
    return (near @ rot_z(yaw)).astype(np.float32)


def test_encodings_agree_the_less_the_heights_do() -> None:
    one = encoded(np.zeros((1, 1), dtype=np.float32))
    others = [encoded(np.full((1, 1), h, dtype=np.float32)) for h in (0.0, 0.5, 1.0, 2.0, 4.0)]
    products = [float((one * other).sum()) for other in others]
    assert products[0] == pytest.approx(1.0)
    assert products == sorted(products, reverse=True)


def test_a_map_in_pieces_is_drawn_as_a_whole(forest) -> None:
    corner, top, seen = map_canopy(forest)
    x, y, z = forest[forest[:, 2] > 3.0].T
    column, row = (np.floor(each).astype(int) for each in (x - corner[0], y - corner[1]))
    greatest = np.zeros_like(top)
    np.maximum.at(greatest, (row, column), z)
    tall = greatest > 0.0
    assert seen[tall].all()
    assert np.percentile(np.abs(top[tall] - greatest[tall]), 95) < 0.5


@pytest.mark.parametrize(("robot", "yaw"), [((61.0, 87.0), 0.35), ((101.0, 45.0), 4.0)])
def test_the_place_and_its_heading_come_first(forest, matcher, robot, yaw) -> None:
    query = matcher.encode(around(forest, robot, yaw), np.zeros(3))
    assert query is not None
    vote = matcher.vote(query)
    stations, shifts = vote.candidates()
    best = vote.at(stations, shifts).argmin()
    assert np.hypot(*(matcher.stations[stations[best], :2] - robot)) < 3.0
    off = yaw_of_shift(shifts[best], vote.sectors) - yaw
    assert abs(np.angle(np.exp(1j * off))) < np.radians(11)


def test_too_little_names_nothing(forest, matcher) -> None:
    few = around(forest, (61.0, 87.0), 0.0)
    assert matcher.encode(few[np.hypot(*few[:, :2].T) < 2.0], np.zeros(3)) is None
