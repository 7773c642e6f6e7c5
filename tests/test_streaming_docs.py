"""docs/streaming.md against the code: keys, encodings, counters, layouts and the client's five lines."""

from __future__ import annotations

import math
import re
import shlex
from pathlib import Path

import numpy as np

from coview_stream.cli import build_parser
from coview_stream.config import AcceptanceConfig
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.localization import localizer
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search import global_search
from coview_stream.localization.state import State
from coview_stream.localization.tracking import monitor
from coview_stream.messages import decode_cloud, decode_odometry, decode_pose, encode_pose
from coview_stream.messages.json_messages import pose_record
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.odometry import buffer
from coview_stream.stream.client import client
from coview_stream.stream.node import (
    engine_process,
    engine_queue,
    engines,
    frame_sync,
    node,
    robot_state,
    session,
    worker,
)
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.robot_state import Transition
from coview_stream.stream.transport import zenoh_io, zenoh_transport
from coview_stream.stream.transport.keys import PRESETS, robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport

DOCS = Path(__file__).resolve().parents[1] / "docs"
TEXT = (DOCS / "streaming.md").read_text(encoding="utf-8")


def section(title):
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", TEXT, re.MULTILINE | re.DOTALL)[1]


def test_docs_list_every_preset_and_its_keys():
    keys = section("Keys and encodings")
    for name, preset in PRESETS.items():
        assert f"`{name}`" in keys
        for key in (preset.cloud, preset.odometry, preset.pose):
            assert f"`{key}`" in keys
    native = robot_keys("native", "{base}", "{robot}")
    for key in (native.status, native.alive, native.relocalize, native.reset):
        assert f"`{key}`" in keys


def test_figure_of_the_way_names_existing_functions():
    figure = re.search(r"```text\n(.*?)```", section("The way of one cloud"), re.DOTALL)[1]
    owners = (
        zenoh_transport, zenoh_io, node, session, frame_sync, buffer, engine_queue, engine_process, engines,
        worker, localizer, global_search, robot_state,
    )  # fmt: skip
    named = re.findall(r"\b(\w+)\.(\w+)\b", figure)
    assert len(named) > 20
    for owner, name in named:
        homes = [getattr(m, owner) for m in owners if hasattr(m, owner)]
        homes += [m for m in owners if m.__name__.endswith(f".{owner}")]
        assert any(hasattr(home, name) for home in homes), f"{owner}.{name}"


def test_docs_list_every_counter():
    named = set(re.findall(r"`([a-z_]+)`", section("What the counters mean")))
    counters = set(Counters().to_json())
    assert counters <= named
    assert named - counters == {
        "counters", "errors", "latency_ms", "engine_ms", "longest_wait_s", "longest_search_wait_s",
        "node", "id", "host", "term", "period_s", "ending",
    }  # fmt: skip


def test_docs_state_doubted_duration_and_exits():
    rule, words = AcceptanceConfig(), {5.0: "five"}
    rows = re.findall(r"^\|.*AMBIGUOUS.*\|$", section("How the node behaves"), re.MULTILINE)
    doubted, odometry, blind = rows[:3]
    assert "`--risk`" in doubted
    assert f"{words[rule.max_doubt_s]} seconds of doubt" in doubted
    assert "more probably wrong than right" in doubted
    assert "contradicts odometry" in odometry
    assert f"goes on for {rule.max_blind_s:.0f} s without a pose" in blind


def test_docs_of_tracking_state_the_priors_and_limits():
    text, rule = (DOCS / "tracking.md").read_text(encoding="utf-8"), AcceptanceConfig()
    told = " ".join(text.split("## States and reasons")[1].split("\n## ")[0].split())
    assert f"grow by {monitor.PER_METRE:.0e} ".replace("e-05", "e-5") in told
    assert f"by {monitor._PER_SECOND:.0e} with each second of doubt".replace("e-04", "e-4") in told
    words = {5: "five", 10: "ten"}
    assert f"for {words[round(rule.risk / monitor.PER_METRE)]} metres at most" in told
    assert f"{words[round(rule.max_doubt_s)]} seconds of doubt" in told
    assert f"after 30 s an L of {math.log(30 * monitor._PER_SECOND / rule.risk):.1f}" in told
    assert f"lean by more than {math.degrees(rule.max_tilt):.0f} degrees" in told
    assert f"must be below {rule.max_innovation:.0f}" in told
    assert f"less than {monitor._OFF_MAP:.0%}".replace("%", " %") in told


