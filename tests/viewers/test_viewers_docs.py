"""docs/viewers.md against the code: its commands parse, its program runs, its figures are those of the code."""

from __future__ import annotations

import builtins
import json
import re
import shlex
from importlib import resources
from pathlib import Path

import numpy as np
from fake_robot import KEYS, SHA, ns
from sockets import until

from coview_stream.basemap.summary import POINTS_ON_WIRE, MapView
from coview_stream.cli import build_parser
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.stream.transport import http_server, zenoh_transport
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.viewers import web_page, web_sink

PAGE = Path(__file__).resolve().parents[2] / "docs" / "viewers.md"
TEXT = PAGE.read_text(encoding="utf-8")


def test_documented_commands_parse():
    calls = re.findall(r"^coview-stream (.*?)(?: +#.*)?$", TEXT, re.MULTILINE)
    assert len(calls) >= 3
    for call in calls:
        build_parser().parse_args(shlex.split(call))


def test_documented_program_prints_poses(monkeypatch, capsys):
    net = MemoryTransport()
    monkeypatch.setattr(zenoh_transport, "open_client", lambda: net)

    def stream(prompt):
        pose = PoseMessage(ns(0.0), "r1", "TRACKING", np.eye(4), np.eye(6), 0.9, SHA)
        net.publish(Sample(KEYS.pose, encode_pose(pose, "json").payload, "application/json"))
        printed = []
        until(lambda: printed.append(capsys.readouterr().out) or "r1 [0. 0. 0.]" in "".join(printed))

    monkeypatch.setattr(builtins, "input", stream)
    code = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)[1]
    exec(compile(code, str(PAGE), "exec"), {})


def test_documented_figures_are_those_of_the_code():
    for figure in (
        web_page.WEB_ADDRESS,
        f"At most {web_sink.MAX_PAGES} pages and {http_server._MAX_CONNECTIONS}\nconnections",
        f"up to {web_sink._TRAIL:,} points",
        f"{POINTS_ON_WIRE:,} points",
        "nothing for four seconds" if http_server._SEND_TIMEOUT == 4.0 else "?",
    ):
        assert figure in TEXT, figure
    folder = resources.files("coview_stream.viewers") / "web"
    scripts = sum(len((folder / name).read_bytes()) for name in web_page._FILES if name.endswith(".js"))
    assert abs(scripts - 35_000) < 3_000  # "35 kB of scripts"


def test_a_view_on_the_wire_is_as_large_as_documented():
    points = np.random.default_rng(1).uniform(-500.0, 500.0, (POINTS_ON_WIRE, 3)).astype(np.float32)
    view = MapView(np.zeros(3), points, np.ones(len(points), dtype=bool), None, SHA)
    assert 0.75e6 < len(json.dumps(view.to_json())) < 0.85e6  # "up to 0.8 MB"
