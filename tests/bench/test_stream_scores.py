"""The streaming benchmark scores as it says; no sockets, no clock."""

import itertools
import json
import struct

import numpy as np
import pytest

from bench.stream import drive as stream_drive
from bench.stream import rogue as stream_rogue
from bench.stream import scores as stream_scores
from bench.stream import wire as stream_wire
from bench.stream.drive import EPOCH_NS, FAR_FUTURE, RESTARTED, Drive, Phase, RobotPlan, schedule, stamp_of
from bench.stream.scores import Posed, Told
from coview_stream.clouds import write_tum
from coview_stream.geometry.transforms import pose_from, rot_z

SECOND = 10**9


def posed(arrival, stamp_ns=0, T=None, age=None):
    return Posed(arrival, stamp_ns, np.eye(4) if T is None else T, age)


def told(arrival, state="TRACKING", **fields):
    return Told(arrival, {"state": state, **fields})


@pytest.mark.parametrize(
    ("shift", "degrees", "count"),
    [(1.99, 0.0, 0), (2.01, 0.0, 1), (0.0, 4.9, 0), (0.0, 5.1, 1), (0.0, -5.1, 1), (np.nan, 0.0, 1)],
)
def test_a_pose_is_false_beyond_two_metres_or_five_degrees(shift, degrees, count):
    true = pose_from(rot_z(1.0), [100.0, -50.0, 3.0])
    wrong = true @ pose_from(rot_z(np.radians(degrees)), [0.0, shift, 0.0])
    metres, turned = stream_scores.errors([posed(0.0, 7, wrong)], lambda stamp: {7: true}[stamp])
    assert stream_scores.false_poses(metres, turned) == count
    if shift == 1.99:
        assert metres[0] == pytest.approx(1.99)
    if degrees == 4.9:
        assert turned[0] == pytest.approx(4.9)


def test_intervals_count_unless_the_robot_was_known_to_be_untracked():
    arrivals = [0.0, 0.1, 0.2, 3.0, 3.1, 4.6]
    everything = stream_scores.tracking_intervals(arrivals, [told(0.15), told(3.5)])
    np.testing.assert_allclose(everything, [0.1, 0.1, 2.8, 0.1, 1.5])
    known = stream_scores.tracking_intervals(arrivals, [told(0.15), told(1.0, "LOST"), told(2.9)])
    np.testing.assert_allclose(known, [0.1, 0.1, 0.1, 1.5])
    without = stream_scores.tracking_intervals(arrivals, [], [(4.0, 4.2)])
    np.testing.assert_allclose(without, [0.1, 0.1, 2.8, 0.1])
    assert stream_scores.rate_hz(known[:3]) == pytest.approx(10.0)
    assert stream_scores.rate_hz(np.array([0.2, 0.3])) == pytest.approx(4.0)
    assert stream_scores.rate_hz(np.array([])) is None


def test_jitter_is_the_distance_from_the_period_either_way():
    intervals = np.array([0.1] * 98 + [0.06, 0.14])
    p50, p99 = stream_scores.jitter_ms(intervals)
    assert p50 == pytest.approx(0.0, abs=1e-9)
    assert p99 == pytest.approx(40.0)
    assert stream_scores.jitter_ms(np.array([])) is None


def test_what_goes_back_and_what_is_silent():
    assert stream_scores.steps_back([1, 2, 2, 5, 4, 6, 1]) == 2
    assert stream_scores.share_posed([0.05, 0.1, 0.65], 0.0, 1.0) == pytest.approx(0.4)
    assert stream_scores.share_posed([5.0], 0.0, 1.0) == 0.0
    assert stream_scores.longest_silence([0.5, 9.0, 9.5], 0.0, 10.0) == pytest.approx(8.5)
    assert stream_scores.longest_silence([], 2.0, 5.0) == pytest.approx(3.0)


def test_fairness():
    assert stream_scores.jain([3.0, 3.0, 3.0]) == pytest.approx(1.0)
    assert stream_scores.jain([1.0, 0.0, 0.0, 0.0]) == pytest.approx(0.25)
    assert stream_scores.jain([0.0, 0.0]) == 0.0


def test_reactions_and_staleness_are_counted_from_the_put_of_the_frame():
    puts = np.array([[EPOCH_NS + k * SECOND / 10, 50.0 + k / 10] for k in range(20)])
    stamp = EPOCH_NS + 3 * SECOND / 10
    seen = [(50.35, stamp + 1000), (50.45, stamp), (50.9, stamp + 2e8), (51.0, EPOCH_NS + 5 * SECOND)]
    np.testing.assert_allclose(stream_scores.reaction(puts, seen), [0.05, 0.4])
    np.testing.assert_allclose(stream_scores.staleness(puts, seen), [0.05, 0.15, 0.4])
    assert stream_scores.staleness(np.zeros((0, 2)), seen).size == 0
    assert stream_scores.put_time(puts[:1], puts[0, 0]) == 50.0


