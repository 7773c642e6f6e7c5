"""``coview-stream watch``: table, JSON lines, viewer; signals, closed pipes and silence."""

import contextlib
import io
import json
import os
import signal
import sys
import threading

import numpy as np
import pytest
from sockets import free_endpoint

from coview_stream.cli import main
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import encode_pose
from coview_stream.messages.types import Encoded, PoseMessage
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.zenoh_transport import open_transport

T = pose_from(rot_z(0.5), [12.34, -5.0, 1.7])
STATUS = {"state": "TRACKING", "reason": "fine", "counters": {"dropped": 3}}


class Node:
    """Publishes poses and statuses of some robots, twenty times a second, until closed."""

    def __init__(self, robots=("r1", "r2"), preset="native", extra=()):
        self.endpoint = free_endpoint()
        self.transport = open_transport(listen=[self.endpoint])
        self._ended = threading.Event()
        self._messages = [(self.transport.publisher(key, "data"), message) for key, message in extra]
        for robot in robots:
            keys = robot_keys(preset, "coview", robot)
            pose = PoseMessage(7, robot, "TRACKING", T, np.eye(6), 0.9, "ab", 0.1)
            status = Encoded(json.dumps({"robot": robot, **STATUS}).encode(), "application/json")
            for key, urgency, encoded in (
                (keys.pose, "realtime", encode_pose(pose, keys.pose_format)),
                (keys.status, "data", status),
            ):
                self._messages.append((self.transport.publisher(key, urgency), encoded))
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self):
        while not self._ended.wait(0.05):
            for publisher, message in self._messages:
                publisher.put(message)

    def close(self):
        self._ended.set()
        self._thread.join()
        self.transport.close()


@pytest.fixture
def node():
    made = Node()
    yield made
    made.close()


class Screen(io.StringIO):
    """Output that asks the command to end once it has so many lines, or so many of a text."""

    def __init__(self, times=np.inf, text="\n", terminal=False):
        super().__init__()
        self.times, self.text, self.isatty = times, text, lambda: terminal

    @property
    def enough(self):
        return self.getvalue().count(self.text) >= self.times

    def write(self, text):
        count = super().write(text)
        if self.enough:
            os.kill(os.getpid(), signal.SIGTERM)
        return count


def watch(endpoint, *options, out=None, err=None):
    """Run the command until one of the screens has enough, 20 s at most; return their texts."""
    out, err = out or Screen(), err or Screen()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert main(["watch", "--connect", endpoint, "--seconds", "20", *options]) == 0
    assert out.enough or err.enough, "it ran into its time limit"
    return out.getvalue(), err.getvalue()


def test_watch_prints_json_lines_of_all_robots(node):
    out, err = watch(node.endpoint, "--json", out=Screen(24))
    records = [json.loads(line) for line in out.splitlines()]
    assert {r["key"] for r in records} == {f"coview/{n}/out/{w}" for n in ("r1", "r2") for w in ("pose", "status")}
    pose = next(r for r in records if r["key"] == "coview/r1/out/pose")
    assert pose["robot"] == "r1"
    assert pose["stamp_ns"] == 7
    assert pose["position"] == pytest.approx([12.34, -5.0, 1.7])
    assert len(pose["covariance"]) == 36
    status = next(r for r in records if r["key"] == "coview/r2/out/status")
    assert status == {"key": "coview/r2/out/status", "robot": "r2", **STATUS}
    assert err == ""


@pytest.mark.slow
def test_watch_prints_lines_without_terminal(node):
    out, _ = watch(node.endpoint, "--robot", "r1", out=Screen(2))
    header, line = out.splitlines()
    assert header.split()[:3] == ["robot", "state", "x"]
    cells = line.split()
    assert cells[:6] == ["r1", "TRACKING", "12.34", "-5.00", "1.70", "28.6"]
    assert float(cells[8]) > 1.0
    assert cells[9:] == ["1", "in", "10", "-/-", "3", "fine"]


