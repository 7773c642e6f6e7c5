"""Circles that move with robots."""

from __future__ import annotations

import pytest

from coview_stream.basemap.site.manifest import Around
from coview_stream.basemap.site.route import Route, Whereabouts

START = Around(100.0, 200.0, 90.0)


def at(place, known=True):
    return Whereabouts(place, known)


def centres(route):
    return {(each.x, each.y) for each in route.circles()}


def test_circle_stays_until_the_robot_has_gone_a_third_of_its_radius():
    route = Route(START)
    assert centres(route) == {(100.0, 200.0)}
    assert not route.move({"a": None})
    assert not route.move({"a": at((129.0, 200.0))})
    assert centres(route) == {(100.0, 200.0)}
    assert route.move({"a": at((131.0, 200.0))})
    assert centres(route) == {(131.0, 200.0)}
    assert not route.move({"a": at((110.0, 200.0))})
    assert not route.move({"a": None})  # it may still be there
    assert centres(route) == {(131.0, 200.0)}
    assert all(each.radius == 90.0 for each in route.circles())


def test_each_robot_has_a_circle_and_robots_together_have_one():
    route = Route(START)
    assert route.move({"a": at((500.0, 0.0)), "b": at((100.0, 210.0))})
    assert centres(route) == {(500.0, 0.0), (100.0, 200.0)}
    assert not route.move({"b": at((100.0, 210.0))})  # the other one is served no more
    assert centres(route) == {(100.0, 200.0)}


def test_robot_that_was_seen_before_may_be_there_or_at_the_start():
    route = Route(START, {"a": (900.0, 900.0)})
    assert centres(route) == {(100.0, 200.0), (900.0, 900.0)}
    assert not route.move({"a": at((905.0, 900.0))})
    assert centres(route) == {(900.0, 900.0)}
    assert route.last_places() == {"a": (900.0, 900.0)}


@pytest.mark.parametrize("robots", [{}, {"b": None}])
def test_places_of_robots_that_are_not_served_now_are_kept(robots):
    route = Route(START, {"a": (900.0, 900.0)})
    assert not route.move(robots)
    assert centres(route) == {(100.0, 200.0)}
    assert route.last_places() == {"a": (900.0, 900.0)}


def test_place_that_is_only_possible_adds_a_circle_and_takes_none():
    route = Route(START, {"a": (900.0, 900.0)})
    assert route.move({"a": at((500.0, 500.0), known=False)})
    assert centres(route) == {(100.0, 200.0), (900.0, 900.0), (500.0, 500.0)}
    assert not route.move({"a": at((505.0, 500.0), known=False)})
    assert route.move({"a": at((700.0, 500.0), known=False)})  # it is thought to be elsewhere now
    assert centres(route) == {(100.0, 200.0), (900.0, 900.0), (700.0, 500.0)}
    assert route.last_places() == {"a": (900.0, 900.0)}
    assert not route.move({"a": at((705.0, 500.0))})  # there it is
    assert centres(route) == {(700.0, 500.0)}
    assert route.move({"a": at((100.0, 100.0), known=False)})  # lost, and perhaps there
    assert centres(route) == {(700.0, 500.0), (100.0, 100.0)}
    assert route.last_places() == {"a": (700.0, 500.0)}