def test_statuses_and_ages_name_frames():
    assert stream_scores.corrected([posed(1.0, 5 * SECOND, age=0.25), posed(2.0)]) == [(1.0, 4.75e9)]
    rows = [
        told(1.0, last_frame_ns=7),
        told(2.0),
        told(3.0, last_frame_ns=None),
        told(4.0, counters={"dropped": 3}),
    ]
    assert stream_scores.processed(rows) == [(1.0, 7.0)]
    assert stream_scores.counter(rows, "dropped") == 3
    assert stream_scores.counter([*rows, told(5.0)], "dropped") == 3
    assert stream_scores.counter(rows, "late") is None


def test_every_scenario_exists():
    pytest.importorskip("psutil", reason="the benchmark watches the node with psutil: extra bench")
    from bench.stream import stream

    for name in stream.SCENARIOS:
        assert stream.scenario(name).__name__ == name


def messages(plan, kind):
    return [(due, content, claimed) for due, what, content, claimed in schedule(plan) if what == kind]


def test_a_plain_schedule_has_odometry_before_each_cloud():
    plan = RobotPlan("r1", 1.0)
    rows = list(schedule(plan))
    assert len(messages(plan, "cloud")) == 10
    assert len(messages(plan, "odometry")) == 50
    assert all(due == content == claimed for due, _, content, claimed in rows)
    for before, row in itertools.pairwise(rows):
        if row[1] == "cloud":
            assert before[1] == "odometry"
            assert stamp_of(before[3]) == stamp_of(row[3])


@pytest.mark.parametrize(
    ("what", "clouds"),
    [
        ("no_clouds", [0.1, 0.4]),
        ("no_odometry", [0.1, 0.2, 0.3, 0.4]),
        ("twice", [0.1, 0.2, 0.2, 0.3, 0.3, 0.4]),
        ("late", [0.1, 0.2, -0.3, 0.3, -0.2, 0.4]),
        ("reversed", [0.1, 0.2, 0.1, 0.4]),
        ("future", [0.1, 0.2 + FAR_FUTURE, 0.2, 0.3, 0.4]),
        ("restart", [0.1, 0.2 - RESTARTED, 0.3 - RESTARTED, 0.4]),
    ],
)
def test_phases_spoil_what_they_say(what, clouds):
    plan = RobotPlan("r1", 0.5, phases=(Phase(0.2, 0.4, what),))
    assert [claimed for *_, claimed in messages(plan, "cloud")[1:]] == pytest.approx(clouds)
    inside = [due for due, *_ in messages(plan, "odometry") if 0.2 <= due < 0.4]
    assert bool(inside) is (what != "no_odometry")


def test_a_flood_begins_late_and_has_no_odometry():
    flood = RobotPlan("r1", 1.0, begin=0.5, cloud_period=0.01, odometry_period=0.0)
    rows = list(schedule(flood))
    assert len(rows) == 50
    assert rows[0][0] == 0.5


def test_stamps_go_there_and_back():
    assert stamp_of(0.1) == EPOCH_NS + 100_000_000
    assert stream_drive.content_of(stamp_of(12.34)) == pytest.approx(12.34, abs=1e-6)
    assert stream_drive.content_of(stamp_of(12.34 - RESTARTED)) == pytest.approx(12.34, abs=1e-6)


@pytest.fixture
def world(tmp_path):
    frames = tmp_path / "run" / "frames"
    frames.mkdir(parents=True)
    stamps = 1000.0 + np.arange(5) / 10
    poses = np.stack([pose_from(rot_z(0.2 * k), [2.0 * k, 0.0, 0.0]) for k in range(5)])
    for k in range(5):
        np.save(frames / f"{k:06d}.npy", np.full((3, 3), k, np.float32))
    write_tum(tmp_path / "run" / "odometry.tum", stamps, poses)
    write_tum(tmp_path / "truth.tum", stamps, poses)
    return tmp_path


