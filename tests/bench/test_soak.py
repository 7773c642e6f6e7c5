"""The soak: its clocks, faults, link and slopes; and a short one."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from nightly import nightly

from bench.harness.suite import ROOT, environment
from bench.soak.faults import FAULTS
from bench.soak.link import forward
from bench.soak.nodes import Sampled, slope
from bench.soak.robots import Manner, content_of, shifted, stamp
from bench.soak.soak import chosen, tables
from bench.soak.stage import Actor
from bench.soak.watch import Robot
from bench.stream.processes import free_port
from coview_stream.errors import InputError


def test_every_fault_comes_once_before_any_comes_again_and_processes_grow_old_every_other_round() -> None:
    gentle = {name for name, fault in FAULTS.items() if not fault.ends_processes}
    assert len(FAULTS) - len(gentle) == 4
    assert "node SIGTERM, started again" not in gentle
    drawn = list(islice(chosen([], 5), 2 * len(FAULTS) + len(gentle)))
    first, second, third = drawn[: len(FAULTS)], drawn[len(FAULTS) : -len(FAULTS)], drawn[-len(FAULTS) :]
    assert set(first) == set(third) == set(FAULTS)
    assert set(second) == gentle
    assert first != third
    assert drawn == list(islice(chosen([], 5), len(drawn)))


def test_faults_are_chosen_by_words() -> None:
    assert set(islice(chosen(["router", "clock"], 1), 9)) == {
        "router killed, back after 3 s", "sensor clock steps 1 h ahead", "sensor clock steps 10 min back",
    }  # fmt: skip
    with pytest.raises(InputError, match="no fault is called so"):
        next(chosen(["earthquake"], 1))


@pytest.mark.parametrize("manner", [Manner(), Manner(offset=3600.0), Manner(offset=-600.0), Manner(unit_ns=1_000_000)])
def test_a_stamp_tells_the_moment_of_the_drive_whatever_the_clock_did(manner: Manner) -> None:
    known = [Manner(), Manner(offset=3600.0), Manner(offset=-600.0), Manner(unit_ns=1_000_000)]
    for content in (0.1, 250.25, 3599.9):
        assert content_of(stamp(content, manner), known, near=content + 2.0) == pytest.approx(content, abs=1e-3)


def test_a_stamp_of_no_clock_is_far_from_every_moment() -> None:
    assert abs(content_of(stamp(50.0, Manner(offset=1000.0)), [Manner()], near=50.0) - 50.0) == pytest.approx(1000.0)


def test_a_jump_moves_and_turns_the_odometry_frame() -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    np.testing.assert_allclose(shifted(pose, (10.0, 20.0, np.pi / 2))[:3, 3], [8.0, 21.0, 3.0])


def samples(begin: float, seconds: float, start: float, per_hour: float, warm_up: float = 0.0) -> list[Sampled]:
    at = np.arange(0.0, seconds, 10.0)
    memory = start + per_hour * at / 3600 + warm_up * (1 - np.exp(-at / 30))
    noise = np.random.default_rng(int(begin)).normal(0, 0.05, len(at))
    return [Sampled(begin + t, m, 20) for t, m in zip(at, memory + noise, strict=True)]


def test_a_leak_is_seen_across_restarts() -> None:
    rows = [samples(0.0, 1200.0, 100.0, 12.0), samples(1300.0, 1500.0, 80.0, 12.0)]
    assert slope(rows, "megabytes", warm=180.0) == pytest.approx(12.0, abs=1.0)
    assert slope(rows, "descriptors", warm=180.0) == 0.0


def test_warming_up_and_being_started_again_is_no_leak() -> None:
    rows = [samples(900.0 * k, 800.0, 100.0 + k, 0.0, warm_up=40.0) for k in range(4)]
    assert abs(slope(rows, "megabytes", warm=240.0) or 0.0) < 0.7
    assert (slope(rows, "megabytes", warm=0.0) or 0.0) > 0.5


def test_frames_are_counted_across_nodes_whose_statuses_alternate() -> None:
    robot = Robot.__new__(Robot)
    robot.received = []
    for start, received in ((10.0, 5), (60.2, 1), (10.4, 9), (59.8, 4), (10.1, 12)):
        robot.count(start, received)
    assert robot.frames == 16


def test_nothing_known_has_no_slope() -> None:
    assert slope([], "megabytes", warm=0.0) is None
    assert slope([samples(0.0, 60.0, 1.0, 0.0)], "megabytes", warm=0.0) is None


@pytest.mark.slow
def test_a_link_forwards_flips_bits_falls_silent_and_cuts() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def accept() -> None:
            while True:
                try:
                    end, _ = server.accept()
                except OSError:
                    return
                threading.Thread(target=echo, args=(end,), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        port = free_port()
        link = Actor(forward, port, server.getsockname()[1], 1)
        message = bytes(range(256)) * 400
        try:
            with socket.create_connection(("127.0.0.1", port)) as ours:
                ours.settimeout(5.0)
                assert through(ours, message) == message
                link.send("corrupt")
                assert any(through(ours, message) != message for _ in range(40))
                link.send("silent")
                ours.settimeout(0.5)
                ours.sendall(b"x")
                with pytest.raises(TimeoutError):
                    ours.recv(1)
                link.send("open")
                ours.settimeout(5.0)
                assert ours.recv(1)
                link.send("cut")
                assert ended(ours)
        finally:
            link.kill()


def echo(end: socket.socket) -> None:
    """Send back what comes."""
    with contextlib.suppress(OSError):
        while data := end.recv(65536):
            end.sendall(data)


def ended(ours: socket.socket) -> bool:
    """Read until the other side is gone; whether it is."""
    with contextlib.suppress(ConnectionError):
        while ours.recv(65536):
            pass
    return True


def through(ours: socket.socket, message: bytes) -> bytes:
    """Send a message through the echo and read as much again."""
    sender = threading.Thread(target=ours.sendall, args=(message,))
    sender.start()
    back = b""
    while len(back) < len(message):
        back += ours.recv(65536)
    sender.join()
    return back


@pytest.mark.slow
@nightly
def test_a_short_soak_survives_two_faults(tmp_path: Path) -> None:
    pytest.importorskip("psutil")
    out = tmp_path / "rows.json"
    words = ["--quick", "--minutes", "0.3", "--every", "8", "--robots", "1", "--faults", "router", "no odometry"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "bench", "soak", *words, "--work", str(tmp_path), "--json", str(out)],
        cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    from bench.harness.rows import Row

    rows = [Row.from_dict(values) for values in json.loads(out.read_text())]
    events = [row.details for row in rows if "recoveries" in row.details]
    assert len(events) >= 2
    assert {event["fault"] for event in events} == {"router killed, back after 3 s", "no odometry for 5 s"}
    assert all(event["recoveries"]["r1"] < 60 for event in events)
    assert all(row.holds for row in rows if row.holds is not None)
    assert set(tables(rows, None)) == {"faults", "held"}  # type: ignore[arg-type]
