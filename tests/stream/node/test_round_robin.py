"""Turns: no robot is passed over."""

from __future__ import annotations

from coview_stream.stream.node.engine_queue import RoundRobin

ROBOTS = ("a", "b", "c", "d")


def served(turns, count, ready=ROBOTS):
    """Robots in the order in which they are served, of those that are ``ready``."""
    names = ""
    for _ in range(count):
        k = next(k for k in turns.order() if ROBOTS[k] in ready)
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
