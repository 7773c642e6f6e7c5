"""Findings about one channel: what is usual is ok, and every fault has its own name and remedy."""

from __future__ import annotations

import numpy as np
import pytest
from captured_robot import KEYS, SWEEP, capture, cloud, ns, odometry, steps, usual
from scipy.spatial.transform import Rotation

from coview_stream.doctor.robot_checks import cloud_findings, odometry_findings
from coview_stream.geometry.transforms import pose_from
from coview_stream.messages.types import Sample


def clouds_of(samples, elsewhere="", period=0.1):
    received = capture([(k * period, sample) for k, sample in enumerate(samples)])
    return {f.what: f for f in cloud_findings(received, elsewhere)}


def odometry_of(pairs, seconds=3.0):
    return {f.what: f for f in odometry_findings(capture(odometry=pairs, seconds=seconds), "")}


def test_healthy_robot_is_ok():
    robot = usual(times=np.linspace(0.0, 0.1, len(SWEEP)))
    findings = [*cloud_findings(robot, ""), *odometry_findings(robot, "")]
    assert [(f.verdict, f.what) for f in findings] == [
        ("ok", "clouds"),
        ("ok", "cloud stamps"),
        ("ok", "odometry"),
        ("ok", "odometry stamps"),
        ("ok", "gravity"),
    ]
    assert {f.robot for f in findings} == {"r1"}
    said = findings[0].found
    for part in ("10.0 Hz", "read as cdr", "sensor_msgs/msg/PointCloud2", "2000 points", "over 0.100 s"):
        assert part in said
    assert "50.0 Hz" in findings[2].found
    assert "read as json" in findings[2].found
    assert "moved 6.0 m" in findings[2].found


def test_silent_channel_suggests_other_keys():
    found = clouds_of([], "clouds come on x: try y")
    assert found.keys() == {"clouds"}
    assert found["clouds"].verdict == "FAIL"
    assert KEYS.cloud in found["clouds"].found
    assert found["clouds"].remedy == "clouds come on x: try y"
    assert clouds_of([])["clouds"].remedy


def test_missing_odometry_is_ok_when_node_computes_it():
    silent = capture(odometry=[])
    (missing,) = odometry_findings(silent, "")
    assert missing.remedy.endswith("`serve --odometry kiss-icp`")
    silent.status = {"odometry": "kiss-icp"}
    (made,) = odometry_findings(silent, "odometry comes on x: try y")
    assert (made.verdict, made.what) == ("ok", "odometry")
    speaking = capture(odometry=[(t, odometry(t)) for t in steps(50)], status={"odometry": "kiss-icp"})
    (ignored,) = odometry_findings(speaking, "")
    assert ignored.verdict == "warn"
    assert "ignores the 150 samples" in ignored.found
    speaking.status = {"odometry": "robot"}
    assert [f.what for f in odometry_findings(speaking, "")] == ["odometry", "odometry stamps", "gravity"]


@pytest.mark.parametrize(
    ("sample", "reason", "remedy"),
    [
        (Sample(KEYS.cloud, b"\x93NUMPY", "application/x-npy"), "application/x-npy", "send one of xyz"),
        (Sample(KEYS.cloud, cloud(0.0).payload, "video/h264"), "video/h264", "--cloud-encoding cdr"),
        (Sample(KEYS.cloud, cloud(0, codec="foxglove").payload), "no encoding is set", "--cloud-encoding foxglove"),
        (Sample(KEYS.cloud, SWEEP.tobytes(), "", ns(0).to_bytes(8, "little")), "no encoding", "--cloud-encoding xyz"),
        (Sample(KEYS.cloud, SWEEP.tobytes(), "application/octet-stream;layout=xyz"), "no stamp", "wire.md"),
        (Sample(KEYS.cloud, bytes(17 << 20)), "bytes", "--max-payload"),
    ],
)
def test_unreadable_messages_fail_with_reason_and_remedy(sample, reason, remedy):
    found = clouds_of([sample] * 3)
    assert found.keys() == {"clouds"}
    assert found["clouds"].verdict == "FAIL"
    assert "3 of 3 cannot be read" in found["clouds"].found
    assert reason in found["clouds"].found
    assert remedy in found["clouds"].remedy


