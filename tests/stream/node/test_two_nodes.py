"""Two nodes for one robot, with real processes: one serves it, and the other takes over with a pose."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time

import pytest
from serving import FALSE, Service
from sockets import until
from zenoh_routers import Router

from coview_stream.stream.node.engine_child import python_command, python_environment

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
            for line in second.stderr:
                if f"node {first} serves it: standing by" in line:
                    break
            threading.Thread(target=second.stderr.read, daemon=True).start()
            time.sleep(8.0)  # until it knows the place
            assert {node for _, node in said} == {first}

            begin = time.monotonic()
            service.process.send_signal(signal.SIGSTOP)
            until(lambda: said[-1][1] != first, 20.0)
            service.tracks(5.0)  # it knew the place
            assert time.monotonic() - begin < 15.0  # two and a half statuses, of a busy machine

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
            service.tracks(5.0)
            assert max(service.errors()) < FALSE
        finally:
            service.process.send_signal(signal.SIGCONT)
            if second is not None:
                second.kill()
                second.wait()
            assert service.end() == 0
