"""``coview-stream serve`` ends on a signal, even while it waits, and refuses robots that it could not tell apart."""

import contextlib
import logging
import signal
import socket
import threading
from types import SimpleNamespace

import pytest
from sockets import free_endpoint, until

from coview_stream.cli import main
from coview_stream.cli import serve as command
from coview_stream.errors import ConfigError, install_command
from coview_stream.stream.node import engine_process, serve
from coview_stream.stream.node.engine_process import CancelledError
from coview_stream.stream.transport import zenoh_transport
from coview_stream.stream.transport.keys import robot_keys

PROMISED = 2.0
SLACK = 2.0  # for the processes of a busy machine


def end(process):
    """Send SIGTERM; the process ends well, and in time."""
    process.send_signal(signal.SIGTERM)
    assert process.wait(PROMISED + SLACK) == 0
    assert "Traceback" not in process.stderr.read()


@pytest.mark.slow
def test_signal_ends_serve(world_file, start):
    listen = ("--listen", free_endpoint())
    process = start("serve", world_file, "--robot", "r1", *listen, "--humble", "--max-speed", "20")
    assert any("ready" in line for line in process.stderr)
    end(process)


def test_engines_are_killed_where_a_stuck_thread_forbids_a_regular_exit(world_file, monkeypatch):
    class Left(Exception):
        pass

    def leave(code):
        raise Left([child.process.killed for child in children.values()])

    children = {kind: SimpleNamespace(close=lambda: None, process=Killable()) for kind in ("search", "tracking")}
    monkeypatch.setattr(engine_process, "start_children", lambda lidar: children)
    monkeypatch.setattr(command, "_serve", lambda *args: False)
    monkeypatch.setattr(command.os, "_exit", leave)
    with pytest.raises(Left, match=r"\[True, True\]"):
        main(["serve", str(world_file), "--robot", "r1", "--listen", free_endpoint(), "--quiet", "--no-state"])


class Killable:
    killed = False

    def kill(self):
        self.killed = True


@pytest.mark.slow
def test_signal_ends_serve_waiting_for_silent_host(world_file, start):
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        endpoint = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        process = start("serve", world_file, "--robot", "r1", "--connect", endpoint, "--listen", free_endpoint())
        silent.accept()
        end(process)


def test_cancelled_opening_stops_engines(world_file):
    keys = [robot_keys("native", "coview", "r1")]
    options = serve.ServeOptions(world_file, keys, serve.NetworkOptions(listen=[free_endpoint()]))
    with pytest.raises(CancelledError):
        serve.open_node(options, lambda: True)
    ours = ("coview ", "coview-watch")
    until(lambda: not [t for t in threading.enumerate() if t.name.startswith(ours)])


@pytest.mark.parametrize("told", [True, False])
def test_node_that_does_not_close_is_abandoned_also_where_its_views_fail(monkeypatch, told):
    asked = []
    monkeypatch.setattr(serve, "open_node", lambda *_: SimpleNamespace(close=asked.append))
    stop = SimpleNamespace(requested=told, wait=lambda seconds: told, now=lambda: 0.0)
    views = [object()]  # fail, as the node has no files of maps
    with contextlib.nullcontext() if told else pytest.raises(AttributeError, match="map_files"):
        assert command._serve(None, stop, sinks=views) is False
    assert len(asked) == 1


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
    assert install_command("kiss-icp") in refused(*command, "--odometry", "kiss-icp")


def test_max_payload_reaches_the_transport(monkeypatch, world_file):
    def open_transport(*args, **options):
        raise ConfigError(f"asked with {args}")

    monkeypatch.setattr(zenoh_transport, "open_transport", open_transport)
    keys = [robot_keys("native", "coview", "r1")]
    options = serve.ServeOptions(world_file, keys, node=serve.NodeConfig(max_payload=1234))
    with pytest.raises(ConfigError, match="1234"):
        serve.open_node(options)


def test_metrics_without_an_address_does_not_swallow_the_map(world_file, refused):
    said = refused("serve", "--robot", "r1", "--metrics", world_file)
    assert "is not HOST:PORT; write --metrics=127.0.0.1:9464" in said
