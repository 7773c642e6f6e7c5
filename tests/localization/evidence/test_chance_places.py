"""Chance places around a pose: they lie at all sides, and tell what chance explains in that neighbourhood."""

from __future__ import annotations

import numpy as np
import pytest

from coview_kernels import Move
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.background import (
    Most,
    chance_places,
    estimate_background,
    observe_with_background,
    scatter,
)
from coview_stream.localization.evidence.observation import ObservedScan, Share
from coview_stream.localization.registration.prepare_scan import prepare_scan, voxelized

T_MAP_ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])


@pytest.fixture(scope="module")
def seen(world_drive):
    config, cloud = LocalizerConfig(), world_drive.clouds[4]
    T = inverse(T_MAP_ODOM) @ world_drive.T_map_body[4]
    points = prepare_scan(voxelized(cloud, T, config.keyframe), T[:3, 3], config.registration)
    return ObservedScan.of(points, cloud, T)


def test_chance_places_lie_around_at_all_sides():
    around = chance_places(np.array([5.0, -3.0, 1.0, 0.2]))
    gap = around[:, :2] - [5.0, -3.0]
    assert len(around) == 32
    assert np.linalg.norm(gap, axis=1).min() == pytest.approx(3.0)
    np.testing.assert_allclose(gap.mean(axis=0), 0.0, atol=1e-9)
    assert (around[:, 2] == 1.0).all()
    assert np.abs(around[:, 3] - 0.2).min() > 0.0


def test_background_is_what_the_places_around_the_first_pose_explain(world_map, seen):
    away = T_MAP_ODOM.copy()
    away[:2, 3] += [0.9, -0.7]
    both = np.stack([T_MAP_ODOM, away])
    observed, background = observe_with_background(world_map.field, seen, both)
    chance = seen.few.look_up(world_map.field, chance_places(seen.poses(both)[0]), Move.NONE).shares
    expected = estimate_background(chance, scatter(chance), chance[:0], Most(*seen.patches))
    np.testing.assert_allclose(background.structure, expected.structure)
    assert background.passed == pytest.approx(expected.passed)
    assert background.ground == pytest.approx(expected.ground)
    assert background.number == pytest.approx(expected.number)
    np.testing.assert_array_equal(observed, seen.few.look_up(world_map.field, seen.poses(both), Move.NONE).shares)
    assert observed[0, Share.NEAR] > observed[1, Share.NEAR] > chance[:, Share.NEAR].mean()
    other, _ = observe_with_background(world_map.field, seen, both[::-1])
    np.testing.assert_array_equal(other, observed[::-1])
