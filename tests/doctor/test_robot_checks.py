"""Findings about one channel: what is usual is ok, and every fault has its own name and remedy."""

import numpy as np
import pytest
from captured_robot import KEYS, SWEEP, capture, cloud, ns, odometry, steps, usual
from scipy.spatial.transform import Rotation

from coview_stream import __version__
from coview_stream.doctor.capture import capture_cloud
from coview_stream.doctor.robot_checks import cloud_findings, cross_findings, node_finding, odometry_findings
from coview_stream.geometry.transforms import pose_from
from coview_stream.messages.types import Sample


def clouds_of(samples, period=0.1):
    received = capture([(k * period, sample) for k, sample in enumerate(samples)])
    return {f.what: f for f in cloud_findings(received, "")}


def odometry_of(pairs, seconds=3.0):
    return {f.what: f for f in odometry_findings(capture(odometry=pairs, seconds=seconds), "")}


def test_healthy_robot_is_ok():
    robot = usual(times=np.linspace(0.0, 0.1, len(SWEEP)))
    findings = [*cloud_findings(robot, ""), *odometry_findings(robot, "")]
    assert [f.what for f in findings] == ["clouds", "cloud stamps", "odometry", "odometry stamps", "gravity"]
    assert {(f.verdict, f.robot) for f in findings} == {("ok", "r1")}
    said = findings[0].found
    for part in ("10.0 Hz", "read as cdr", "sensor_msgs/msg/PointCloud2", "2000 points", "over 0.100 s"):
        assert part in said
    for part in ("50.0 Hz", "read as json", "moved 6.0 m"):
        assert part in findings[2].found


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_rows_of_float64_are_named():
    assert capture_cloud(Sample(KEYS.cloud, SWEEP.astype("<f8").tobytes(), "", bytes(8)), 0.0, "xyz").cloud is None

    def sent(kind):
        payload, encoding = SWEEP.astype(kind).tobytes(), "application/octet-stream;layout=xyz"
        stamps = [ns(0.1 * k).to_bytes(8, "little") for k in range(10)]
        return clouds_of([Sample(KEYS.cloud, payload, encoding, stamp) for stamp in stamps])["clouds"]

    assert sent("<f8").verdict == "FAIL"
    assert "10 of 10 make sense as float64 alone" in sent("<f8").found
    assert sent("<f8").remedy.startswith("send float32")
    assert sent("<f4").verdict == "ok"


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
        (Sample(KEYS.cloud, SWEEP.tobytes(), "application/octet-stream;layout=xyz"), "no stamp", "help wire"),
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
        ([k // 10 for k in range(30)], "FAIL", "27 stand still: all are whole seconds"),
        ([1e-9 * (k // 10) for k in range(30)], "FAIL", "run 6.9e-10 times as fast"),  # seconds for nanoseconds
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
    received = [(t + 0.05, cloud(t)) for t in steps(clouds)] if clouds else []
    robot = capture(received, [(t, odometry(t)) for t in steps(samples)])
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


SHA = "ab" * 32
STATUS = {"state": "TRACKING", "reason": "verified", "version": __version__, "map_sha256": SHA, "stamp_ns": ns(0)}


def found_of(robot):
    return {f.what: f for f in cross_findings(robot)}


def test_same_clock_and_all_frames_paired_is_ok():
    found = found_of(usual(times=np.linspace(0.0, 0.1, len(SWEEP))))
    assert [f.verdict for f in found.values()] == ["ok", "ok"]
    assert "27 of 27" in found["pairing"].found


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
    sparse = [(t, odometry(t)) for t in (0.0, 0.9, 1.8, 2.7)]
    found = found_of(capture([(t, cloud(t)) for t in steps(10)], sparse))["pairing"]
    assert (found.verdict, "no_odometry" in found.found) == ("FAIL", True)


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
        (STATUS | {"errors": []}, True, "ok", "TRACKING: verified"),
        (None, False, "warn", "none is running"),
        (None, True, "warn", "says nothing"),
        (STATUS, False, "warn", "no liveliness token"),
        (STATUS | {"map_sha256": "cd" * 32}, True, "FAIL", "not abababababab"),
        (STATUS | {"version": "9.9"}, True, "warn", f"here {__version__}"),
        (STATUS | {"stamp_ns": ns(-60)}, True, "warn", "60.00 s old"),
        (STATUS | {"errors": ["bad", "worse"]}, True, "warn", "reports: worse"),
        (STATUS | {"state": "LOST", "reason": "why"}, True, "warn", f"LOST: why; version {__version__}"),
        ({"state": 7, "errors": "x"}, True, "FAIL", "7: no reason given"),
    ],
)
def test_node_status_finding(status, alive, verdict, part):
    found = node_finding(capture(status=status, alive=alive), SHA)
    assert found.verdict == verdict
    assert part in found.found


def test_robots_that_nodes_serve_are_named_beside_a_wrong_name():
    found = node_finding(capture(), SHA, {"r3", "r2"})
    assert (found.verdict, found.found) == ("warn", "none serves it; nodes serve r2, r3")


def test_who_serves_the_robot_is_told():
    robot = capture(status=STATUS, alive=True)
    robot.servers = {"abc on machine-7"}
    found = node_finding(robot, SHA)
    assert found.verdict == "ok"
    assert "node abc on machine-7" in found.found
    robot.servers |= {"def"}
    found = node_finding(robot, SHA)
    assert found.verdict == "warn"
    assert "abc on machine-7, def publish" in found.found
