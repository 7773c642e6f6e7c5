"""A node as an operator has it: a process of its own, and a robot that drives."""

import json
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
from sockets import free_endpoint, until

from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.stream.client.client import RobotClient

FALSE = 1.0  # metres: the world is 68 m wide and its poses are good to a few centimetres


class Driver:
    """A robot that goes to and fro, and the poses that it gets.

    Attributes:
        pace: seconds between two frames.
        stamp_of: the robot's clock.
        poses: local times and poses.
        truth: poses by their stamps.
    """

    def __init__(self, name, endpoint, drive, pace=0.1):
        self.client, self.drive = RobotClient(name, endpoint), drive
        self.poses, self.truth = [], {}
        self.pace, self.stamp_of = pace, lambda seconds: 1000.0 + seconds
        self._ending = threading.Event()

    def start(self, *more):
        for run in (self._send, self._read, *more):
            threading.Thread(target=run, daemon=True).start()

    def _send(self):
        count = len(self.drive.clouds)
        due = started = time.monotonic()
        for k in range(1_000_000):
            at = (count - 1) - abs((k % (2 * count - 2)) - (count - 1))
            stamp = self.stamp_of(due - started)
            self.truth[round(stamp * 1e9)] = self.drive.T_map_body[at]
            self.client.send_odometry(self.drive.T_odom_body[at], stamp)
            self.client.send_cloud(self.drive.clouds[at], stamp)
            due += self.pace
            if self._ending.wait(max(0.0, due - time.monotonic())):
                return

    def _read(self):
        for pose in self.client.poses(timeout=None):
            self.poses.append((time.monotonic(), pose))
            if self._ending.is_set():
                return

    def errors(self):
        """Metres by which each pose is off; odometry is perfect, and every pose has a frame's stamp."""
        assert self.poses
        return [
            float(np.linalg.norm(pose.T_map_body[:3, 3] - self.truth[pose.stamp_ns][:3, 3]))
            for _, pose in list(self.poses)
        ]

    def end(self):
        self._ending.set()
        self.client.close()


def health_at(address):
    """Health of the node that serves its metrics there; None if there is none."""
    try:
        with urllib.request.urlopen(f"http://{address}/health", timeout=10) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:  # not ready
        return json.load(error)
    except OSError:
        return None


def free_address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


class Service(Driver):
    """A process that serves a copy of a map, and a robot on it, ten frames a second."""

    def __init__(self, world_file, drive, folder, router="", robots_router="", arguments=(), **environment):
        """Listen, and be connected to, unless the endpoints of a router are given: the node's, and the robot's."""
        self.folder = folder
        self.map = folder / "site.coview"
        self.map.write_bytes(Path(world_file).read_bytes())
        self.endpoint, self.notices = robots_router or free_endpoint(), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.notices.bind(str(folder / "notify"))
        self.notices.settimeout(30.0)
        self.metrics = free_address()
        self._log = []
        notices = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "1000000"}
        where = ("--connect", router) if router else ("--listen", self.endpoint)
        self.process = subprocess.Popen(
            python_command(
                "coview_stream", "serve", str(self.map), "--robot", "r1", *where,
                "--state", str(folder / "state"), "--metrics", self.metrics, "--log-json", *arguments,
            ),
            env=python_environment() | notices | environment,
            stderr=subprocess.PIPE,
        )  # fmt: skip
        super().__init__("r1", self.endpoint, drive)
        self.client.wait_for_node(30)
        self.start(self._listen)

    def _listen(self):
        for line in self.process.stderr:
            self._log.append(line)

    def robot(self):
        """The robot in the health of the node; None if another node of its fleet has it."""
        return self.health()["robots"].get("r1")

    def health(self):
        return health_at(self.metrics)

    def engines(self):
        return {name: engine["pid"] for name, engine in self.health()["engines"].items()}

    def said(self):
        return [json.loads(line) for line in list(self._log)]

    def tracks(self, seconds=40.0):
        """Wait for a pose that comes from now on."""
        since = time.monotonic()
        until(lambda: self.poses and self.poses[-1][0] > since, seconds)

    def end(self):
        self._ending.set()
        self.process.terminate()
        try:
            return self.process.wait(10.0)
        finally:
            self.process.kill()
            self.client.close()
            self.notices.close()
            self.process.stderr.close()
