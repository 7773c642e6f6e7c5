"""Places of a search: what the keyframes observe there, what they keep of the hypotheses that came to them."""

import weakref
from dataclasses import replace

import numpy as np
import pytest
from trackers import observed

from coview_kernels import Move
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, rotation_angle
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.evidence.paths import look_back
from coview_stream.localization.registration.clouds import prepare_scan
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.scoring import PlaceScorer

ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])  # map <- odometry


def scan_of(world_drive, k):
    """A frame of the small world, with odometry in a frame of its own."""
    return observed(world_drive.clouds[k], inverse(ODOM) @ world_drive.T_map_body[k], voxels=False)


@pytest.fixture(scope="module")
def scan(world_drive):
    return scan_of(world_drive, 0)


@pytest.fixture
def scorer(world_map):
    return PlaceScorer(world_map)


def off(forward, left, degrees, scan):
    """``T_map_odom`` that puts the robot beside its true place, and turned."""
    body = ODOM @ scan.T_odom_body @ pose_from(rot_z(np.radians(degrees)), [forward, left, 0.0])
    return body @ inverse(scan.T_odom_body)


def hypothesis(T, station=3):
    return Hypothesis(T, station, 0, -1.0)


def scored(scorer, hypotheses, scan, hints=0):
    return scorer.score(hypotheses, range(len(hypotheses)), hints, scan)


def some_places(scan, count=40, seed=4):
    """The right place and others, at random."""
    rng = np.random.default_rng(seed)
    moves = np.column_stack([rng.uniform(-8, 8, (count, 2)), rng.uniform(-180, 180, count)])
    return [hypothesis(off(*m, scan), n) for n, m in enumerate([(0, 0, 0), *moves])]


def is_right(place, scan, metres=0.4):
    gap = inverse(ODOM @ scan.T_odom_body) @ place.T_map_odom @ scan.T_odom_body
    return np.linalg.norm(gap[:3, 3]) < metres and rotation_angle(gap) < np.radians(1.5)


def test_hypotheses_near_the_right_place_become_one_and_keep_votes(scorer, scan):
    near = [
        hypothesis(off(0.3, 0.2, 1.0, scan), station=None),
        hypothesis(off(-1.5, 1.0, -3.0, scan)),
        hypothesis(off(1.2, -1.4, 4.0, scan)),
    ]
    far = hypothesis(off(9.0, -7.0, 120.0, scan), station=8)
    result = scored(scorer, [far, *near], scan)
    assert result.rivals == len(result.places) == 2
    best, other = result.places
    assert is_right(best, scan)
    assert (best.station, other.station) == (3, 8)
    assert best.ratio > other.ratio
    assert result.second is other


def test_best_places_are_moved_once_more_with_many_points(world_map, world_drive):
    """What a few points find is decimetres off, and its evidence too small."""
    once, more = [], []
    for k in range(4):
        scan = scan_of(world_drive, k)
        for start in (off(1.5, -1.1, 4.0, scan), off(-1.2, 1.7, -3.0, scan)):
            far = scan.few.look_up(world_map.field, scan.poses(start[None]), Move.FAR).poses
            place = scored(PlaceScorer(world_map), [hypothesis(start), *some_places(scan, 12)[1:]], scan).places[0]
            for gaps, T in (once, scan.transforms(far)[0]), (more, place.T_map_odom):
                gaps.append(np.linalg.norm(((T - ODOM) @ scan.T_odom_body)[:2, 3]))
    assert np.mean(more) < 0.8 * np.mean(once)


def test_probabilities_of_places_and_none_of_these_sum_to_one(scorer, scan):
    result = scored(scorer, some_places(scan), scan)
    probability = np.array([place.probability for place in result.places])
    assert probability.sum() + result.none == pytest.approx(1.0, abs=1e-9)
    assert (np.diff(probability) <= 1e-12).all()
    assert is_right(result.places[0], scan)
    # places beside the first from which registration leads to it may be no error; all others are
    assert result.none <= result.error <= result.none + probability[1:].sum() + 1e-12


