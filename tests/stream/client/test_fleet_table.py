"""The table of robots: its cells, and when they become empty. The tests set the time."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from coview_stream.errors import MessageError, printable
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import decode_pose, encode_pose
from coview_stream.messages.json_messages import pose_record, read_status
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.stream.client.fleet_table import MAX_ROBOTS, SILENT, STALE, FleetTable

T = pose_from(rot_z(math.radians(30)), [412_000.123, 5_318_000.456, 7.891])
LEVEL = ProtectionLevel(0.347, 1.0, 0.2, 0.1)
POSE = PoseMessage(5, "r1", "TRACKING", T, np.eye(6), 0.93, "ab", 0.12, protection=LEVEL)
STATUS = {
    "state": "TRACKING",
    "reason": "all well",
    "counters": {"dropped": 4},
    "latency_ms": {"p50": 31.4, "p95": 50, "p99": 88.6},
}


@pytest.fixture
def fleet():
    return FleetTable()


def test_tracking_robot_shows_its_pose(fleet):
    fleet.add_status("r1", STATUS, 9.0)
    for k in range(60):
        fleet.add_pose(POSE, 10.0 + 0.1 * k)
    header, line = fleet.table(15.9)
    assert header.split()[:6] == ["robot", "state", "x", "y", "z", "yaw"]
    assert line.split() == [
        *("r1", "TRACKING", "412000.12", "5318000.46", "7.89", "30.0"),
        *("0.20/0.10", "0.12", "10.0", "1", "in", "14", "31/89", "4", "all", "well"),
    ]


def test_pose_without_a_level_shows_none(fleet):
    fleet.add_pose(replace(POSE, protection=None), 9.0)
    assert fleet.table(9.1)[1].split()[5:8] == ["30.0", "-", "0.12"]


def test_reason_stands_whole_below_its_robot_on_a_terminal(fleet):
    reason = (
        "the right place would be told by more of what stands around, and so far " + 8 * "there is too little of it "
    )
    for robot in ("r1", "r2"):
        fleet.add_status(robot, {**STATUS, "state": "SEARCHING", "reason": reason}, 9.0)
    for width in (60, 80, 130):
        lines = fleet.table(9.1, width=width)
        assert all(len(line) <= width for line in lines)
        first, second = (k for k, line in enumerate(lines) if line.startswith(("r1", "r2")))
        below = lines[first + 1 : second]
        assert " ".join(line.strip() for line in below) == reason.strip()
        assert all(line.startswith("    ") for line in below)


def test_what_the_node_says_of_the_sensor_stands_behind_the_reason(fleet):
    says = "sensor leans 2.9 deg in pitch: corrected; set --mount=0,2.9,0,0,0,0 to silence this"
    fleet.add_status("r1", {**STATUS, "calibration": {"says": [says, "b\x1b[2J"]}}, 9.0)
    assert fleet.table(9.1)[1].endswith(f"all well; {says}; b [2J")
    for odd in (None, 5, {"says": "x"}, {"says": None}, {}):
        fleet.add_status("r1", {**STATUS, "calibration": odd}, 9.0)
        assert fleet.table(9.1)[1].endswith("all well")


def test_lost_robot_shows_no_pose_and_none_that_is_stale(fleet):
    fleet.add_pose(POSE, 10.0)
    fleet.add_status("r1", {"state": "LOST"}, 10.1)
    assert fleet.table(10.2)[1].split()[:3] == ["r1", "LOST", "-"]
    fleet.add_pose(POSE, 10.3)  # found again; the status that says so comes later
    assert "412000.12" in fleet.table(10.3 + STALE - 0.1)[1]
    assert "412000.12" not in fleet.table(10.3 + STALE + 0.1)[1]


def test_silent_robot_is_marked(fleet):
    fleet.add_status("r1", STATUS, 10.0)
    assert "TRACKING" in fleet.table(10.0 + SILENT)[1]
    assert "silent 7 s" in fleet.table(17.2)[1]


@pytest.mark.parametrize(
    "status",
    [
        {},
        {"state": None, "counters": 3, "latency_ms": []},
        {"state": 5, "counters": {"dropped": "x"}, "latency_ms": {"p50": None, "p99": 10**400}},
        {"reason": {"deep": [1]}},
    ],
)
def test_any_status_is_printable(fleet, status):
    fleet.add_status("r1", status, 1.0)
    assert fleet.table(1.5)[1].startswith("r1 ")


def test_robots_that_strangers_invent_are_bounded_and_those_heard_stay(fleet):
    for number in range(3 * MAX_ROBOTS):
        fleet.add_status(f"x{number}", {}, 1.0)
        if number % 100 == 0:
            fleet.add_pose(POSE, 1.0)
    assert len(fleet.views) == MAX_ROBOTS
    assert "r1" in fleet.views


def test_poses_that_nobody_draws_are_bounded(fleet):
    for number in range(5000):
        fleet.add_pose(POSE, 1.0 + 0.1 * number)
    assert len(fleet.views["r1"].arrivals) < 2000


def test_robots_are_sorted_and_network_text_is_escaped(fleet):
    fleet.add_status("zoe", {"state": "\x1b[2JSEARCHING\n", "reason": "a\tb"}, 1.0)
    fleet.add_status("ada", {}, 1.0)
    lines = fleet.table(1.0, header=False)
    assert [line.split()[0] for line in lines] == ["ada", "zoe"]
    assert printable("a\x1b[2J\nb") == "a [2J b"
    assert all(line.isprintable() for line in lines)


def test_a_pose_without_confidence_shows_none(fleet):
    message = decode_pose(Sample("k", encode_pose(POSE, "foxglove").payload), hint="foxglove")
    fleet.add_pose(PoseMessage(**{**vars(message), "robot": "r1"}), 1.0)
    assert fleet.table(1.1)[1].split()[-4:] == ["0.0", "-", "-/-", "-"]


@pytest.mark.parametrize(
    ("confidence", "cell"),
    [
        (1.0 - 1e-4, "  1 in 10,000  "),
        (1.0 - 1 / 612_345, "  1 in 610,000  "),
        (1.0 - 1e-7, "  <1 in 1,000,000  "),
        (1.0, "  <1 in 1,000,000  "),
        (0.3, "  likely  "),
        (1.5, "  -  "),
        (-1e300, "  -  "),
    ],
)
def test_probability_of_a_wrong_place_is_said_as_one_in_so_many(fleet, confidence, cell):
    fleet.add_pose(replace(POSE, confidence=confidence), 1.0)
    title, line = fleet.table(1.1)
    assert cell in line
    assert title.index("wrong") + len("wrong") == line.index(cell) + len(cell) - 2


@pytest.mark.parametrize("name", ["json", "cdr", "foxglove", "keelson"])
def test_pose_records_have_the_same_fields_in_every_format(name):
    encoded = encode_pose(POSE, name)
    sample = Sample("k", encoded.payload, encoded.encoding)
    record = pose_record(decode_pose(sample), sample)
    native = json.loads(encode_pose(POSE, "json").payload)
    assert set(record) == set(native)
    assert record["position"] == pytest.approx(native["position"])
    assert record["stamp_ns"] == 5
    json.dumps(record, allow_nan=False)
    assert record["confidence"] == (0.93 if name == "json" else None)
    assert (record["covariance"] is None) is (name in ("foxglove", "keelson"))


def test_unknown_json_fields_are_passed_on():
    payload = json.dumps({**json.loads(encode_pose(POSE, "json").payload), "new": 1}).encode()
    assert pose_record(POSE, Sample("k", payload))["new"] == 1


@pytest.mark.parametrize("payload", [b"", b"[]", b"3", b"{", b"\xff", b'{"a": NaN}', b"[" * 100_000])
def test_status_that_is_not_json_is_refused(payload):
    with pytest.raises(MessageError, match="the status is not a JSON"):
        read_status(Sample("coview/r1/out/status", payload))


def test_another_node_that_serves_the_robot_is_told(fleet):
    fleet.add_status("r1", STATUS, 8.0)
    fleet.add_status("r1", STATUS | {"node": {"id": "abc", "host": "one"}}, 9.0)
    assert "node" not in fleet.table(9.1)[1]
    fleet.add_status("r1", STATUS | {"node": {"id": "def", "host": "two\n"}}, 10.0)
    fleet.add_status("r1", STATUS | {"node": {"id": "def", "host": "two\n"}}, 11.0)
    assert fleet.table(11.1)[1].endswith("all well; served by node def on two  now")
    fleet.add_status("r1", STATUS | {"node": 7}, 12.0)
    fleet.table(12.1)
