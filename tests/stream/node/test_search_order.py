"""Order of searches: no robot waits without end, and one that may be found soon comes first. Time is played."""

from __future__ import annotations

import pytest

from coview_stream.stream.node.engine_queue import SearchDemand, search_order

NOW = 1000.0
KEYFRAMES = 1.33  # seconds between those of a robot: 2 m at 1.5 m/s


def first(*demands):
    """Robot that is searched for first."""
    return search_order(demands, NOW)[0]


def waiting(seconds, searches=0, support=0):
    return SearchDemand(NOW - seconds, searches, support)


def test_robots_without_a_keyframe_are_left_out():
    assert search_order([None, waiting(0.1), None], NOW) == [1]
    assert search_order([None], NOW) == []


def test_among_equals_who_has_waited_longest_is_first():
    assert search_order([waiting(0.1), waiting(0.3), waiting(0.2)], NOW) == [1, 2, 0]


def test_proposed_place_comes_first_then_the_newly_lost():
    assert search_order([waiting(1.0, 100), waiting(0.5, 2), waiting(0.1, 50, 3)], NOW) == [2, 1, 0]


def test_whose_place_was_proposed_most_often_in_a_row_comes_first():
    assert first(waiting(0.5, 3, 1), waiting(0.1, 4, 2)) == 1


def test_place_that_is_proposed_without_end_gives_no_precedence():
    assert first(waiting(0.1, 40, 40), waiting(0.05, 4, 1)) == 1
    assert first(waiting(0.1, 40, 40), waiting(0.2, 40)) == 1


def test_keyframe_that_has_waited_too_long_comes_before_all():
    assert first(waiting(1.6, 500), waiting(1.4, 4, 3)) == 0
    assert first(waiting(1.6, 4, 3), waiting(1.7, 500)) == 1


class Robots:
    """Lost robots before one search engine; those that are on the map are found after five searches.

    Attributes:
        found: seconds from its first keyframe after which a robot was found.
        waits: the longest wait of each for a search, its answer included.
    """

    def __init__(self, on_map, off_map, cost, off_map_support=0, on_map_from=0.0, seconds=60.0):
        robots = range(on_map + off_map)
        begin = [on_map_from * (k < on_map) + 0.013 * k for k in robots]
        due = list(begin)
        since, searches = [None] * len(begin), [0] * len(begin)
        self.found, self.waits = {}, [0.0] * len(begin)
        now = 0.0
        while now < seconds:
            for k in robots:
                while due[k] <= now:
                    since[k] = due[k] if since[k] is None and k not in self.found else since[k]
                    due[k] += KEYFRAMES
            support = [max(0, n - 1) if k < on_map else off_map_support * n for k, n in enumerate(searches)]
            demands = [None if since[k] is None else SearchDemand(since[k], searches[k], support[k]) for k in robots]
            order = search_order(demands, now)
            if not order:
                now = min(due)
                continue
            now += cost
            k = order[0]
            self.waits[k] = max(self.waits[k], now - since[k])
            since[k], searches[k] = None, searches[k] + 1
            if k < on_map and searches[k] == 5:
                self.found[k] = now - begin[k]
                since[k] = None
        for k in robots:
            if since[k] is not None:
                self.waits[k] = max(self.waits[k], now - since[k])


@pytest.mark.parametrize("on_map_from", [0.0, 40.0, 40.7])
@pytest.mark.parametrize("off_map_support", [0, 1])
def test_eight_of_sixteen_are_found_and_nobody_starves(on_map_from, off_map_support):
    """At a tenth of a second a search: sixteen robots take more than the engine has."""
    (alone,) = Robots(1, 0, 0.1).found.values()
    robots = Robots(8, 8, 0.1, off_map_support, on_map_from)
    assert len(robots.found) == 8
    assert max(robots.found.values()) < alone + 5.0
    assert max(robots.waits) < 3.0


def test_engine_that_cannot_keep_up_lets_all_wait_equally_long():
    robots = Robots(0, 16, 0.4)
    assert max(robots.waits) < 17 * 0.4
    assert min(robots.waits) > 14 * 0.4


def test_engine_that_can_keep_up_searches_for_every_keyframe():
    assert max(Robots(8, 8, 0.05).waits) < 16 * 0.05 + 0.05
