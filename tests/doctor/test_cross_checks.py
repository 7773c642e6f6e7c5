"""Clouds and odometry beside each other, and the node beside both."""

from __future__ import annotations

import numpy as np
import pytest
from captured_robot import SWEEP, capture, cloud, ns, odometry, steps, usual

from coview_stream import __version__
from coview_stream.doctor.robot_checks import cross_findings, node_finding
from coview_stream.geometry.transforms import pose_from

SHA = "ab" * 32
STATUS = {
    "state": "TRACKING",
    "reason": "verified",
    "version": __version__,
    "map_sha256": SHA,
    "stamp_ns": ns(0),
    "errors": [],
}


def found_of(robot):
    return {f.what: f for f in cross_findings(robot)}


def test_same_clock_and_all_frames_paired_is_ok():
    found = found_of(usual(times=np.linspace(0.0, 0.1, len(SWEEP))))
    assert [f.verdict for f in found.values()] == ["ok", "ok"]
    assert "27 of 27" in found["pairing"].found


def test_no_cross_checks_without_clouds_or_odometry():
    assert found_of(capture()) == {}
    assert found_of(capture(clouds=[(0.0, cloud(0.0))])) == {}


@pytest.mark.parametrize(
    ("shifts", "part", "remedy"),
    [
        ((1.0 - ns(0) * 1e-9, 0.0), "1.7e+09 s ahead of", "from 1970"),
        ((0.0, 1.0 - ns(0) * 1e-9), "1.7e+09 s behind", "from 1970"),
        ((0.0, 37.0), "37.05 s ahead", "TAI"),
        ((18.0, 0.0), "17.95 s behind", "GPS"),
        ((0.0, 9.5), "9.55 s ahead", "one clock"),
        ((1.0, 0.0), "0.95 s behind", "one clock"),
    ],
)
def test_different_clocks_are_reported(shifts, part, remedy):
    found = found_of(usual(*shifts))
    assert found.keys() == {"one clock"}  # pairing could only repeat it
    assert found["one clock"].verdict == "FAIL"
    assert part in found["one clock"].found
    assert remedy in found["one clock"].remedy


def test_slow_driver_is_a_warning_but_frames_are_paired():
    found = found_of(usual(cloud_shift=-1.5))
    assert found["one clock"].verdict == "warn"
    assert found["pairing"].verdict == "ok"


def test_sparse_odometry_pairs_no_frames():
    robot = capture([(t, cloud(t)) for t in steps(10)], [(t, odometry(t)) for t in (0.0, 0.9, 1.8, 2.7)])
    found = found_of(robot)["pairing"]
    assert found.verdict == "FAIL"
    assert "no_odometry" in found.found


def test_odometry_jumps_are_reported():
    places = [pose_from(np.eye(3), [40.0 * (k % 10 == 9), 0.0, 0.0]) for k in range(150)]
    pairs = [(k / 50, odometry(k / 50, T)) for k, T in enumerate(places)]
    found = found_of(capture([(t, cloud(t)) for t in steps(10)], pairs))["pairing"]
    assert found.verdict == "FAIL"
    assert "jumps" in found.found


def test_too_short_capture_gives_no_cross_checks():
    found = found_of(capture([(2.9, cloud(2.9))], [(t, odometry(t)) for t in steps(50)]))["pairing"]
    assert found.verdict == "warn"
    assert "--seconds" in found.remedy


@pytest.mark.parametrize(
    ("status", "alive", "verdict", "part"),
    [
        (STATUS, True, "ok", "TRACKING: verified"),
        (None, False, "warn", "none is running"),
        (None, True, "warn", "says nothing"),
        (STATUS, False, "warn", "no liveliness token"),
        (STATUS | {"map_sha256": "cd" * 32}, True, "FAIL", "not abababababab"),
        (STATUS | {"version": "9.9"}, True, "warn", f"here {__version__}"),
        (STATUS | {"stamp_ns": ns(-60)}, True, "warn", "60.00 s old"),
        (STATUS | {"errors": ["bad", "worse"]}, True, "warn", "reports: worse"),
        ({"state": 7, "errors": "x"}, True, "FAIL", "7: no reason given"),
    ],
)
def test_node_status_finding(status, alive, verdict, part):
    found = node_finding(capture(status=status, alive=alive), SHA, ns(0))
    assert found.verdict == verdict
    assert part in found.found


def test_who_serves_the_robot_is_told():
    robot = capture(status=STATUS, alive=True)
    robot.servers = {"abc on machine-7"}
    found = node_finding(robot, SHA, ns(0))
    assert found.verdict == "ok"
    assert "node abc on machine-7" in found.found
    robot.servers |= {"def"}
    found = node_finding(robot, SHA, ns(0))
    assert found.verdict == "warn"
    assert "abc on machine-7, def publish" in found.found
