"""Turns: nobody is passed over, the urgent come first every second time."""

from __future__ import annotations

from collections import Counter

from coview_stream.stream.node.scheduling import RoundRobin

ROBOTS = ("a", "b", "c", "d")


def served(turns, count, ready=lambda robot: True, urgent=lambda robot: False):
    found = [turns.next(ROBOTS, lambda r: r.upper() if ready(r) else None, urgent) for _ in range(count)]
    assert all(job == robot.upper() for robot, job in found)
    return "".join(robot for robot, _ in found)


def test_robots_are_served_in_order():
    assert served(RoundRobin(4), 8) == "abcdabcd"


def test_idle_robot_keeps_its_turn():
    turns = RoundRobin(4)
    assert served(turns, 2, ready=lambda r: r in "bd") == "bd"
    assert served(turns, 4) == "acbd"


def test_no_jobs_keep_the_order():
    turns = RoundRobin(4)
    assert turns.next(ROBOTS, lambda r: None) is None
    assert served(turns, 1) == "a"


def test_urgent_robots_get_half_of_the_turns():
    count = Counter(served(RoundRobin(4), 120, urgent=lambda r: r == "c"))
    assert count["c"] >= 60
    assert min(count.values()) >= 15


def test_urgent_robots_are_served_in_order():
    order = served(RoundRobin(4), 40, urgent=lambda r: r in "bd")
    assert abs(order.count("b") - order.count("d")) <= 1
    assert "a" in order[:6]
    assert "c" in order[:8]
