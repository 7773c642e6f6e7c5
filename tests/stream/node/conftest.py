"""A robot, and nodes without threads, declared on a network in memory."""

from contextlib import ExitStack

import pytest
from fake_node import declared
from fake_robot import Robot
from serving import Service


@pytest.fixture
def site():
    return declared("r1")


@pytest.fixture
def pair():
    return declared("r1", "r2")


@pytest.fixture
def robot():
    return Robot()


@pytest.fixture
def serve(world_file, slow_drive, tmp_path):
    """Start a node as a process of its own, and a robot that drives; arguments as of Service."""
    with ExitStack() as stack:

        def start(**more):
            service = Service(world_file, slow_drive, tmp_path, **more)
            stack.callback(service.end)
            return service

        yield start


@pytest.fixture
def service(serve):
    return serve()
