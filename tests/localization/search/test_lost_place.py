"""A lost place: odometry's path from it confirms a search's first place, or contradicts it."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_places import candidate, place
from test_global_search import T_MAP_ODOM, off, run_of, searching

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from
from coview_stream.localization.search.lost_place import weighed_by_odometry
from coview_stream.localization.search.places import Rivals, Scored
from coview_stream.localization.search.request import LostPlace
from coview_stream.localization.state import State


def lost(request, metres, odds, sigma=0.1):
    """The request after a loss; odometry leads so many metres beside the truth."""
    beside = pose_from(np.eye(3), [metres, 0.0, 0.0]) @ T_MAP_ODOM @ request.T_odom_body
    covariance = np.diag([0.01, 0.01, 0.02, sigma, sigma, 0.1]) ** 2
    return replace(request, lost=LostPlace(beside @ inverse(request.T_odom_body), covariance, odds))


@pytest.fixture
def request_(world_drive):
    return next(run_of(world_drive, 1))


def error(world_map, request, alone=0.1):
    """Probability that the robot is not at the truth, where the scans alone say ``alone``."""
    first, second = place(1.0 - alone, T_MAP_ODOM), place(0.5 * alone, pose_from(np.eye(3), [50.0, 0.0, 0.0]))
    scored = Scored(Rivals(), [first, second], alone, 0.5 * alone, 1e-3, second)
    out = weighed_by_odometry(scored, candidate(first), request, [], world_map, LocalizerConfig(), np.zeros)
    assert out.none + sum(each.probability for each in out.places) == pytest.approx(1.0)
    assert out.second is out.places[1]
    return out.error


def test_path_that_leads_to_the_first_place_confirms_it(world_map, request_):
    assert error(world_map, request_) == 0.1
    assert error(world_map, lost(request_, 0.05, 1e-3)) == pytest.approx(1.1e-4, rel=0.3)
    assert error(world_map, lost(request_, 0.4, 1e-3, sigma=0.3)) < 1e-3
    assert error(world_map, lost(request_, 0.05, 1e3)) == pytest.approx(0.1, rel=0.01)  # odometry went wrong
    assert error(world_map, lost(request_, 0.45, 1.0, sigma=0.01)) == pytest.approx(0.1, rel=0.01)  # far off its drift


def test_path_that_leads_beside_it_contradicts_it_unless_odometry_went_wrong(world_map, request_):
    for metres, odds, state in (
        (1.5, 1e-3, State.AMBIGUOUS), (1.5, 1e4, State.TRACKING),
        (25.0, 1e-2, State.TRACKING),  # no part moves so far
    ):  # fmt: skip
        result = searching(world_map).update(lost(request_, metres, odds))
        assert result.evidence.state is state, (metres, odds, result.evidence)
        assert result.accepted is None or off(result.accepted.T_map_odom) < 0.1


def test_path_that_drifts_as_far_does_not_contradict_it(world_map, request_):
    result = searching(world_map).update(lost(request_, 1.5, 1e-3, sigma=1.0))
    assert result.evidence.state is State.TRACKING
