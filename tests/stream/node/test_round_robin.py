"""Turns: no robot is passed over, the urgent come first every second time."""

from __future__ import annotations

from collections import Counter

from coview_stream.stream.node.scheduling import RoundRobin

ROBOTS = ("a", "b", "c", "d")


def served(turns, count, ready=ROBOTS, urgent=None):
    """Robots in the order in which they are served, of those that are ``ready``."""
    names = ""
    for _ in range(count):
        order = turns.order(None if urgent is None else [robot in urgent for robot in ROBOTS])
        k = next(k for k in order if ROBOTS[k] in ready)
        turns.serve(k)
        names += ROBOTS[k]
    return names


def test_robots_are_served_in_order():
    assert served(RoundRobin(4), 8) == "abcdabcd"


def test_idle_robot_keeps_its_turn():
    turns = RoundRobin(4)
    assert served(turns, 2, ready="bd") == "bd"
    assert served(turns, 4) == "acbd"


def test_no_jobs_keep_the_order():
    turns = RoundRobin(4)
    assert turns.order() == turns.order() == [0, 1, 2, 3]
    assert served(turns, 1) == "a"


def test_urgent_robots_get_half_of_the_turns():
    count = Counter(served(RoundRobin(4), 120, urgent="c"))
    assert count["c"] >= 60
    assert min(count.values()) >= 15


def test_urgent_robots_are_served_in_order():
    order = served(RoundRobin(4), 40, urgent="bd")
    assert abs(order.count("b") - order.count("d")) <= 1
    assert "a" in order[:6]
    assert "c" in order[:8]