def test_a_drive_goes_forth_and_back(world):
    drive = Drive(world, "r1")
    assert [drive.cloud(k / 10)[0, 0] for k in range(10)] == [0, 1, 2, 3, 4, 3, 2, 1, 0, 1]
    np.testing.assert_allclose(drive.truth(stamp_of(0.15))[:3, 3], [3.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(drive.truth(stamp_of(0.15))[:3, :3], rot_z(0.3), atol=1e-6)
    np.testing.assert_allclose(drive.T_odom_body(0.65), drive.T_odom_body(0.15), atol=1e-6)
    assert drive.metres(0.25) == pytest.approx(5.0)
    assert Drive(world, "r1", 0.05).metres(0.125) == pytest.approx(5.0)
    assert drive.cloud(0.2, points=50).shape == (50, 3)
    assert Drive(world, "r2").metres(0.0) == 0.0


def test_a_strangers_messages_have_the_documented_bytes():
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32)
    payload, encoding, attachment = stream_wire.raw_cloud(points, 5)
    assert payload == struct.pack("<6f", 1, 2, 3, 4, 5, 6)
    assert (encoding, attachment) == ("application/octet-stream;layout=xyz", b"\5" + b"\0" * 7)
    message = stream_wire.typestore().deserialize_cdr(
        stream_wire.cdr_cloud(points, 3 * SECOND + 4)[0], "sensor_msgs/msg/PointCloud2"
    )
    assert (message.width, message.point_step, message.header.stamp.nanosec) == (2, 16, 4)
    told = json.loads(stream_wire.json_odometry(np.eye(4), 9)[0])
    assert told == {"stamp_ns": 9, "position": [0.0, 0.0, 0.0], "orientation": [0.0, 0.0, 0.0, 1.0]}


def test_poses_are_read_in_every_format():
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

    T = pose_from(rot_z(0.5), [1.0, 2.0, 3.0])
    payload, *_ = stream_wire.json_odometry(T, 11)
    read = stream_wire.read_pose(
        json.dumps({**json.loads(payload), "age_s": 0.2}).encode(), "application/json", 1.0
    )
    np.testing.assert_allclose(read.T_map_body, T, atol=1e-12)
    assert (read.stamp_ns, read.age, read.arrival) == (11, 0.2, 1.0)
    message = PoseInFrame()
    message.timestamp.FromNanoseconds(12)
    message.pose.orientation.w, message.pose.position.x = 1.0, 4.0
    read = stream_wire.read_pose(
        message.SerializeToString(), "application/protobuf;foxglove.PoseInFrame", 1.0
    )
    assert (read.stamp_ns, read.T_map_body[0, 3], read.age) == (12, 4.0, None)
    types, name = stream_wire.typestore().types, "geometry_msgs/msg/PoseWithCovariance"
    odometry, *_ = stream_wire.cdr_odometry(T, 13)
    pose = stream_wire.typestore().deserialize_cdr(odometry, "nav_msgs/msg/Odometry")
    stamped = types[f"{name}Stamped"](pose.header, types[name](pose.pose.pose, np.zeros(36)))
    payload = bytes(stream_wire.typestore().serialize_cdr(stamped, stamped.__msgtype__))
    read = stream_wire.read_pose(payload, "application/cdr;geometry_msgs/msg/PoseWithCovarianceStamped", 1.0)
    np.testing.assert_allclose(read.T_map_body, T, atol=1e-12)
    assert read.stamp_ns == 13
    types, name = stream_wire.typestore().types, "geometry_msgs/msg/PoseWithCovariance"
    odometry, *_ = stream_wire.cdr_odometry(T, 13)
    pose = stream_wire.typestore().deserialize_cdr(odometry, "nav_msgs/msg/Odometry")
    stamped = types[f"{name}Stamped"](pose.header, types[name](pose.pose.pose, np.zeros(36)))
    payload = bytes(stream_wire.typestore().serialize_cdr(stamped, stamped.__msgtype__))
    read = stream_wire.read_pose(payload, "application/cdr;geometry_msgs/msg/PoseWithCovarianceStamped", 1.0)
    np.testing.assert_allclose(read.T_map_body, T, atol=1e-12)
    assert read.stamp_ns == 13
    with pytest.raises(ValueError, match="text/plain"):
        stream_wire.read_pose(b"", "text/plain", 1.0)


def test_rubbish_is_varied_and_repeats_for_equal_seeds():
    some = list(itertools.islice(stream_rogue.rubbish(1), 400))
    assert some == list(itertools.islice(stream_rogue.rubbish(1), 400))
    assert max(len(payload) for payload, *_ in some) == 1 << 20
    assert len({encoding for _, encoding, _ in some}) > 20
    assert {None, 0, 8, 33} <= {None if a is None else len(a) for *_, a in some}
