"""Scores by the likelihood field: places of a keyframe, what they keep of the hypotheses that came to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, rotation_angle
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.registration.verification import verify
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.scoring import score_hypotheses

ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])  # map <- odometry


@pytest.fixture(scope="module")
def scan(world_drive):
    """A frame of the small world, with odometry in a frame of its own."""
    T = inverse(ODOM) @ world_drive.T_map_body[0]
    cloud = world_drive.clouds[0]
    points = (cloud @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return ScanInput(prepare_scan(points, T[:3, 3], LocalizerConfig().registration), cloud, T)


def off(forward, left, degrees, scan):
    """``T_map_odom`` that puts the robot beside its true place, and turned."""
    body = ODOM @ scan.T_odom_body @ pose_from(rot_z(np.radians(degrees)), [forward, left, 0.0])
    return body @ inverse(scan.T_odom_body)


def hypothesis(T, station=3, lead=0.0):
    return Hypothesis(T, station, 0, -1.0, lead=lead)


def test_hypotheses_near_the_right_place_become_one_and_keep_votes_and_lead(world_map, scan):
    near = [
        hypothesis(off(0.3, 0.2, 1.0, scan), station=None),
        hypothesis(off(-1.5, 1.0, -3.0, scan), lead=2.5),
        hypothesis(off(1.2, -1.4, 4.0, scan)),
    ]
    far = hypothesis(off(9.0, -7.0, 120.0, scan))
    scored = score_hypotheses(world_map.field, [far, *near], scan, best=10)
    assert len(scored.rivals) == len(scored.places) == 2
    best, other = scored.places
    gap = inverse(ODOM @ scan.T_odom_body) @ best.hypothesis.T_map_odom @ scan.T_odom_body
    assert np.linalg.norm(gap[:3, 3]) < 0.4
    assert rotation_angle(gap) < np.radians(1.5)
    assert (best.hypothesis.station, best.hypothesis.lead) == (3, 2.5)
    assert best.rank > 2 * other.rank
    np.testing.assert_array_equal(scored.rivals.T_map_odom[0], best.hypothesis.T_map_odom)
    assert scored.rivals.scores.tolist() == pytest.approx([best.score, other.score])


def test_hint_is_found_again_among_the_places(world_map, scan):
    hint = hypothesis(off(0.5, 0.5, 2.0, scan), station=None)
    wrong = [hypothesis(off(x, y, 90.0, scan)) for x in (-9.0, 9.0) for y in (-8.0, 8.0)]
    alone = score_hypotheses(world_map.field, [*wrong, hint], scan, best=1, hints=1).places
    assert [p.hinted for p in alone] == [True]
    assert alone[0].hypothesis.station is None
    supported = [*wrong, hypothesis(off(0.0, 0.0, 0.0, scan)), hint]
    (first,) = score_hypotheses(world_map.field, supported, scan, best=1, hints=1).places
    assert first.hinted
    assert first.hypothesis.station == 3
    lost = [hypothesis(ODOM), replace(hint, T_map_odom=off(9.0, 8.0, 90.0, scan))]
    places = score_hypotheses(world_map.field, lost, scan, best=1, hints=1).places
    assert [p.hinted for p in places] == [False, True]


def test_score_is_near_the_exact_one(world_map, scan):
    rng = np.random.default_rng(4)
    moves = np.column_stack([rng.uniform(-8, 8, (40, 2)), rng.uniform(-180, 180, 40)])
    rivals = score_hypotheses(
        world_map.field, [hypothesis(off(*m, scan)) for m in [(0, 0, 0), *moves]], scan, best=0
    ).rivals
    target = LocalMaps(world_map, 50.0).around((ODOM @ scan.T_odom_body)[:3, 3])
    exact = [
        verify(scan.cloud, T, scan.range_image, T @ scan.T_odom_body, target, world_map.survey).score
        for T in rivals.T_map_odom
    ]
    assert len(exact) > 10
    assert np.corrcoef(exact, rivals.scores)[0, 1] > 0.9
    assert exact[0] == max(exact)


def test_scan_without_structure_or_hypotheses_scores_nothing(world_map, scan):
    none = score_hypotheses(world_map.field, [], scan, best=5)
    assert len(none.rivals) == 0
    assert none.places == []
    ground, settings = scan.cloud.points[~scan.cloud.above], LocalizerConfig().registration
    flat = ScanInput(prepare_scan(ground, scan.T_odom_body[:3, 3], settings), scan.frame, scan.T_odom_body)
    scored = score_hypotheses(world_map.field, [hypothesis(ODOM)], flat, best=1)
    assert scored.rivals.scores.tolist() == [0.0]
