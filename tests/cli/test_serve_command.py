"""``coview-stream serve`` ends on a signal, even while it waits, and refuses robots that it could not tell apart."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import threading

import pytest
from sockets import free_endpoint, until

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.cli import serve as command
from coview_stream.errors import ConfigError
from coview_stream.stream.node import serve
from coview_stream.stream.node.engine_process import CancelledError
from coview_stream.stream.transport import zenoh_transport
from coview_stream.stream.transport.keys import robot_keys

PROMISED = 2.0
SLACK = 2.0  # for the processes of a busy machine


def serving(*args):
    paths = os.pathsep.join(p for p in sys.path if p)
    return subprocess.Popen(
        [sys.executable, "-m", "coview_stream", "serve", *map(str, args)],
        env=os.environ | {"PYTHONPATH": paths},
        stderr=subprocess.PIPE,
        text=True,
    )


def ends(process):
    """Exit code and what it said, after SIGTERM."""
    process.send_signal(signal.SIGTERM)
    try:
        code = process.wait(PROMISED + SLACK)
    finally:
        process.kill()
    return code, process.stderr.read()


def heard(process, text):
    return next((line for line in process.stderr if text in line), None)


@pytest.mark.slow
def test_signal_ends_serve(world_file):
    endpoint = free_endpoint()
    process = serving(world_file, "--robot", "r1", "--listen", endpoint, "--humble", "--max-speed", "20")
    assert heard(process, "ready")
    code, said = ends(process)
    assert code == 0
    assert "Traceback" not in said


@pytest.mark.slow
def test_signal_ends_serve_waiting_for_silent_host(world_file):
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        process = serving(world_file, "--robot", "r1", "--connect", endpoint, "--listen", free_endpoint())
        silent.accept()
        code, said = ends(process)
    assert code == 0
    assert "Traceback" not in said


def test_cancelled_opening_stops_engines(world_file):
    keys = [robot_keys("native", "coview", "r1")]
    options = serve.ServeOptions(world_file, keys, serve.NetworkOptions(listen=[free_endpoint()]))
    with pytest.raises(CancelledError):
        serve.open_node(options, lambda: True)
    ours = ("coview ", "coview-watch")
    until(lambda: not [t for t in threading.enumerate() if t.name.startswith(ours)])


class Stop:
    """Asked to stop from the start, or never."""

    def __init__(self, requested):
        self.requested = requested

    def now(self):
        return 0.0

    def wait(self, seconds):
        return self.requested


def test_node_that_does_not_close_is_abandoned(monkeypatch):
    class Stuck:
        def close(self, patience):
            return False

    monkeypatch.setattr(serve, "open_node", lambda *_: Stuck())
    assert command._serve(None, Stop(True)) is False


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--robot", "a", "b", "--cloud-key", "points"], "use {robot} in --cloud-key"),
        (["--robot", "a", "a"], "each name once"),
        (["--robot", "a", "--pose-key", "coview/a/in/cloud"], "--pose-key"),
        (["--robot", "a", "--max-speed", "0"], "max_speed"),
        (["--robot", "a", "--max-outage", "-1"], "max_outage"),
        (["--robot", "a", "--gravity", "level"], "--gravity goes with --odometry kiss-icp"),
        (["--robot", "a", "--odometry", "kiss-icp", "--gravity", "0,0,9.8"], "accelerometer"),
        (["--robot", "a", "--odometry", "kiss-icp", "--odometry-key", "k"], "reads no odometry"),
    ],
)
def test_bad_serve_options_are_refused_before_anything_is_logged(args, message, world_file, refused, caplog):
    caplog.set_level(logging.INFO)
    assert message in refused("serve", world_file, *args)
    assert not caplog.records


@pytest.mark.slow
def test_serve_odometry_kiss_icp_names_missing_library(tmp_path, monkeypatch, world_file, refused):
    (tmp_path / "kiss_icp").mkdir()
    (tmp_path / "kiss_icp" / "__init__.py").write_text("raise ImportError('no', name='kiss_icp')")
    monkeypatch.syspath_prepend(tmp_path)
    command = ["serve", world_file, "--robot", "r1", "--listen", free_endpoint(), "--quiet"]
    assert "pip install 'coview-stream[kiss-icp]'" in refused(*command, "--odometry", "kiss-icp")


def test_unreadable_map_is_refused(tmp_path, capsys):
    path = tmp_path / "broken.coview"
    path.write_bytes(b"no map")
    assert main(["serve", str(path), "--robot", "r1", "--listen", free_endpoint()]) == 2
    assert "broken.coview" in capsys.readouterr().err


def test_max_payload_reaches_the_transport(monkeypatch, world_file):
    def open_transport(*args, **options):
        raise ConfigError(f"asked with {args}")

    monkeypatch.setattr(zenoh_transport, "open_transport", open_transport)
    keys = [robot_keys("native", "coview", "r1")]
    options = serve.ServeOptions(world_file, keys, node=serve.NodeConfig(max_payload=1234))
    assert BaseMap.load(world_file).sha256
    with pytest.raises(ConfigError, match="1234"):
        serve.open_node(options)


def test_metrics_without_an_address_does_not_swallow_the_map(world_file, refused):
    said = refused("serve", "--robot", "r1", "--metrics", world_file)
    assert "is no HOST:PORT; write --metrics=127.0.0.1:9464" in said
