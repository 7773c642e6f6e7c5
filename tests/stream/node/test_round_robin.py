"""Turns: nobody is passed over, the urgent come first every second time."""

from __future__ import annotations

from collections import Counter

from coview_stream.stream.node.scheduling import RoundRobin

ROBOTS = ("a", "b", "c", "d")


def served(turns, count, ready=lambda robot: True, urgent=lambda robot: False):
    found = [turns.next(ROBOTS, lambda r: r.upper() if ready(r) else None, urgent) for _ in range(count)]
    assert all(job == robot.upper() for robot, job in found)
    return "".join(robot for robot, _ in found)


def test_in_turn():
    assert served(RoundRobin(4), 8) == "abcdabcd"


def test_who_has_nothing_to_do_keeps_his_turn():
    turns = RoundRobin(4)
    assert served(turns, 2, ready=lambda r: r in "bd") == "bd"
    assert served(turns, 4) == "acbd"


def test_nobody_has_anything_to_do():
    turns = RoundRobin(4)
    assert turns.next(ROBOTS, lambda r: None) is None
    assert served(turns, 1) == "a"


def test_the_urgent_get_half_of_the_turns_and_the_others_the_rest():
    count = Counter(served(RoundRobin(4), 120, urgent=lambda r: r == "c"))
    assert count["c"] >= 60
    assert min(count.values()) >= 15


def test_among_the_urgent_in_turn():
    order = served(RoundRobin(4), 40, urgent=lambda r: r in "bd")
    assert abs(order.count("b") - order.count("d")) <= 1
    assert "a" in order[:6]
    assert "c" in order[:8]
