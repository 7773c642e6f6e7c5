"""Modes of a place: posts in a row are as good a metre on, unless the row's end is seen."""

from dataclasses import replace

import numpy as np
import pytest
import small_world
from made_up_places import candidate, place
from small_world import Box
from trackers import observed

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search import refinement
from coview_stream.localization.search.refinement import Modes, find_modes
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.scoring import PlaceScorer

CONFIG = LocalizerConfig()
T_MAP_ODOM = pose_from(rot_z(0.9), [14.0, -6.0, 0.4])
ROW = [Box(np.array([x, 3.0]), np.array([0.5, 0.5, 3.0]), 0.0) for x in np.arange(-14.0, 14.5)]  # a metre apart
WALL = Box(np.array([0.0, -9.0]), np.array([60.0, 6.0, 4.0]), 0.0)
END = Box(np.array([23.0, 8.0]), np.array([6.0, 20.0, 5.0]), 0.0)
NOTHING = np.empty((0, 3), dtype=np.float32)


@pytest.fixture(scope="module")
def points():
    return small_world.sample_map([*ROW, WALL, END])


@pytest.fixture(scope="module")
def row_map(points):
    return BaseMap.build(points.astype(np.float32), radius=30.0)


def look(row_map, points, x, reach, start):
    """Modes of the place of a robot at ``x`` that sees all within ``reach`` metres, registered ``start`` m off."""
    truth = pose_from(rot_z(0.2), [x, 0.0, small_world.SENSOR_HEIGHT])
    near = points[np.linalg.norm(points[:, :2] - truth[:2, 3], axis=1) < reach]
    cloud = transform(inverse(truth), near).astype(np.float32)
    T_odom_body = inverse(T_MAP_ODOM) @ truth
    scan = observed(cloud, T_odom_body)
    request = SearchRequest(0.0, T_odom_body, NOTHING, NOTHING, NOTHING, 0.0, (0, 0))
    named = place(1.0, pose_from(np.eye(3), [start, 0.0, 0.0]) @ T_MAP_ODOM)
    scorer, maps = PlaceScorer(row_map), LocalMaps(row_map, 50.0)
    scorer.score([named, *elsewhere(scan)], range(31), 0, scan)
    return find_modes(named, candidate(named), scan, request, row_map, CONFIG, maps, scorer.beside)


def elsewhere(scan):
    """Thirty wrong places, for the background."""
    rng = np.random.default_rng(3)
    turns = [rot_z(angle) for angle in rng.uniform(-np.pi, np.pi, 30)]
    shifts = np.column_stack([rng.uniform(-20, 20, (30, 2)), np.zeros(30)])
    poses = zip(turns, T_MAP_ODOM[:3, 3] + shifts, strict=True)
    return [place(1.0, pose_from(turn, at)) for turn, at in poses]


def off(found: Modes) -> float:
    """Metres along the row that the best mode lies off the truth."""
    return float((found.best.T_map_odom @ inverse(T_MAP_ODOM))[0, 3])


def test_equal_modes_leave_it_undecided(row_map, points):
    found = look(row_map, points, 0.0, 6.0, 0.0)
    assert found.undecided > 0.5
    # two posts on; which of the modes within a third of a metre is the best is chance
    assert found.distances.max() == pytest.approx(2.0, abs=0.35)
    assert found.probabilities.max() < 0.5
    assert found.probabilities.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("start", [0.0, 1.0, -1.0])
def test_mode_that_the_scan_speaks_for_wins_wherever_it_began(row_map, points, start):
    """The wall across the end of the row is seen."""
    found = look(row_map, points, 11.0, 12.0, start)
    assert found.undecided == 0.0
    assert off(found) == pytest.approx(0.0, abs=0.1)
    assert found.probabilities[0] > 0.8


def test_same_mode_counts_once(row_map, points):
    found = look(row_map, points, 11.0, 12.0, 0.0)
    assert found.distances[0] == 0.0
    assert (found.distances[1:] > 0.25).all()
    assert 1 < len(found.distances) < 9


def test_only_modes_within_the_place_count(row_map, points, monkeypatch):
    """Registration that runs away is of no mode here; nor is one that fails."""
    started = []

    def elsewhere(place, scan, base_map, config, local_maps, start):
        started.append(start[:2, 3] - T_MAP_ODOM[:2, 3])
        if len(started) % 2:
            return None
        away = start.copy()
        away[0, 3] += 4.0
        return candidate(replace(place, T_map_odom=away))

    monkeypatch.setattr(refinement, "register_place", elsewhere)
    found = look(row_map, points, 11.0, 12.0, 0.0)
    assert found.distances.tolist() == [0.0]
    assert found.probabilities.tolist() == [1.0]
    assert found.undecided == 0.0
    np.testing.assert_allclose(np.linalg.norm(started, axis=1), 1.2)
    np.testing.assert_allclose(np.mean(started, axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("distances", "probabilities", "undecided"),
    [
        ([0.0], [1.0], 0.0),
        ([0.0, 1.1], [0.5, 0.5], 1.1),
        ([0.0, 1.1], [0.51, 0.49], 0.0),
        ([0.0, 0.4], [0.5, 0.5], 0.0),  # within half of the alert limit: either will do
        ([0.0, 0.9, 0.4, 1.3], [0.3, 0.28, 0.16, 0.26], 0.9),
    ],
)
def test_modes_elsewhere_count_together(distances, probabilities, undecided):
    places = [candidate(place(1.0)) for _ in distances]
    modes = Modes(places[0], np.array(distances), np.array(probabilities), places)
    assert modes.undecided == undecided
    odds = [p / probabilities[0] for p, metres in zip(probabilities, distances, strict=True) if metres > 0.5]
    assert [each.probability for each in modes.distant] == pytest.approx(odds)
