"""Circles that move with robots."""

from __future__ import annotations

import pytest

from coview_stream.basemap.site.part import Around
from coview_stream.basemap.site.route import Route

START = Around(100.0, 200.0, 90.0)


def centres(route):
    return {(each.x, each.y) for each in route.circles()}


def test_circle_stays_until_the_robot_has_gone_a_third_of_its_radius():
    route = Route(START)
    assert centres(route) == {(100.0, 200.0)}
    assert not route.move({"a": None})
    assert not route.move({"a": (129.0, 200.0)})
    assert centres(route) == {(100.0, 200.0)}
    assert route.move({"a": (131.0, 200.0)})
    assert centres(route) == {(131.0, 200.0)}
    assert not route.move({"a": (110.0, 200.0)})
    assert not route.move({"a": None})  # it may still be there
    assert centres(route) == {(131.0, 200.0)}
    assert all(each.radius == 90.0 for each in route.circles())


def test_each_robot_has_a_circle_and_robots_together_have_one():
    route = Route(START)
    assert route.move({"a": (500.0, 0.0), "b": (100.0, 210.0)})
    assert centres(route) == {(500.0, 0.0), (100.0, 200.0)}
    assert not route.move({"b": (100.0, 210.0)})  # the other one is served no more
    assert centres(route) == {(100.0, 200.0)}


def test_robot_that_was_seen_before_may_be_there_or_at_the_start():
    route = Route(START, {"a": (900.0, 900.0)})
    assert centres(route) == {(100.0, 200.0), (900.0, 900.0)}
    assert not route.move({"a": (905.0, 900.0)})
    assert centres(route) == {(900.0, 900.0)}
    assert route.last_places() == {"a": (900.0, 900.0)}


@pytest.mark.parametrize("robots", [{}, {"b": None}])
def test_places_of_robots_that_are_not_served_now_are_kept(robots):
    route = Route(START, {"a": (900.0, 900.0)})
    assert not route.move(robots)
    assert centres(route) == {(100.0, 200.0)}
    assert route.last_places() == {"a": (900.0, 900.0)}
