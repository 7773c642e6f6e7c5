"""Ambiguity of a map: identical rows are ambiguous, distinct buildings are not."""

import numpy as np
import pytest
import small_world
from any_risk import NEVER
from made_up_places import map_of, rows_of_boxes
from nightly import nightly
from small_world import Box

from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.coview import EYE
from coview_stream.localization.search.ambiguity import FARTHEST, ambiguity, sample, virtual_scan

PLACES = 8


@pytest.fixture(scope="module")
def rows_map():
    """Equal boxes on a square grid, to the map's edge."""
    return map_of(rows_of_boxes())


@pytest.mark.slow
def test_distinct_buildings_are_told_apart_and_equal_rows_are_not(world_map, rows_map):
    distinct, equal = (ambiguity(each, count=PLACES) for each in (world_map, rows_map))
    assert np.median(distinct.lead) > 2.0 * np.median(equal.lead)
    assert distinct.share(0.0) > equal.share(0.0)
    assert distinct.share(FARTHEST) > 0.7
    assert equal.share(0.0) < 0.3
    for found in (distinct, equal):
        assert 0 < len(found) <= PLACES
        assert ((found.drive == 0.0) <= (found.error < found.risk)).all()
        assert (found.drive >= 0.0).all()
        assert 0.0 <= found.share(5.0) <= found.share(FARTHEST) <= 1.0


@nightly
def test_changes_and_a_smaller_risk_make_places_harder_to_tell_apart(world_map):
    as_it_was, changed = (ambiguity(world_map, count=PLACES, changed=share) for share in (0.0, 0.6))
    assert np.median(as_it_was.evidence) > np.median(changed.evidence)
    strict = LocalizerConfig(acceptance=NEVER)
    none = ambiguity(world_map, strict, count=4, changed=0.6)
    assert not np.isfinite(none.drive).any()


@pytest.mark.slow
def test_same_map_gives_the_same_and_progress_counts_to_the_end(world_map):
    calls = []
    first = ambiguity(world_map, count=4, progress=lambda done, total: calls.append((done, total)))
    again = ambiguity(world_map, count=4)
    np.testing.assert_array_equal(first.drive, again.drive)
    np.testing.assert_array_equal(first.evidence, again.evidence)
    assert calls[: len(first)] == [(k + 1, len(first)) for k in range(len(first))]
    assert calls[-1][0] == calls[-1][1]


def test_sample_is_spread_over_the_map(world_map):
    chosen = sample(world_map, 20)
    assert 8 <= len(chosen) <= 20
    assert len(np.unique(chosen)) == len(chosen)
    xy = world_map.stations[chosen, :2]
    gaps = np.linalg.norm(xy[:, None] - xy, axis=2)[~np.eye(len(xy), dtype=bool)]
    assert gaps.min() > 1.0
    assert np.ptp(xy, axis=0).min() > 0.6 * 2 * small_world.HALF
    np.testing.assert_array_equal(sample(world_map, len(world_map)), np.arange(len(world_map)))
    assert len(sample(world_map, 1)) == 1


def seen(base_map, eye, changed=0.0):
    scan = virtual_scan(base_map, np.asarray(eye, dtype=np.float64), changed, LocalizerConfig().registration)
    assert scan is not None
    return scan


@pytest.mark.slow
def test_walls_hide_what_is_behind_them():
    wall = Box(np.array([8.0, 0.0]), np.array([1.0, 20.0, 6.0]), 0.0)
    behind = Box(np.array([16.0, 0.0]), np.array([3.0, 3.0, 4.0]), 0.0)
    beside = Box(np.array([-16.0, 0.0]), np.array([3.0, 3.0, 4.0]), 0.0)
    cloud = seen(map_of([wall, behind, beside]), [0.0, 0.0, EYE]).cloud
    high = cloud.points[cloud.height > 1.0]
    assert (np.abs(high[:, 0] - 7.5) < 0.5).sum() > 50
    assert (high[:, 0] < -14.0).sum() > 5
    assert not (high[:, 0] > 13.0).any()
    assert (high[:, 0] > -15.5).all()  # nor the far side of a building


@pytest.mark.slow
def test_changes_are_the_same_from_wherever_they_are_seen(world_map):
    eyes = [(-12.0, -4.0, EYE), (-10.0, -4.0, EYE)]
    before, after = (seen(world_map, eyes[0], changed).cloud for changed in (0.0, 0.5))
    assert share_near(after, before) < 0.8
    assert share_near(seen(world_map, eyes[1], 0.5).cloud, after) > share_near(after, before) + 0.1


def share_near(cloud, other):
    """Share of what stands in one scan that is within half a metre of the other's."""
    a, b = (each.points[each.height > 1.0] for each in (cloud, other))
    return float((np.linalg.norm(a[:, None] - b, axis=2).min(axis=1) < 0.5).mean())
