"""A node as an operator has it: a process that is signalled, whose map is replaced, and whose engines are killed."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from sockets import free_endpoint, until

from coview_stream.basemap.basemap import BaseMap
from coview_stream.stream.client.client import RobotClient
from coview_stream.stream.node.engine_child import python_command, python_environment

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")]

FALSE = 1.0  # metres: the world is 68 m wide and its poses are good to a few centimetres


class Service:
    """A process that serves a copy of a map, and a robot that goes to and fro on it, twenty frames a second."""

    def __init__(self, world_file, drive, folder):
        self.folder, self.drive = folder, drive
        self.map = folder / "site.coview"
        self.map.write_bytes(Path(world_file).read_bytes())
        self.endpoint, self.notices = free_endpoint(), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.notices.bind(str(folder / "notify"))
        self.notices.settimeout(30.0)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.metrics = f"127.0.0.1:{probe.getsockname()[1]}"
        self.log = (folder / "log").open("wb")
        self.process = subprocess.Popen(
            python_command(
                "coview_stream", "serve", str(self.map), "--robot", "r1", "--listen", self.endpoint,
                "--state", str(folder / "state"), "--metrics", self.metrics, "--log-json",
            ),
            env=python_environment() | {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "1000000"},
            stderr=self.log,
        )  # fmt: skip
        self.client = RobotClient("r1", self.endpoint)
        self.poses, self.truth = [], {}
        self.pace = 0.1
        self._ending = threading.Event()
        self.client.wait_for_node(30)
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._send, self._read)]
        for thread in self._threads:
            thread.start()

    def _send(self):
        count = len(self.drive.clouds)
        started = time.monotonic()
        for k in range(1_000_000):
            at = (count - 1) - abs((k % (2 * count - 2)) - (count - 1))
            stamp = 1000.0 + self.pace * k
            self.truth[round(stamp * 1e9)] = self.drive.T_map_body[at]
            self.client.send_odometry(self.drive.T_odom_body[at], stamp)
            self.client.send_cloud(self.drive.clouds[at], stamp)
            if self._ending.wait(max(0.0, started + self.pace * (k + 1) - time.monotonic())):
                return

    def _read(self):
        for pose in self.client.poses(timeout=None):
            self.poses.append((time.monotonic(), pose))
            if self._ending.is_set():
                return

    def health(self):
        try:
            with urllib.request.urlopen(f"http://{self.metrics}/health", timeout=10) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:  # not ready
            return json.load(error)

    def engines(self):
        return {name: engine["pid"] for name, engine in self.health()["engines"].items()}

    def said(self):
        return [json.loads(line) for line in (self.folder / "log").read_text().splitlines()]

    def tracks(self, seconds=40.0):
        """Wait for a pose that comes from now on."""
        since = time.monotonic()
        until(lambda: self.poses and self.poses[-1][0] > since, seconds)

    def errors(self):
        """Metres by which each pose is off; odometry is perfect, and every pose has a frame's stamp."""
        return [
            float(np.linalg.norm(pose.T_map_body[:3, 3] - self.truth[pose.stamp_ns][:3, 3]))
            for _, pose in list(self.poses)
        ]

    def end(self):
        self._ending.set()
        self.process.terminate()
        try:
            return self.process.wait(10.0)
        finally:
            self.process.kill()
            self.client.close()
            self.notices.close()
            self.log.close()


@pytest.fixture
def service(world_file, slow_drive, tmp_path):
    made = Service(world_file, slow_drive, tmp_path)
    yield made
    made.end()


def second_map(world_file, path):
    """The same survey as a map with another hash."""
    first = BaseMap.load(world_file)
    arrays = {name: np.array(array) for name, array in first._arrays.items()}
    BaseMap(arrays, {**first.parameters, "note": "surveyed again"}).save(path)
    return BaseMap.load(path).sha256


def test_map_is_replaced_while_poses_go_on(service, world_file):
    service.tracks()
    assert service.notices.recv(500).startswith(b"READY=1")
    old = service.health()["map"]["sha256"]
    new = service.folder / "new.coview"
    sha256 = second_map(world_file, new)

    (service.folder / "half").write_bytes(new.read_bytes()[: new.stat().st_size // 2])
    (service.folder / "half").replace(service.map)
    service.process.send_signal(signal.SIGHUP)
    until(lambda: service.health()["map"]["reload"]["result"] == "refused", 30.0)
    assert service.health()["map"]["sha256"] == old
    assert any("refused" in record["message"] for record in service.said())
    service.tracks(1.0)

    new.replace(service.map)
    begin = len(service.poses)
    service.process.send_signal(signal.SIGHUP)
    until(lambda: service.health()["map"]["reload"]["result"] == "changed", 60.0)
    service.tracks(1.0)
    times, poses = zip(*service.poses[begin:], strict=True)
    shas = [pose.map_sha256 for pose in poses]
    assert set(shas) == {old, sha256}
    assert shas == sorted(shas, key=lambda sha: sha == sha256)  # never back
    change = shas.index(sha256)
    assert np.diff(times).max() < 1.0, "of a busy machine; on an idle one it is 0.1 s"
    assert poses[change].stamp_ns - poses[change - 1].stamp_ns <= 0.35e9  # by the robot's own clock
    assert max(service.errors()) < FALSE
    assert service.end() == 0


def test_signs_of_life_and_the_end_are_told_to_systemd(service):
    heard = {service.notices.recv(500).split(b"\n")[0] for _ in range(4)}
    assert heard == {b"READY=1", b"WATCHDOG=1"}
    assert service.end() == 0


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_engines_that_are_killed_or_stopped_at_any_time_come_back(service, number):
    rng = random.Random(int(number))
    service.tracks()
    for name in ("search", "track"):
        time.sleep(rng.uniform(0.0, 0.5))
        pid = service.engines()[name]
        os.kill(pid, number)
        until(lambda name=name, pid=pid: service.engines()[name] not in (None, pid), 10.0)
        assert not Path(f"/proc/{pid}").exists()  # nor a zombie
        until(lambda: service.health()["ready"]["ok"], 60.0)
        service.tracks(60.0)
    assert max(service.errors()) < FALSE
    restarts = {name: engine["restarts"] for name, engine in service.health()["engines"].items()}
    assert restarts == {"track": 1, "search": 1}
