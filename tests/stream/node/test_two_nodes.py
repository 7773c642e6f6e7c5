"""Two nodes for one robot, with real processes: one serves it, and the other takes over with a pose."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import pytest
from bad_link import BadLink
from nightly import nightly
from serving import FALSE, Service
from sockets import until
from zenoh_routers import Router

from coview_stream.clouds.python_child import python_command, python_environment

NIGHTLY = bool(os.environ.get("COVIEW_NIGHTLY"))  # minutes more, see .ci/run

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")]


def test_second_node_stands_by_takes_over_and_keeps_the_robot(world_file, slow_drive, tmp_path):
    with Router() as router:
        service = Service(world_file, slow_drive, tmp_path, router=router.endpoint, robots_router=router.endpoint)
        said: list[tuple[float, str]] = []  # by which node each status is

        def read():
            for status in service.client.statuses(timeout=None):
                said.append((time.monotonic(), status["node"]["id"]))

        threading.Thread(target=read, daemon=True).start()
        second = None
        try:
            service.tracks(60.0)
            until(lambda: said, 10.0)
            first = said[-1][1]
            command = ("serve", str(service.map), "--robot", "r1", "--connect", router.endpoint, "--no-state")
            second = subprocess.Popen(
                python_command("coview_stream", *command), env=python_environment(), stderr=subprocess.PIPE, text=True
            )
            lines: list[str] = []
            threading.Thread(target=lines.extend, args=(second.stderr,), daemon=True).start()
            until(lambda: any(f"node {first}" in line and "standing by" in line for line in list(lines)), 60.0)
            time.sleep(8.0)  # until it knows the place
            assert {node for _, node in said} == {first}

            begin = time.monotonic()
            service.process.send_signal(signal.SIGSTOP)
            until(lambda: said[-1][1] != first, 20.0)
            service.tracks(20.0)
            assert time.monotonic() - begin < 40.0  # four statuses, of a busy machine

            service.process.send_signal(signal.SIGCONT)
            time.sleep(3.0)  # what it had still to say
            since = time.monotonic()
            time.sleep(6.0)
            assert {node for at, node in said if at > since} == {said[-1][1]} != {first}
            assert service.robot()["serves"] is False
            assert service.robot()["served_by"] == said[-1][1]

            second.terminate()  # it says that it ends
            begin = time.monotonic()
            until(lambda: said[-1][1] == first, 10.0)
            service.tracks(20.0)
            assert max(service.errors()) < FALSE
        finally:
            service.process.send_signal(signal.SIGCONT)
            if second is not None:
                second.kill()
                second.wait()
            assert service.end() == 0


class Other:
    """Another process that serves the robot of a service."""

    def __init__(self, service, router, *arguments):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.metrics = f"127.0.0.1:{probe.getsockname()[1]}"
        command = ("serve", str(service.map), "--robot", "r1", "--connect", router, "--no-state")
        self.process = subprocess.Popen(
            python_command("coview_stream", *command, "--metrics", self.metrics, *arguments),
            env=python_environment(),
            stderr=subprocess.DEVNULL,
        )

    def robot(self):
        """What it says of the robot; None while it cannot be asked."""
        try:
            with urllib.request.urlopen(f"http://{self.metrics}/health", timeout=10) as answer:
                return json.load(answer)["robots"].get("r1")
        except urllib.error.HTTPError as error:  # not ready
            return json.load(error)["robots"].get("r1")
        except OSError:
            return None

    def answers(self):
        """Whether it can be asked and is ready."""
        try:
            with urllib.request.urlopen(f"http://{self.metrics}/health", timeout=10) as answer:
                return bool(json.load(answer)["ready"]["ok"])
        except OSError:  # not ready among them
            return False

    def wait(self, state="TRACKING"):
        until(lambda: (told := self.robot()) is not None and told["state"] == state, 60.0)

    def end(self):
        self.process.kill()
        self.process.wait()


def serving(service, *nodes, settle=3.0, seconds=3.0):
    """After some time to settle: which of the nodes publishes poses, by its number; it has to be one."""
    time.sleep(settle)
    begin, rates = [node.robot()["counters"]["poses"] for node in nodes], len(service.poses)
    time.sleep(seconds)
    told = [node.robot() for node in nodes]
    made = [after["counters"]["poses"] - before for before, after in zip(begin, told, strict=True)]
    assert sum(count > 0 for count in made) == 1, made
    assert [each["serves"] for each in told] == [count > 0 for count in made]
    assert len({each["served_by"] for each in told}) == 1
    assert 5.0 * seconds < len(service.poses) - rates < 15.0 * seconds  # ten a second, not twice as many
    return next(k for k, count in enumerate(made) if count)


@nightly
def test_first_node_is_killed_then_a_second_first_and_nobody_waits_for_the_dead(world_file, slow_drive, tmp_path):
    with Router() as router:
        service = Service(world_file, slow_drive, tmp_path, router=router.endpoint, robots_router=router.endpoint)
        others = []
        try:
            service.tracks(60.0)
            others.append(Other(service, router.endpoint))
            others[0].wait()
            assert serving(service, service, others[0], settle=0.0) == 0
            service.process.kill()
            killed = time.monotonic()
            service.tracks(20.0)
            gap = time.monotonic() - killed
            assert gap < 10.0, "of a busy machine; on an idle one it is 3 to 4 s"
            service.process.wait()
            assert max(service.errors()) < FALSE
            if NIGHTLY:
                started_again_and_at_once(service, others, router.endpoint)
        finally:
            for node in others:
                node.end()
            service.end()


def started_again_and_at_once(service, others, router):
    """The first node, started again, does not take the robot back; of two that start at once one serves it."""
    others.append(Other(service, router))
    others[1].wait()
    assert serving(service, *others) == 0
    while others:
        others.pop().end()
    others += [Other(service, router) for _ in range(2)]
    for node in others:
        node.wait()
    first = serving(service, *others)
    others[first].end()
    service.tracks(20.0)
    assert max(service.errors()) < FALSE


@pytest.mark.skipif(not NIGHTLY, reason="half a minute each; COVIEW_NIGHTLY=1")
@pytest.mark.parametrize("mode", ["cut", "silent"])
def test_network_in_two_parts_has_one_node_again(world_file, slow_drive, tmp_path, mode):
    with Router() as router, BadLink(router.endpoint) as link:
        service = Service(world_file, slow_drive, tmp_path, router=link.endpoint, robots_router=router.endpoint)
        other = None
        try:
            service.tracks(60.0)
            other = Other(service, router.endpoint)
            other.wait()
            assert serving(service, service, other, settle=0.0) == 0
            link.mode(mode)
            time.sleep(6.0)
            service.tracks(10.0)  # by the other one
            link.mode("open")
            serving(service, service, other, settle=4.0)
            assert max(service.errors()) < FALSE
        finally:
            if other is not None:
                other.end()
            service.end()


@nightly
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_of_a_fleet_one_node_serves_and_another_goes_on_when_it_dies_or_hangs(world_file, slow_drive, tmp_path, end):
    fleet = ("--fleet", "yard")
    with Router() as router:
        service = Service(
            world_file, slow_drive, tmp_path, router=router.endpoint, robots_router=router.endpoint, arguments=fleet
        )
        other = Other(service, router.endpoint, *fleet)
        try:
            until(lambda: other.answers(), 60.0)
            service.tracks(60.0)
            first = only_server(service, service, other)
            victim = (service, other)[first].process
            count = len(service.poses)
            victim.send_signal(end)
            until(lambda: len(service.poses) > count + 5, 20.0)
            gap = max(b - a for (a, _), (b, _) in itertools.pairwise(service.poses[count - 5 :]))
            assert gap < 6.0, "of a busy machine; 3 s on an idle one"
            if end is signal.SIGSTOP:
                victim.send_signal(signal.SIGCONT)  # it takes its robot back, and nobody else serves it
                until(lambda: serving_now(service, other) == first, 30.0)
                assert only_server(service, service, other) == first
            assert max(service.errors()) < FALSE
        finally:
            service.process.send_signal(signal.SIGCONT)
            other.process.send_signal(signal.SIGCONT)
            other.end()
            service.end()


def only_server(service, *nodes):
    """After some time to settle: which of the nodes of a fleet has the robot; its poses come once."""
    time.sleep(3.0)
    count = len(service.poses)
    time.sleep(3.0)
    assert 15 < len(service.poses) - count < 45  # ten a second, not twice as many
    return serving_now(*nodes)


def serving_now(*nodes):
    """Which of the nodes has the robot, None unless it is one."""
    has = [k for k, node in enumerate(nodes) if (told := node.robot()) is not None and told["serves"]]
    return has[0] if len(has) == 1 else None