@pytest.mark.slow
def test_watch_redraws_terminal_in_place(node, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    out, _ = watch(node.endpoint, out=Screen(2, "\x1b[J", terminal=True))
    frames = out.split("\x1b[J")[1:]
    assert len(frames) == 2
    assert frames[0].endswith("\x1b[5F")  # back over the header and two robots with their reasons
    for frame in frames:
        lines = frame.removesuffix("\x1b[5F").splitlines()
        assert [line.split()[0] for line in lines] == ["robot", "r1", "fine", "r2", "fine"]
        assert max(map(len, lines)) < 60


def test_watch_reads_poses_of_a_preset():
    with contextlib.closing(Node(("r1",), preset="ros2dds")) as node:
        out, _ = watch(node.endpoint, "--json", "--robot", "r1", "--preset", "ros2dds", out=Screen(6))
    records = {record["key"]: record for record in map(json.loads, out.splitlines())}
    assert records.keys() == {"r1/coview/pose", "coview/r1/out/status"}
    pose = records["r1/coview/pose"]
    assert (pose["robot"], pose["confidence"]) == ("r1", None)
    assert pose["position"] == pytest.approx([12.34, -5.0, 1.7])


def test_undecodable_messages_of_strangers_are_one_printable_line():
    title = "coview/\x1b]0;owned\x07/out/status"
    bad = [(title, Encoded(b"[]")), (title, Encoded(bytes(100_000)))]
    bad += [(f"coview/x{number}\x1b[2J/out/status", Encoded(b"{")) for number in range(50)]
    with contextlib.closing(Node(("r2",), extra=bad)) as node:
        out, err = watch(node.endpoint, "--json", out=Screen(8))
    assert {json.loads(line)["robot"] for line in out.splitlines()} == {"r2"}
    (line,) = err.splitlines()
    assert line.startswith("cannot be read: ")
    assert line.isprintable()


@pytest.mark.slow
def test_watch_explains_missing_messages():
    with contextlib.closing(Node(())) as node:
        out, err = watch(node.endpoint, "--base", "site/a", err=Screen(1))
    assert out == ""
    assert err.count("\n") == 1
    assert "nothing yet on site/a/*/out/pose, site/a/*/out/status; connected to 1 program" in err
    assert node.endpoint in err


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_watch(node, start, number):
    running = start("watch", "--connect", node.endpoint, "--json")
    assert json.loads(running.stdout.readline())["key"].startswith("coview/r")
    running.send_signal(number)
    _, err = running.communicate(timeout=20)
    assert (running.returncode, err) == (0, "")


@pytest.mark.slow
def test_closed_pipe_prints_no_traceback(node, start):
    running = start("watch", "--connect", node.endpoint, "--json")
    running.stdout.readline()
    running.stdout.close()
    assert running.wait(timeout=20) == 141
    assert running.stderr.read() == ""


def test_missing_viewer_library_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["watch", "--listen", free_endpoint(), "--rerun"]) == 2
    assert "--rerun: rerun is not installed; " in capsys.readouterr().err


def test_map_is_asked_for_where_the_network_options_say(refused, tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path))
    endpoint = free_endpoint()
    assert f"zenoh://yard ({endpoint})" in refused("watch", "--connect", endpoint, "--map", "zenoh://yard")


@pytest.mark.parametrize("failing", ["--web=192.0.2.1:1", "--connect=nonsense"])
def test_views_are_closed_where_what_follows_them_fails(tmp_path, refused, failing):
    refused("watch", "--record", tmp_path / "a.mcap", failing)
    assert not list(tmp_path.iterdir())  # a recording of nothing is removed once it is closed


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--seconds", "0"], "--seconds"),
        (["--seconds", "nan"], "--seconds"),
        (["--preset", "ros2dds"], "--robot"),
        (["--preset", "ros1", "--robot", "r1"], "ros1"),
        (["--robot", "*"], "--robot"),
        (["--base", "a//b"], "--base"),
        (["--connect", "nonsense"], "nonsense"),
    ],
)
def test_bad_watch_usage_is_one_line(refused, options, text):
    assert text in refused("watch", "--listen", free_endpoint(), *options)
