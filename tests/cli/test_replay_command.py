"""``coview-stream replay`` over real sockets, and what it refuses."""

import json
import shutil
import signal
import threading
import time

import numpy as np
import pytest
from sockets import free_endpoint, until

from coview_stream.cli import main
from coview_stream.clouds.files import write_cloud
from coview_stream.clouds.trajectory import write_tum
from coview_stream.geometry.transforms import pose_from
from coview_stream.messages import decode_cloud, decode_odometry
from coview_stream.messages.types import Encoded
from coview_stream.stream.transport.zenoh_transport import open_transport


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay") / "run"
    (folder / "frames").mkdir(parents=True)
    rng = np.random.default_rng(2)
    for k in range(6):
        write_cloud(folder / "frames" / f"{k:06d}.pcd", rng.normal(size=(500, 3)).astype(np.float32))
    write_tum(folder / "odometry.tum", 20.0 + np.arange(6), [pose_from(np.eye(3), [k, 0, 0]) for k in range(6)])
    return folder


class Node:
    """Takes down what a replay sends."""

    def __init__(self):
        self.endpoint = free_endpoint()
        self.transport = open_transport(listen=[self.endpoint])
        self.sent = []

    def subscribe(self, cloud="coview/r1/in/cloud", odometry="coview/r1/in/odom", codecs=(None, None)):
        """Take down both, in these codecs alone."""
        self.transport.subscribe(cloud, lambda s: self.sent.append(decode_cloud(s, option=codecs[0])), "all")
        self.transport.subscribe(odometry, lambda s: self.sent.append(decode_odometry(s, option=codecs[1])), "all")

    def replay(self, run, *options):
        """Replay a run to this node; return the exit code."""
        return main(["replay", str(run), "--robot", "r1", "--connect", self.endpoint, *options])

    def clouds(self):
        return [m for m in self.sent if hasattr(m, "points")]

    def odometry(self):
        return [m for m in self.sent if hasattr(m, "T_odom_body")]


@pytest.fixture
def node():
    made = Node()
    yield made
    made.transport.close()


@pytest.mark.slow
def test_replayed_run_arrives_complete(node, run_folder, capsys):
    node.subscribe()
    assert node.replay(run_folder, "--rate", "20", "--odometry-rate", "60") == 0
    until(lambda: len(node.clouds()) == 6 and len(node.odometry()) == 16)
    assert sorted(m.stamp_ns for m in node.clouds()) == [(20 + k) * 10**9 for k in range(6)]
    assert [m.stamp_ns for m in node.odometry()] == sorted({m.stamp_ns for m in node.odometry()})
    captured = capsys.readouterr()
    assert captured.out.startswith("6 frames (")
    assert "16 odometry samples sent" in captured.out
    assert "put p50" in captured.out
    assert captured.err == ""
    assert node.replay(run_folder, "--rate", "20", "--cloud-delay", "0.5") == 0  # the first is before all odometry
    until(lambda: len(node.clouds()) == 11)
    assert sorted(m.stamp_ns for m in node.clouds()[6:]) == [(20 + k) * 10**9 + 5 * 10**8 for k in range(5)]
    assert {float(m.T_odom_body[0, 3]) % 1.0 for m in node.odometry() if m.stamp_ns % 10**9} >= {0.5}


@pytest.mark.slow
def test_replay_of_clouds_without_odometry(node, run_folder, tmp_path, capsys):
    bare = tmp_path / "run"
    shutil.copytree(run_folder / "frames", bare / "frames")
    node.subscribe()
    assert node.replay(bare, "--rate", "50", "--odometry", "none") == 0
    until(lambda: len(node.clouds()) == 6)
    assert sorted(m.stamp_ns for m in node.clouds()) == [k * 10**8 for k in range(6)]
    captured = capsys.readouterr()
    assert "and 0 odometry samples sent" in captured.out
    assert captured.err == f"{bare}: no times.txt; frames are taken for 0.1 s apart\n"
    assert node.replay(run_folder, "--odometry", "none", "--cloud-delay", "0.1") == 2
    assert node.replay(run_folder, "--rate", "50", "--odometry", "none") == 0
    until(lambda: len(node.clouds()) == 12)
    assert max(m.stamp_ns for m in node.clouds()) == 25 * 10**9
    assert node.odometry() == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "keys"),
    [
        (
            ["--encoding", "foxglove", "--odometry-encoding", "cdr"],
            ("coview/r1/in/cloud", "coview/r1/in/odom", ("foxglove", "cdr")),
        ),
        (["--preset", "ros2dds"], ("r1/points", "r1/odom", ("cdr", "cdr"))),
    ],
)
def test_replay_in_other_encodings_and_to_other_keys(node, run_folder, options, keys):
    node.subscribe(*keys)
    assert node.replay(run_folder, "--rate", "50", *options) == 0
    until(lambda: len(node.clouds()) == 6 and len(node.odometry()) >= 6)  # more are interpolated
    assert all(m.points.shape == (500, 3) for m in node.clouds())