def test_hint_is_found_again_among_the_places(world_map, scan):
    hint = hypothesis(off(0.5, 0.5, 2.0, scan), station=None)
    wrong = [hypothesis(off(x, y, 90.0, scan)) for x in (-9.0, 9.0) for y in (-8.0, 8.0)]
    alone = scored(PlaceScorer(world_map), [*wrong, hint], scan, hints=1).places
    assert [place.hinted for place in alone] == [True, False, False, False, False]
    assert alone[0].station is None
    supported = [*wrong, hypothesis(off(0.0, 0.0, 0.0, scan)), hint]
    first = scored(PlaceScorer(world_map), supported, scan, hints=1).places[0]
    assert first.hinted
    assert first.station == 3
    lost = [hypothesis(ODOM), replace(hint, T_map_odom=off(9.0, 8.0, 90.0, scan))]
    places = scored(PlaceScorer(world_map), lost, scan, hints=1).places
    assert [place.hinted for place in places] == [False, True]


def test_hint_is_no_better_than_a_vote(world_map, scan):
    """A hint has no rank in any vote: the same place, named by the first of the votes, is more probable."""
    others = some_places(scan)[1:]
    right = hypothesis(off(0.0, 0.0, 0.0, scan), station=None)
    hinted = scored(PlaceScorer(world_map), [*others, right], scan, hints=1)
    voted = scored(PlaceScorer(world_map), [hypothesis(right.T_map_odom), *others], scan)
    assert is_right(hinted.places[0], scan)
    assert hinted.error >= voted.error


def test_scan_without_structure_or_hypotheses_is_found_nowhere(scorer, scan, world_drive):
    none = scored(scorer, [], scan)
    assert none.rivals == 0
    assert none.places == []
    assert (none.error, none.none) == (1.0, 1.0)
    ground, settings = scan.cloud.points[~scan.cloud.above], LocalizerConfig().registration
    flat = ObservedScan.of(prepare_scan(ground, scan.body, settings), world_drive.clouds[0], scan.T_odom_body)
    scorer.clear()
    result = scored(scorer, [hypothesis(ODOM)], flat)
    assert [place.score for place in result.places] == [0.0]
    assert result.error > 1e-2


def test_place_that_is_new_is_observed_from_earlier_keyframes_as_well(world_map, world_drive):
    """Places are compared on the same observations, whenever they came up."""
    scans = [scan_of(world_drive, k) for k in range(4)]
    right, *others = some_places(scans[0])
    late, early = PlaceScorer(world_map), PlaceScorer(world_map)
    for scan in scans[:3]:
        scored(late, others, scan)
        scored(early, [right, *others], scan)
    result = [scored(scorer, [right, *others], scans[3]).places[0] for scorer in (late, early)]
    assert all(is_right(place, scans[3]) for place in result)
    assert result[0].ratio == pytest.approx(result[1].ratio, rel=0.25)


def test_place_whose_keyframes_lead_to_the_leader_is_hardly_a_rival(scorer, world_drive):
    """It keeps its pose, its hint and its votes, but the evidence at the leader is not its own."""
    for k in range(4):
        scan = scan_of(world_drive, k)
        aside = hypothesis(off(2.6, 0.0, 0.0, scan), station=None)
        result = scored(scorer, [*some_places(scan, 12), aside], scan, hints=1)
    assert is_right(result.places[0], scan)
    gaps = [np.linalg.norm(((place.T_map_odom - ODOM) @ scan.T_odom_body)[:2, 3]) for place in result.places]
    assert sum(gap < 1.0 for gap in gaps) == 1
    assert result.error < 1e-3


def test_hypotheses_beside_the_leader_are_tried(world_map, world_drive):
    """Along a corridor the robot may be anywhere: what lies beside the best place is its rival."""
    scorer = PlaceScorer(world_map)
    scan = scan_of(world_drive, 0)
    assert scored(scorer, [hypothesis(ODOM)], scan).rivals == 1
    result = scored(scorer, [], scan)
    assert result.rivals > 3
    poses = np.array([place.T_map_odom for place in result.places])
    gap = np.linalg.norm((poses - ODOM) @ np.append(scan.T_odom_body[:3, 3], 1.0), axis=1)
    assert 2.0 < np.sort(gap)[1] < 12.0


