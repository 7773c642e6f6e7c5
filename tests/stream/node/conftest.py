"""A robot, and nodes without threads, declared on a network in memory."""

from __future__ import annotations

import pytest
from fake_node import Site
from fake_robot import Robot


@pytest.fixture
def site():
    made = Site("r1")
    made.node.declare()
    return made


@pytest.fixture
def pair():
    made = Site("r1", "r2")
    made.node.declare()
    return made


@pytest.fixture
def robot():
    return Robot()