@pytest.mark.slow
def test_replay_without_subscriber_exits_with_one(node, run_folder, capsys):
    for robot in ("r3", "r2"):
        node.transport.announce(f"coview/{robot}/alive")
    assert node.replay(run_folder, "--rate", "100", "--wait", "0.1") == 1
    captured = capsys.readouterr()
    assert "nothing subscribes to coview/r1/in/cloud yet: nodes serve r2, r3; sending all the same" in captured.err
    assert "6 frames" in captured.out
    assert captured.out.splitlines()[-1].startswith("nothing subscribed: ")
    assert "one odometry sample in 1.00 s is too few" in captured.err


@pytest.mark.slow
def test_replay_with_late_subscriber_exits_with_zero(node, run_folder, capsys):
    node.transport.subscribe("coview/r1/in/odom", lambda _: node.sent or node.subscribe(), "newest")
    assert node.replay(run_folder, "--rate", "20", "--wait", "0") == 0
    captured = capsys.readouterr()
    assert "nothing subscribes" in captured.err
    assert "nothing subscribed" not in captured.out


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_replay_loop_cleanly(node, run_folder, start, number):
    node.subscribe()
    pace = ("--loop", "--rate", "50", "--odometry-rate", "200")
    process = start("replay", run_folder, "--robot", "r1", "--connect", node.endpoint, *pace)
    until(lambda: len(node.clouds()) > 8, 30)
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0
    assert "ended early" in out
    assert err == ""
    stamps = [m.stamp_ns for m in node.clouds()]
    assert stamps == sorted(stamps)
    assert stamps[-1] > 26 * 10**9  # beyond the first lap


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--rate", "0"], "--rate"),
        (["--rate", "5", "--speed", "2"], "one of them"),
        (["--preset", "ros1"], "--preset"),
        (["--encoding", "zip"], "zip"),
        (["--connect", "nonsense"], "nonsense"),
        (["--zenoh-config", "none.json5"], "none.json5"),
        (["--odometry", "none.tum"], "none.tum"),
        (["--odometry", "kiss-icp"], "`serve --odometry kiss-icp`"),
        (["--odometry", "kiss-icp"], "`replay --odometry none`"),
        (["--odometry", "none", "--odometry-rate", "9"], "--odometry-rate"),
        (["--odometry", "none", "--odometry-topic", "/odom"], "--odometry-topic"),
        (["--robot", "a/b"], "--robot"),
        (["--base", "x*"], "--base"),
        (["--wait", "-1"], "--wait"),
    ],
)
def test_bad_replay_usage_is_one_line(run_folder, refused, options, text):
    assert text in refused("replay", run_folder, "--robot", "r1", "--listen", free_endpoint(), *options)


@pytest.mark.slow
def test_replay_waits_until_the_node_is_ready(node, run_folder, capsys):
    """A node subscribes before its engines have opened the map; clouds that come earlier are lost."""
    sent_before = []

    def start():
        key = "coview/@node/x/out/health"
        publisher = node.transport.publisher(key, "report")
        node.transport.await_subscriber(key, 20.0)
        for ok in (False, False, False, False, True):
            time.sleep(0.3)
            sent_before.append(len(node.sent))
            health = {"robots": {"r1": {}}, "ready": {"ok": ok, "reasons": []}}
            publisher.put(Encoded(json.dumps(health).encode(), "application/json"))

    node.subscribe()
    engines = threading.Thread(target=start, daemon=True)
    engines.start()
    assert node.replay(run_folder, "--rate", "50") == 0
    engines.join()
    until(lambda: len(node.clouds()) == 6)
    assert sent_before == [0] * 5
    assert "not ready" not in capsys.readouterr().err