def test_keyframes_far_apart_are_kept(world_map, world_drive):
    """What saw least of its own is forgotten: of many keyframes at one place most."""
    scorer, refs = PlaceScorer(world_map), []
    for k in (0, *[2] * 18, 4):
        scan = scan_of(world_drive, k)
        assert is_right(scored(scorer, some_places(scan, 12), scan).places[0], scan)
        refs.append(weakref.ref(scan))
    del scan
    held = [ref() is not None for ref in refs]
    assert held[0]
    assert held[-1]
    assert sum(held) < len(held) - 4


@pytest.mark.slow
def test_keyframes_that_name_no_place_do_not_shift_the_others(scorer, world_map, world_drive):
    """An open field first: what is kept of each keyframe stays that keyframe's when the oldest are forgotten."""
    for k in range(3):
        assert not scored(scorer, [], scan_of(world_drive, k)).places
    for k in range(16):
        own = scan_of(world_drive, k % 6)
        assert is_right(scored(scorer, some_places(own), own).places[0], own)
    again, _ = look_back(world_map.field, scorer.scans, own.transforms(scorer.chance[0]))
    apart = np.abs(scorer.chance[1][:, -8:, None] - again[:, None]).mean(axis=(0, 3))  # of the eight newest keyframes
    assert np.diagonal(apart).max() < 0.7 * apart.mean()


def test_rivals_are_compared_at_their_best_pose(scorer, scan):
    """Half a metre beside the right pose much less is explained; moved back, it is as good as the leader was."""
    leader = scored(scorer, some_places(scan), scan).places[0]
    beside, elsewhere = leader.T_map_odom.copy(), off(-20.0, 5.0, 70.0, scan)
    beside[:2, 3] += 0.5, -0.5
    moved, wrong = scorer.at_their_best(
        elsewhere, np.array([beside, off(20.0, 5.0, 70.0, scan)]), np.zeros(2, int), scan
    )
    ratio = scorer.beside(beside[None])[0]
    assert moved.ratio > ratio + 5.0
    assert moved.probability > 0.3
    assert wrong.probability < 1e-4


def test_two_readings_of_a_scan_are_weighed_by_their_prior(world_map, world_drive):
    """The odds of places against "none" add up; "none" is one and the same."""
    scan = scan_of(world_drive, 0)
    places = some_places(scan, 10)
    upright, leaning = (
        PlaceScorer(world_map).score(places, range(len(places)), 0, scan, prior) for prior in (0.0, -4.0)
    )
    assert leaning.places[0].ratio == upright.places[0].ratio
    assert leaning.none == pytest.approx(upright.none * np.exp(4.0), rel=0.05)
    both = leaning.together_with(upright)
    odds = sum((1.0 - each.error) / each.none for each in (upright, leaning))
    rest = sum(each.error / each.none for each in (upright, leaning)) - 1.0
    assert both.error == pytest.approx(rest / (rest + odds))
    assert sum(place.probability for place in both.places) + both.none <= 1.0
    # a rival far away, by the other reading alone, keeps its weight however many of these places turn out to be one
    far = replace(upright, error=0.02, none=1e-6)
    both = leaning.together_with(far)
    others = sum(place.probability for place in both.places[1:])
    assert both.error - others == pytest.approx(0.02, rel=0.2)


def test_places_that_the_map_names_share_the_probability_by_their_odds():
    T = np.eye(4)
    first, other = Hypothesis(T, 1, probability=0.6), Hypothesis(T, 2, probability=0.3)
    before = Scored(0, [first, other], error=0.4, none=0.1, second=other)
    after = before.beside([Hypothesis(T, probability=0.5), Hypothesis(T, probability=2.0)])
    assert [place.probability for place in after.places] == pytest.approx([0.24, 0.12, 0.12, 0.48])
    assert (after.error, after.none) == pytest.approx((0.76, 0.04))
    assert after.second is after.places[-1]
    assert before.beside([]) is before
    around = replace(before, error=0.2)  # the second pose is of the same place, or of the other reading
    assert around.beside([Hypothesis(T, probability=1.0)]).error == pytest.approx(1.0 - 0.8 / 1.8)