def test_docs_list_every_transition_field():
    told = re.search(r"^`transitions` in the status.*?\n\n", TEXT, re.MULTILINE | re.DOTALL)[0]
    for name in Transition(1, None, State.TRACKING, State.LOST, "", None).to_json():
        assert f"`{name}`" in told


def test_docs_list_every_evidence_field():
    text = (DOCS / "method.md").read_text(encoding="utf-8")
    table = text.split("## Fields of the evidence")[1].split("\n## ")[0]
    named = [name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(KeyframeEvidence(0.0, State.LOST, "").to_json())
    assert f"above {AcceptanceConfig().max_innovation:.0f} it is rejected" in table
    assert "(method.md#fields-of-the-evidence)" in TEXT


def test_documented_layouts_match_codecs():
    encoding = re.search(r'z_encoding_from_str\(&encoding, "(.*?)"\)', TEXT)[1]
    rows = np.arange(6, dtype="<f4").tobytes()
    message = decode_cloud(Sample("k", rows, encoding, (5).to_bytes(8, "little", signed=True)))
    assert message.stamp_ns == 5
    assert message.points.tolist() == [[0, 1, 2], [3, 4, 5]]
    odometry = re.search(r"```json\n(.*?)```", TEXT, re.DOTALL)[1]
    assert decode_odometry(Sample("k", odometry.encode(), "application/json")).T_odom_body[0, 3] == 1.5


def test_documented_encodings_match_codecs():
    pose = PoseMessage(1, "r", "TRACKING", np.eye(4), np.eye(6), 0.5, "ab" * 32)
    for name in ("json", "cdr", "foxglove"):
        assert f"`{encode_pose(pose, name).encoding}`" in TEXT
    assert f"`serve --pose-encoding cdr` ({len(encode_pose(pose, 'cdr').payload)} bytes)" in TEXT


def test_documented_fields_missing_in_smaller_pose_formats():
    full = PoseMessage(1, "r", "TRACKING", np.eye(4), np.eye(6), 0.5, "ab" * 32, 0.25, "map", ProtectionLevel(0.1, 1.0))
    missing = {}
    for name in ("cdr", "foxglove"):
        encoded = encode_pose(full, name)
        record = pose_record(decode_pose(Sample("k", encoded.payload, encoded.encoding)), Sample("k", encoded.payload))
        missing[name] = {field for field, value in record.items() if not value} | {"state"}
    assert missing["cdr"] == {"robot", "state", "confidence", "map_sha256", "age_s", "protection_level", "T_map_odom"}
    assert missing["foxglove"] == missing["cdr"] | {"covariance"}
    said = re.search(r"These leave out .*?`covariance`", TEXT, re.DOTALL)[0]
    assert set(re.findall(r"`(\w+)`", said)) == missing["foxglove"]


def test_documented_client_example_runs(monkeypatch, capsys):
    net = MemoryTransport()
    monkeypatch.setattr(client, "open_client", lambda *endpoints, **options: net)

    def answer(sample):
        pose = PoseMessage(decode_cloud(sample).stamp_ns, "rover1", "TRACKING", np.eye(4), np.eye(6), 0.5, "ab")
        net.publish(Sample("coview/rover1/out/pose", encode_pose(pose, "json").payload))

    net.subscribe("coview/rover1/in/cloud", answer, "newest")
    code = re.search(r"<!-- client -->\n```python\n(.*?)```\n<!-- end -->", TEXT, re.DOTALL)[1]
    names = {"T_odom_body": np.eye(4), "points": np.ones((3, 3)), "stamp": 2.5}
    exec(compile(code.replace("timeout=1.0", "timeout=0"), "docs/streaming.md", "exec"), names)
    assert capsys.readouterr().out.startswith("2500000000 [[1.")
    assert net.closed  # a client closes what it opened


def test_documented_commands_parse():
    block = re.search(r"```bash\n(.*?)```", section("Quick start"), re.DOTALL)[1]
    calls = [line.split("#")[0].split("coview-stream ")[1] for line in block.splitlines()]
    assert len(calls) == 4
    for call in calls:
        build_parser().parse_args(shlex.split(call))
