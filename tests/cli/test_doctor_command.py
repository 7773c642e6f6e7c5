"""``coview-stream doctor``: lines, JSON and exit codes; a real robot on loopback."""

import json
import threading

import numpy as np
import pytest
import small_world
from sockets import free_endpoint

from coview_stream.cli import main
from coview_stream.doctor import machine_checks as machine
from coview_stream.doctor.finding import Finding
from coview_stream.geometry.transforms import pose_from
from coview_stream.messages import encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.zenoh_transport import open_transport

KEYS = robot_keys("native", "coview", "r1")
POINTS = np.random.default_rng(2).uniform(-20.0, 20.0, (2000, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The machine has tests of its own, and takes seconds."""
    monkeypatch.setattr(machine, "machine_findings", lambda: iter([Finding("ok", "machine", "fine")]))


class Robot:
    """A router-like peer that sends clouds at 10 Hz, and odometry at 50 Hz."""

    def __init__(self):
        self.endpoint = free_endpoint()
        self._net = open_transport(listen=[self.endpoint])
        self._net.announce(KEYS.alive)
        self._ended = threading.Event()
        self._clouds = self._net.publisher(KEYS.cloud, "bulk")
        self._odometry = self._net.publisher(KEYS.odometry, "data")
        self._thread = threading.Thread(target=self._send)

    def _send(self):
        stamp = 10**18
        while not self._ended.wait(0.02):
            stamp += 20_000_000
            T = pose_from(np.eye(3), [stamp * 1e-9 - 1e9, 0.0, 0.0])
            self._odometry.put(encode_odometry(OdometryMessage(stamp, T), "json"))
            if stamp % 100_000_000 == 0:
                self._clouds.put(encode_cloud(CloudMessage(stamp, POINTS), "cdr"))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self._ended.set()
        self._thread.join()
        self._net.close()


def findings_of(capsys, *argv):
    code = main(["doctor", "--json", *argv])
    return code, json.loads(capsys.readouterr().out)["findings"]


@pytest.mark.slow
def test_healthy_robot_over_zenoh(capsys):
    with Robot() as robot:
        options = ("--robot", "r1", "--connect", robot.endpoint, "--seconds", "1.5")
        for _ in range(4):  # on a busy machine the robot itself may pause, and that is a finding
            code, found = findings_of(capsys, *options)
            if code == 0:
                break
    verdicts = {f["what"]: f["verdict"] for f in found if f["robot"] == "r1"}
    assert code == 0, found
    paced = ("clouds", "odometry", "cloud stamps", "odometry stamps", "pairing")
    assert {what: verdicts.pop(what) in ("ok", "warn") for what in paced} == dict.fromkeys(paced, True)
    assert verdicts == {"gravity": "ok", "ground": "warn", "one clock": "ok", "node": "warn"}
    assert "says nothing" in found[-1]["found"]  # the token was seen, a status was not
    assert [f["found"] for f in found if f["what"] == "network"] == ["connected: 1 peer"]


@pytest.mark.slow
def test_wrong_robot_name_suggests_the_right_one(capsys):
    with Robot() as robot:
        code, found = findings_of(capsys, "--robot", "rover", "--connect", robot.endpoint, "--seconds", "0.2")
    assert code == 1
    assert found[-3]["remedy"] == "clouds come on coview/r1/in/cloud: try --robot r1"
    assert (
        found[-2]["remedy"]
        == "odometry comes on coview/r1/in/odom: try --robot r1. If it has none: `serve --odometry kiss-icp`"
    )


@pytest.mark.slow
def test_no_robot_on_the_network(capsys):
    endpoint = free_endpoint()
    code, found = findings_of(capsys, "--robot", "r1", "--connect", endpoint)
    assert code == 1
    assert [(f["verdict"], f["what"]) for f in found] == [("FAIL", "network"), ("ok", "machine")]  # nothing more
    assert f"{endpoint} refuses" in found[0]["found"]


def test_endpoint_in_use_is_reported(capsys):
    with Robot() as robot:
        code, found = findings_of(capsys, "--listen", robot.endpoint)
    assert code == 1
    assert found[0]["what"] == "network"
    assert "in use" in found[0]["found"].lower()


@pytest.mark.slow
def test_robots_are_heard_before_the_machine_is_checked(capsys, monkeypatch):
    """A robot that stops meanwhile has been heard."""
    with Robot() as robot:
        monkeypatch.setattr(machine, "machine_findings", lambda: robot.__exit__() or iter([]))
        _, found = findings_of(capsys, "--robot", "r1", "--connect", robot.endpoint, "--seconds", "0.5")
    assert found[1]["what"] == "clouds"
    assert "Hz" in found[1]["found"]


def test_doctor_without_robot_checks_machine_and_map(world_file, tmp_path, capsys):
    assert main(["doctor"]) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert first == "ok    machine                 fine"
    assert last == "no problem found with this machine (clouds were not checked: --robot, --run)"
    code, found = findings_of(capsys, str(world_file))
    assert [f["what"] for f in found] == ["machine", "map", "map sha256", "map features", "map memory"]
    assert code == (found[-1]["verdict"] == "FAIL")
    assert main(["doctor", str(tmp_path / "none.coview")]) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "1 problem; symptoms and remedies: `coview-stream help reasons`"


@pytest.mark.slow
def test_run_of_another_site_fails_after_enough_metres(world_file, world_run, elsewhere_run, tmp_path, capsys):
    far = small_world.write_run(tmp_path / "far", small_world.record(small_world.boxes(seed=77), frames=14), 14)
    for run, verdict in ((world_run, "ok"), (elsewhere_run, "warn"), (far, "FAIL")):
        code, found = findings_of(capsys, str(world_file), "--run", str(run))
        assert found[-1]["verdict"] == verdict, found
        assert code == (verdict == "FAIL")


@pytest.mark.parametrize(
    "argv",
    [
        ["--seconds", "0"],
        ["--seconds", "nan"],
        ["--robot", "a/b"],
        ["--preset", "ros1"],
        ["--connect", "localhost"],
        ["--zenoh-config", "/no/such/file.json5"],
        ["--cloud-encoding", "json"],
        ["--odometry-encoding", "xyz"],
    ],
)
def test_bad_doctor_usage_is_one_line_before_slow_checks(argv, refused):
    said = refused("doctor", *argv)
    assert argv[0] in said or "/no/such/file.json5" in said
