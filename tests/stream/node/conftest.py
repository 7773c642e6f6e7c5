"""A robot, and nodes without threads, declared on a network in memory."""

import pytest
from fake_node import declared
from fake_robot import Robot


@pytest.fixture
def site():
    return declared("r1")


@pytest.fixture
def pair():
    return declared("r1", "r2")


@pytest.fixture
def robot():
    return Robot()
