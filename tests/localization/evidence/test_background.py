"""Background: the share that chance explains, and how many independent observations a scan is, from chance places."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_scans import CHANCE, NUMBER, PASSED, chance_places, observation, places_of_their_own, what_was_seen_before
from trackers import observed

from coview_kernels import Move
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.background import (
    NEARBY,
    NEARBY_VARIANCE,
    Most,
    estimate_background,
    left_in_mean,
    observe_around,
    observe_with_background,
    scatter,
)
from coview_stream.localization.evidence.background import chance_places as places_around
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios, ratio_variances
from coview_stream.localization.evidence.observation import Share

NOTHING = np.empty((0, len(Share)), dtype=np.float32)


def background_of(places):
    """Of places (P, W, 7) that were followed over W keyframes."""
    spread = np.mean([scatter(places[:, k]) for k in range(places.shape[1])], axis=0)
    return estimate_background(places[:, -1], spread, places[:, -1])


@pytest.fixture
def rng():
    return np.random.default_rng(20)


@pytest.mark.parametrize("number", [12, NUMBER, 60])
def test_known_background_and_number_are_recovered(rng, number):
    estimate = background_of(chance_places(rng, 250, number=number))
    np.testing.assert_allclose(estimate.structure, CHANCE, atol=0.04)
    assert estimate.structure.sum() == pytest.approx(1.0)
    assert estimate.passed == pytest.approx(PASSED, abs=0.02)
    assert all(0.5 * number < each < 2.0 * number for each in estimate.number)


@pytest.mark.parametrize(
    ("most", "expected"), [(Most(7.0, 0.0), (7.0, 0.0)), (Most(1e3, 1e3), None), (Most(7.0, 2.0, 1.5), (10.5, 3.0))]
)
def test_a_scan_is_no_more_observations_than_the_patches_that_it_shows(rng, most, expected):
    chance = chance_places(rng, 250, number=60)[:, 0]
    usual = estimate_background(chance, scatter(chance), chance).number
    estimate = estimate_background(chance, scatter(chance), chance, most).number
    assert estimate == (expected or usual)


def test_scans_of_other_surroundings_are_more_observations(rng):
    """Where chance places are all alike: a hundred observations a scan, and more where more has been seen."""
    chance = np.tile(chance_places(rng, 1)[:, 0], (250, 1))
    one, three = (estimate_background(chance, scatter(chance), chance, Most(scans=n)).number[0] for n in (1.0, 3.0))
    assert one == 100.0
    assert 100.0 < three <= 300.0


@pytest.mark.parametrize("copies", [1, 4, 8])
def test_few_copies_of_the_right_place_do_not_inflate_the_background(rng, copies):
    chance = chance_places(rng, 200)
    twins = observation(np.tile([0.8, 0.15, 0.03, 0.02], (copies, 1)), passed=0.01, ground=0.95)[:, None]
    usual, estimate = background_of(chance), background_of(np.concatenate([chance, twins]))
    np.testing.assert_allclose(estimate.structure, usual.structure, atol=0.04)
    assert all(there < 1.3 * here for there, here in zip(estimate.number, usual.number, strict=True))


def test_a_site_that_repeats_itself_makes_its_pattern_worth_nothing(rng):
    """Half of all places are alike: then they are the background."""
    chance = chance_places(rng, 100)
    alike = observation(rng.multinomial(NUMBER, [0.7, 0.15, 0.05, 0.1], 100) / NUMBER, passed=0.02)[:, None]
    estimate = background_of(np.concatenate([chance, alike]))
    assert estimate.structure[0] > 0.35
    assert estimate.number[0] < background_of(chance).number[0]


def test_same_scan_again_and_again_is_no_new_evidence(rng):
    fresh = chance_places(rng, 120, keyframes=8)
    same = np.repeat(fresh[:, :1], 8, axis=1)
    one, many, repeated = (background_of(each).number[0] for each in (fresh[:, :1], fresh, same))
    assert many > 0.7 * one
    assert 0.7 * one < repeated < 1.3 * one


def test_without_places_something_modest_is_presumed():
    estimate = estimate_background(NOTHING, np.full(4, np.nan), NOTHING)
    assert estimate.structure.sum() == pytest.approx(1.0)
    assert (estimate.structure > 0).all()
    assert 0 < estimate.passed < 1
    assert all(1 < each < 50 for each in estimate.number)
    assert all(np.isfinite(estimate.ground))


def test_few_places_count_little_against_what_is_presumed(rng):
    presumed = estimate_background(NOTHING, np.full(4, np.nan), NOTHING)
    one = observation([[1.0, 0.0, 0.0, 0.0]])
    estimate = estimate_background(one, scatter(one), one)
    assert presumed.structure[0] < estimate.structure[0] < 0.5
    assert np.isfinite(estimate.number).all()


def test_uncovered_places_say_nothing(rng):
    """Beyond the map nothing is explained or unexplained: such places do not dilute the background."""
    chance = chance_places(rng, 150)
    beyond = observation(np.tile(CHANCE, (100, 1)), covered=np.zeros(100), covered_ground=np.zeros(100))[:, None]
    estimate = background_of(np.concatenate([chance, beyond]))
    np.testing.assert_allclose(estimate.structure, CHANCE, atol=0.05)


@pytest.mark.parametrize("level", [0.05, 0.5, 0.9])
def test_ground_parameters_follow_the_chance_places(rng, level):
    places = observation(np.tile(CHANCE, (200, 1)), ground=np.clip(rng.normal(level, 0.05, 200), 0, 1))
    a, b = estimate_background(places, scatter(places), places).ground
    assert a / (a + b) == pytest.approx(level, abs=0.06)


def test_keyframes_that_see_something_else_each_leave_less_of_the_scatter(rng):
    left = left_in_mean(chance_places(rng, 500, keyframes=4))
    assert ((left > 0.2) & (left < 0.5)).all()  # a quarter, but for how uncertain it is


def test_keyframes_that_see_the_same_leave_all_of_the_scatter(rng):
    same = np.repeat(chance_places(rng, 200), 5, axis=1)
    np.testing.assert_allclose(left_in_mean(same), 1.0, atol=1e-6)


@pytest.mark.parametrize("draw", [places_of_their_own, what_was_seen_before])
def test_places_that_go_on_to_fit_leave_most_of_the_scatter(rng, draw):
    left = left_in_mean(draw(rng, 300, keyframes=4))
    assert (left > 0.5).all()
    assert (left <= 1.0).all()


@pytest.mark.parametrize(("count", "keyframes"), [(300, 1), (5, 4), (0, 3)])
def test_one_keyframe_or_few_places_tell_nothing_of_it(rng, count, keyframes):
    np.testing.assert_array_equal(left_in_mean(chance_places(rng, count, keyframes=keyframes)), 1.0)


T_MAP_ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])


@pytest.fixture(scope="module")
def seen(world_drive):
    return observed(world_drive.clouds[4], inverse(T_MAP_ODOM) @ world_drive.T_map_body[4])


def test_chance_places_lie_around_at_all_sides():
    around = places_around(np.array([5.0, -3.0, 1.0, 0.2]))
    gap = around[:, :2] - [5.0, -3.0]
    assert len(around) == 32
    assert np.linalg.norm(gap, axis=1).min() == pytest.approx(3.0)
    np.testing.assert_allclose(gap.mean(axis=0), 0.0, atol=1e-9)
    assert (around[:, 2] == 1.0).all()
    assert np.abs(around[:, 3] - 0.2).min() > 0.0


@pytest.mark.slow
def test_background_is_what_the_places_around_the_first_pose_explain(world_map, seen):
    away = T_MAP_ODOM.copy()
    away[:2, 3] += [0.9, -0.7]
    both = np.stack([T_MAP_ODOM, away])
    observed, background = observe_with_background(world_map.field, seen, both)
    chance = seen.few.look_up(world_map.field, places_around(seen.poses(both)[0]), Move.NONE).shares
    expected = estimate_background(chance, scatter(chance), chance, Most(*seen.patches))
    np.testing.assert_allclose(background.structure, expected.structure)
    assert background.passed == pytest.approx(expected.passed)
    assert background.ground == pytest.approx(expected.ground)
    assert background.number == pytest.approx(expected.number)
    np.testing.assert_array_equal(observed, seen.few.look_up(world_map.field, seen.poses(both), Move.NONE).shares)
    assert observed[0, Share.NEAR] > observed[1, Share.NEAR] > chance[:, Share.NEAR].mean()
    other, _ = observe_with_background(world_map.field, seen, both[::-1])
    np.testing.assert_array_equal(other, observed[::-1])


def rich_and_bare(rng, number=40, error=0.0):
    """Chance places (300, 15), every other one among trees: 0.6 of a scan lies below edges there, else 0.05."""
    edges = np.where(np.arange(300) % 2, 0.6, 0.05)
    chance = np.column_stack([np.full((300, 2), 0.03), edges, 0.94 - edges])
    seen = np.array([rng.multinomial(number, share) for share in chance]) / number
    rows = np.zeros((300, NEARBY_VARIANCE.stop))
    rows[:, [Share.ON, Share.NEAR, Share.EDGE]] = np.column_stack([seen[:, 0], seen[:, :2].sum(axis=1), seen[:, 2]])
    rows[:, [Share.COVERED, Share.PASSED]] = 1.0, PASSED
    rows[:, NEARBY], rows[:, NEARBY_VARIANCE] = chance, error**2
    return rows.astype(np.float32)


def test_chance_at_a_place_is_told_by_the_map_around_it(rng):
    places = rich_and_bare(rng)
    known, unknown = (estimate_background(rows, scatter(rows), rows) for rows in (places, places[:, : len(Share)]))
    at = known.structure_at(places)
    np.testing.assert_allclose(at[:2, 2], (0.05, 0.6), atol=0.06)
    np.testing.assert_allclose(at.sum(axis=1), 1.0)
    assert known.number[0] > 4.0 * unknown.number[0]  # places among trees are no scatter of chance
    right = places[:1].copy()
    right[0, [Share.ON, Share.NEAR, Share.EDGE]] = 0.2, 0.4, 0.4
    gain, before = (log_likelihood_ratios(right[:, :n], kind)[0] for n, kind in ((15, known), (7, unknown)))
    assert gain > before + 5.0
    assert log_likelihood_ratios(places, known).max() < np.log(len(places))


def test_evidence_is_as_uncertain_as_chance_at_its_place(rng):
    """Also where no pose around it explains anything, or lies in the survey."""
    vague = rich_and_bare(np.random.default_rng(3), error=0.05)
    right = np.repeat(vague[:1], 3, axis=0)
    right[:, [Share.ON, Share.NEAR, Share.EDGE]] = 0.5, 0.7, 0.3
    right[1, NEARBY] = 0.0, 0.0, 0.0, 1.0
    right[2, NEARBY] = 0.0
    known = estimate_background(vague, scatter(vague), vague)
    told, bare, outside = ratio_variances(right, known)
    assert told > 1.0
    assert told > 5.0 * np.median(ratio_variances(vague, known))
    assert bare > 1.0
    assert outside > 1.0
    assert ratio_variances(right, replace(known, within=np.zeros(4), between=np.zeros(4))).max() == 0.0


def test_around_a_place_are_the_shares_of_the_poses_around_it(world_map, world_drive):
    scan = observed(world_drive.clouds[2], world_drive.T_odom_body[2])
    pose = scan.poses(np.eye(4)[None])
    shares = scan.few.look_up(world_map.field, places_around(pose[0])[:16], Move.NONE).shares
    each = np.column_stack(
        [shares[:, 0], shares[:, 1] - shares[:, 0], shares[:, 2], shares[:, 3] - shares[:, 1] - shares[:, 2]]
    )
    around = observe_around(world_map.field, scan.few, pose)[0]
    np.testing.assert_allclose(around[:4], each.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(around[4:], each.var(axis=0, ddof=1), atol=1e-6)
