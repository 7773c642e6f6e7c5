"""A lost place: odometry's path from it confirms a search's first place, or contradicts it."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_places import candidate, place
from test_global_search import T_MAP_ODOM, off, run_of, searching
from trackers import observed

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.search.lost_place import log_priors, weighed_by_odometry
from coview_stream.localization.search.places import Scored
from coview_stream.localization.search.request import EarlierKeyframe, LostPlace
from coview_stream.localization.state import State


def lost(request, metres, odds, sigma=0.1):
    """The request after a loss; odometry leads so many metres beside the truth."""
    beside = pose_from(np.eye(3), [metres, 0.0, 0.0]) @ T_MAP_ODOM @ request.T_odom_body
    covariance = np.diag([0.01, 0.01, 0.02, sigma, sigma, 0.1]) ** 2
    return replace(request, lost=LostPlace(beside @ inverse(request.T_odom_body), covariance, odds))


@pytest.fixture
def request_(world_drive):
    return next(run_of(world_drive, 1))


class Silent:
    """A scorer by which all poses explain the keyframes equally, and all paths lead through the truth."""

    def __init__(self, request):
        self.request = request

    def beside(self, poses):
        return np.zeros(len(poses))

    def look_back(self, poses):
        return self.request.T_odom_body, np.tile(
            [*(T_MAP_ODOM @ self.request.T_odom_body)[:3, 3], 0.0], (len(poses), 1)
        )


def weighed(world_map, request, others=(), alone=0.1, begin=None):
    """The places of a search whose first is the truth, wrong with probability ``alone`` by the scans, and others."""
    second = place(0.5 * alone, pose_from(np.eye(3), [50.0, 0.0, 0.0]) @ T_MAP_ODOM)
    places = [place(1.0 - alone - sum(each.probability for each in others), T_MAP_ODOM), *others, second]
    error = alone + sum(each.probability for each in others)
    scored = Scored(0, places, error, 0.5 * alone, 1e-3, places[1])
    scans = [observed(request.cloud, request.T_odom_body)]
    context = request, scans, world_map, LocalizerConfig(), Silent(request), begin
    out = weighed_by_odometry(scored, candidate(places[0]), *context)
    assert out.none + sum(each.probability for each in out.places) == pytest.approx(1.0)
    return out


def test_path_that_leads_to_the_first_place_confirms_it(world_map, request_):
    assert weighed(world_map, request_).error == 0.1
    assert weighed(world_map, lost(request_, 0.05, 1e-3)).error == pytest.approx(1.1e-4, rel=0.3)
    assert weighed(world_map, lost(request_, 0.4, 1e-3, sigma=0.3)).error < 1e-3
    assert weighed(world_map, lost(request_, 0.05, 1e3)).error == pytest.approx(0.1, rel=0.01)  # odometry went wrong
    assert weighed(world_map, lost(request_, 0.45, 1.0, sigma=0.01)).error == pytest.approx(0.1, rel=0.01)  # far off


@pytest.mark.parametrize(("turn", "up"), [(180.0, 0.0), (90.0, 0.0), (0.0, 6.0)])
def test_path_confirms_no_other_heading_or_storey_but_the_place_at_its_end(world_map, request_, turn, up):
    body = T_MAP_ODOM @ request_.T_odom_body
    end = pose_from(body[:3, :3] @ rot_z(np.radians(turn)), body[:3, 3] + [0.0, 0.0, up])
    at_end = place(0.4, end @ inverse(request_.T_odom_body))
    request = lost(request_, 0.0, 1e-3)
    request = replace(request, lost=LostPlace(at_end.T_map_odom, request.lost.covariance, 1e-3))
    out = weighed(world_map, request, [at_end])
    assert out.error > 0.99
    assert out.second.T_map_odom is at_end.T_map_odom


def test_path_that_leads_beside_it_contradicts_it_unless_odometry_went_wrong(world_map, request_):
    for metres, odds, state in (
        (1.5, 1e-3, State.AMBIGUOUS), (1.5, 1e4, State.TRACKING), (1.2, 1e4, State.TRACKING),
        (25.0, 1e-2, State.TRACKING),  # no part moves so far
    ):  # fmt: skip
        result = searching(world_map).update(lost(request_, metres, odds))
        assert result.evidence.state is state, (metres, odds, result.evidence)
        assert result.accepted is None or off(result.accepted.T_map_odom) < 0.1


def test_path_that_drifts_as_far_does_not_contradict_it(world_map, request_):
    result = searching(world_map).update(lost(request_, 1.5, 1e-3, sigma=1.0))
    assert result.evidence.state is State.TRACKING


def test_modes_of_a_place_have_the_prior_of_the_path(request_):
    modes = np.stack([T_MAP_ODOM, pose_from(np.eye(3), [1.0, 0.0, 0.0]) @ T_MAP_ODOM])
    leader, scorer = candidate(place(0.9, T_MAP_ODOM)), Silent(request_)
    assert log_priors(modes, leader, request_, LocalizerConfig(), scorer).tolist() == [0.0, 0.0]
    for metres, sigma, ahead in ((0.0, 0.1, 0), (1.0, 0.1, 1), (0.5, 0.1, None), (0.0, 5.0, None)):
        by_path = log_priors(modes, leader, lost(request_, metres, 1e-3, sigma), LocalizerConfig(), scorer)
        if ahead is None:
            assert abs(by_path[0] - by_path[1]) < 0.1
        else:
            assert by_path[ahead] - by_path[1 - ahead] > 5.0  # more than a moved building may seem to fit better
        request = lost(request_, metres, 1e-3, sigma)
        grown = LostPlace(pose_from(np.eye(3), [9.0, 0.0, 0.0]) @ T_MAP_ODOM, 0.1 * request.lost.covariance, 1e-3)
        assert np.isfinite(log_priors(modes, leader, request, LocalizerConfig(), scorer, grown)).all()


def test_mode_nearer_to_the_path_has_more_prior(request_):
    """Also where drift hardly explains the farther one: no mode is compared by another rule than the next."""
    shifts = np.arange(0.0, 2.1, 0.1)
    modes = np.stack([pose_from(np.eye(3), [-metres, 0.0, 0.0]) @ T_MAP_ODOM for metres in shifts])
    leader = candidate(place(0.9, T_MAP_ODOM))
    for sigma, slipped in ((0.1, 1e-3), (0.3, 1e-3), (0.3, 1e-5)):  # not grown since the first keyframe
        request, begin = lost(request_, 0.0, 1e-3, sigma), lost(request_, 0.0, slipped, sigma).lost
        by_path = log_priors(modes, leader, request, LocalizerConfig(), Silent(request_), begin)
        assert (np.diff(by_path) <= 0.0).all()


def test_drift_has_to_explain_the_distance_at_the_first_keyframe(world_map, world_drive, request_):
    """Where odometry led away from the search's places at once, it did not drift there on the way since."""
    request = lost(request_, 1.5, 1e-3, sigma=1.0)
    at_once, later = (
        weighed(world_map, request, begin=lost(request_, metres, 1e-3).lost).error for metres in (1.5, 0.05)
    )
    assert at_once > 0.9
    assert later < 0.01
    slipped = lost(request_, 1.5, 1e6, sigma=1.0)  # since then, by the clouds
    assert weighed(world_map, slipped, begin=lost(request_, 0.05, 1e-3).lost).error < 0.2
    search, requests = searching(world_map), run_of(world_drive, 4)
    results = [search.update(lost(each, 1.5, 1e-3, 0.1 if k < 2 else 1.0)) for k, each in enumerate(requests)]
    assert {result.evidence.state for result in results} == {State.AMBIGUOUS}
    *before, newest = run_of(world_drive, 5)  # clouds are levelled anew
    earlier = tuple(EarlierKeyframe(each.T_odom_body, each.submap, each.cloud) for each in before[1:])
    request = replace(lost(newest, 1.5, 1e-3, 1.0), earlier=earlier, epoch=newest.epoch._replace(restart=1))
    assert search.update(request).evidence.state is State.AMBIGUOUS
