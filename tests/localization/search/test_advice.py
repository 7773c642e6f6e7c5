"""Advice to an ambiguous robot: the way to where the places that fit differ."""

from types import SimpleNamespace

import numpy as np
import pytest
from made_up_places import map_of, rows_of_boxes
from small_world import Box

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.acceptance import Considered, SearchResult
from coview_stream.localization.search.advice import AdvisedSearch, serious
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.request import FIRST_EPOCH
from coview_stream.localization.state import State


@pytest.fixture(scope="module")
def search():
    """On equal boxes, the same turned by half a turn about zero, but for a tower in the east."""
    tower = Box(np.array([24.0, 0.0]), np.array([5.0, 5.0, 9.0]), 0.0)
    base_map, config = map_of([*rows_of_boxes(), tower]), LocalizerConfig()
    return AdvisedSearch(base_map, config, LocalMaps(base_map, config.registration.source_range))


def found(search, monkeypatch, places, state=State.AMBIGUOUS, travelled=0.0, T=None):
    """Reason after a search that leaves some places (x, y, yaw, probability)."""
    rows = np.array([[x, y, 1.0, yaw, p, 9.0] for x, y, yaw, p in places])
    rows[:, :3] += search.base_map.origin
    result = SearchResult(
        None, KeyframeEvidence(0.0, state, "two places fit: equally"), travelled, FIRST_EPOCH,
        T_odom_body=np.eye(4) if T is None else T, considered=Considered(0.0, rows, 0.0),
    )  # fmt: skip
    monkeypatch.setattr(GlobalSearch, "update", lambda self, request: result)
    return search.update(SimpleNamespace()).evidence.reason


TWO = ((0.0, 0.0, np.pi / 2, 0.5), (0.0, 0.0, -np.pi / 2, 0.5))  # northwards and southwards


@pytest.mark.slow
def test_ambiguous_robot_is_sent_to_where_the_places_differ(search, monkeypatch):
    reason = found(search, monkeypatch, TWO)
    assert reason in {
        f"two places fit: equally; they differ most {m} m to the {side}" for m in (5, 15) for side in ("left", "right")
    }
    there = pose_from(rot_z(0.0), np.array([2.0, 0.0, 0.0]))  # it has driven on, and the goal stays in its place
    east = "right" in reason
    T = pose_from(rot_z(-np.pi / 2 if east else np.pi / 2), np.zeros(3)) @ there
    metres = int(reason.split(" m ")[0].split()[-1])
    assert found(search, monkeypatch, TWO, travelled=2.0, T=T).endswith(f"most {metres - 2} m ahead")


def test_no_advice_without_a_rival_or_with_a_place(search, monkeypatch):
    assert found(search, monkeypatch, TWO[:1]) == "two places fit: equally"
    assert found(search, monkeypatch, TWO, State.SEARCHING) == "two places fit: equally"


def test_places_that_count_lie_elsewhere_and_may_be_right():
    rows = np.array([[0, 0, 0, 0, 0.6, 9], [1, 0, 0, 0, 0.2, 8], [0, 9, 0, 0, 0.1, 8], [0, 30, 0, 0, 0.001, 1.0]])
    assert [T[1, 3] for T in serious(rows)] == [0.0, 9.0]