def test_few_bad_messages_among_good_ones_are_a_warning():
    samples = [cloud(t) for t in steps(10)]
    samples[4] = Sample(KEYS.cloud, b"rubbish", "application/cdr")
    received = capture([(k / 10, sample) for k, sample in enumerate(samples)])
    verdicts = [(f.verdict, f.what) for f in cloud_findings(received, "")]
    assert verdicts == [("warn", "clouds"), ("ok", "clouds"), ("ok", "cloud stamps")]


@pytest.mark.parametrize(
    ("points", "verdict", "part"),
    [
        (SWEEP * 1000, "warn", "metres"),
        (SWEEP / 1000, "warn", "metres"),
        (SWEEP[:50], "warn", "few points"),
        (np.full_like(SWEEP, np.nan), "FAIL", "no finite points"),
    ],
)
def test_implausible_point_clouds_are_reported(points, verdict, part):
    found = clouds_of([cloud(t, points) for t in steps(10)])["clouds"]
    assert found.verdict == verdict
    assert part in found.remedy


@pytest.mark.parametrize(("period", "part"), [(1.0, "few frames"), (0.01, "drops the rest")])
def test_cloud_rate_too_low_or_too_high_is_reported(period, part):
    found = clouds_of([cloud(k * period) for k in range(30)], period=period)["clouds"]
    assert found.verdict == "warn"
    assert part in found.remedy


@pytest.mark.parametrize(
    ("stamps", "verdict", "part"),
    [
        ([0.0] * 30, "FAIL", "all 30 are"),
        ([0.1 * k - (0.5 if k == 9 else 0.0) for k in range(30)], "warn", "1 go backwards"),
        ([0.1 * (k - k // 3) for k in range(30)], "warn", "9 stand still"),
        ([-0.1 * k for k in range(30)], "FAIL", "29 go backwards"),
        ([0.2 * k for k in range(30)], "warn", "run 2 times as fast"),
        ([1e-4 * k for k in range(30)], "FAIL", "run 0.001 times as fast"),  # microseconds for nanoseconds
    ],
)
def test_stamp_checks(stamps, verdict, part):
    found = clouds_of([cloud(t) for t in stamps])["cloud stamps"]
    assert found.verdict == verdict
    assert part in found.found
    assert found.remedy


def test_odometry_with_a_gap_or_low_rate_is_reported():
    pairs = [(t, odometry(t)) for t in steps(50)]
    assert odometry_of([p for p in pairs if not 1.0 < p[0] < 1.8])["odometry"].verdict == "FAIL"
    ended = odometry_of([p for p in pairs if p[0] < 2.0])["odometry"]
    assert ended.verdict == "FAIL"
    assert "a pause of 1.0 s" in ended.found
    assert odometry_of(pairs[::12])["odometry"].verdict == "warn"


@pytest.mark.parametrize(
    ("clouds", "samples", "verdict"),
    [(10, 10, "ok"), (5, 5, "ok"), (20, 10, "warn"), (10, 9.8, "ok"), (2, 4, "warn"), (0, 8, "ok")],
)
def test_one_odometry_sample_per_frame_is_enough(clouds, samples, verdict):
    robot = capture(
        [(t + 0.05, cloud(t)) for t in steps(clouds)] if clouds else [], [(t, odometry(t)) for t in steps(samples)]
    )
    found = next(f for f in odometry_findings(robot, "") if f.what == "odometry")
    assert found.verdict == verdict, found.line()
    assert ("more rarely than clouds (20.0 Hz)" in found.remedy) == (clouds == 20)


@pytest.mark.parametrize(
    ("degrees", "verdict", "part"),
    [(5, "ok", "tilt 5.0"), (30, "warn", "tilt 30.0"), (90, "FAIL", "tilt 90.0"), (0, "ok", "no roll and pitch")],
)
def test_odometry_tilt_against_gravity_is_reported(degrees, verdict, part):
    T = pose_from(Rotation.from_euler("x", degrees, degrees=True).as_matrix(), [0.0, 0.0, 0.0])
    found = odometry_of([(t, odometry(t, T)) for t in steps(50)])["gravity"]
    assert found.verdict == verdict
    assert part in found.found
