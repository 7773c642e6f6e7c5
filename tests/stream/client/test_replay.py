"""Replays: what is sent, when and in which order, on a clock of the test's own."""

import dataclasses
import shutil
from dataclasses import replace

import numpy as np
import pytest

from coview_stream.clouds.files import write_cloud
from coview_stream.clouds.trajectory import write_tum
from coview_stream.errors import CloudError, ConfigError
from coview_stream.geometry.transforms import pose_from, rot_z, yaw_of
from coview_stream.messages import decode_cloud, decode_odometry
from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Run
from coview_stream.stream.client.replay import ReplayConfig, enough_odometry, odometry_spacing, replay
from coview_stream.stream.client.sender import Sender, nanoseconds
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport

STAMPS = np.array([1000.0, 1000.1, 1000.2, 1000.35])
KEYS = robot_keys("native", "coview", "r1")


class TestClock:
    """Time passes only while somebody waits; the end comes at ``end`` seconds."""

    __test__ = False

    def __init__(self, end=np.inf):
        self.time, self.end = 50.0, 50.0 + end

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += max(0.0, seconds)
        return self.time >= self.end


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay") / "run"
    (folder / "frames").mkdir(parents=True)
    for k in range(4):
        write_cloud(folder / "frames" / f"{k:06d}.ply", np.full((5, 3), 1.0 + k, np.float32))
    poses = [pose_from(rot_z(0.2 * k), [k, 0, 0]) for k in range(4)]
    write_tum(folder / "odometry.tum", STAMPS, poses)
    return folder


@pytest.fixture
def run(run_folder):
    return open_run(run_folder)


def recorded(run, config, clock=None, **options):
    """(report, [(seconds after the first, key, decoded message)])."""
    net, clock = MemoryTransport(), clock or TestClock()
    sent = []
    net.subscribe(KEYS.cloud, lambda s: sent.append((clock.now() - 50.0, "cloud", decode_cloud(s))), "newest")
    net.subscribe(KEYS.odometry, lambda s: sent.append((clock.now() - 50.0, "odom", decode_odometry(s))), "all")
    report = replay(run, Sender(net, KEYS, **options), config, clock)
    assert net.raised == []
    return report, sent


def test_frames_are_sent_in_order_after_their_odometry(run):
    report, sent = recorded(run, ReplayConfig())
    assert [kind for _, kind, _ in sent] == ["odom", "cloud"] * 4
    for k, ((when, _, odom), (then, _, cloud)) in enumerate(zip(sent[::2], sent[1::2], strict=True)):
        assert when == then == pytest.approx(STAMPS[k] - STAMPS[0])
        assert odom.stamp_ns == cloud.stamp_ns == nanoseconds(STAMPS[k])
        assert odom.T_odom_body == pytest.approx(run.poses[k])
        assert cloud.points[0, 0] == 1.0 + k
    assert (report.frames, report.odometry, report.points, report.finished) == (4, 4, 20, True)
    assert report.seconds == pytest.approx(0.35)
    assert "4 frames (8.57 Hz) and 4 odometry samples sent in 0.4 s" in report.text()
    assert "put p50 0.0 ms" in report.text()


@pytest.mark.parametrize(
    ("options", "times"),
    [
        ({"speed": 2.0}, [0.0, 0.05, 0.1, 0.175]),
        ({"rate": 20.0}, [0.0, 0.05, 0.1, 0.15]),
        ({"rate": 2.0}, [0.0, 0.5, 1.0, 1.5]),
    ],
)
def test_speed_and_rate_change_deadlines_but_not_stamps(run, options, times):
    _, sent = recorded(run, ReplayConfig(**options))
    clouds = [(when, message) for when, kind, message in sent if kind == "cloud"]
    assert [when for when, _ in clouds] == pytest.approx(times)
    assert [m.stamp_ns for _, m in clouds] == [nanoseconds(s) for s in STAMPS]


def test_odometry_between_frames_is_interpolated(run):
    _, sent = recorded(run, ReplayConfig(odometry_rate=40.0))
    odometry = [(when, message) for when, kind, message in sent if kind == "odom"]
    assert len(odometry) == 4 + 3 + 3 + 5
    when, between = odometry[1]
    assert when == pytest.approx(0.025)
    assert between.stamp_ns == pytest.approx(nanoseconds(1000.025), abs=1000)
    assert between.T_odom_body[:3, 3] == pytest.approx([0.25, 0, 0])
    assert yaw_of(between.T_odom_body) == pytest.approx(0.05)
    stamps = [m.stamp_ns for _, m in odometry]
    assert stamps == sorted(set(stamps))
    assert len([1 for _, kind, _ in sent if kind == "cloud"]) == 4


def test_loop_restarts_the_run_with_increasing_stamps(run):
    report, sent = recorded(run, ReplayConfig(loop=True, odometry_rate=40.0), TestClock(end=0.72))
    assert not report.finished
    assert "ended early" in report.text()
    clouds = [(when, m) for when, kind, m in sent if kind == "cloud"]
    # a lap is 0.35 s and one usual period
    assert [when for when, _ in clouds] == pytest.approx([0, 0.1, 0.2, 0.35, 0.45, 0.55, 0.65])
    assert clouds[4][1].stamp_ns == pytest.approx(nanoseconds(1000.45), abs=1000)
    assert clouds[4][1].points[0, 0] == 1.0
    stamps = [m.stamp_ns for _, _, m in sent]
    assert stamps == sorted(stamps)
    # the way back from the end to the start was never driven, so nothing is sent for it
    assert not [when for when, kind, _ in sent if kind == "odom" and 0.36 < when < 0.44]


def test_slow_send_does_not_delay_later_deadlines(run):
    """A send that takes long delays what comes next, but not what comes after that."""
    clock, net = TestClock(), MemoryTransport()
    times = []

    def slow(sample):
        times.append(clock.now() - 50.0)
        clock.time += 0.17 if len(times) == 1 else 0.0

    net.subscribe(KEYS.cloud, slow, "newest")
    report = replay(run, Sender(net, KEYS), ReplayConfig(), clock)
    assert times == pytest.approx([0.0, 0.17, 0.2, 0.35])
    assert list(report.late_ms) == pytest.approx([0, 70, 0, 0], abs=1e-6)
    assert report.put_ms[0] == pytest.approx(170)
    assert "more than 20 ms late: 1 sample;" in report.text()


def test_damaged_frames_are_skipped_and_counted(run_folder, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    (folder / "frames" / "000001.ply").write_bytes(b"no cloud")
    report, sent = recorded(open_run(folder), ReplayConfig())
    assert [kind for _, kind, _ in sent] == ["odom", "cloud", "odom", "odom", "cloud", "odom", "cloud"]
    assert (report.frames, report.damaged) == (3, 1)
    assert "1 damaged frames left out, the first:" in report.text()
    assert "000001.ply" in report.text()
    for k in range(4):
        (folder / "frames" / f"{k:06d}.ply").write_bytes(b"no cloud")
    with pytest.raises(CloudError, match=r"000000\.ply"):
        recorded(open_run(folder), ReplayConfig())


def test_frame_without_finite_points_is_skipped(run):
    class OneWithoutPoints(Run):
        def read(self, index, correction=None):
            frame = super().read(index, correction)
            return replace(frame, points=frame.points * np.float32(np.nan)) if index == 1 else frame

    fields = {field.name: getattr(run, field.name) for field in dataclasses.fields(run) if field.init}
    report, _ = recorded(OneWithoutPoints(**fields), ReplayConfig())
    assert (report.frames, report.damaged, report.finished) == (3, 1, True)
    assert "none of them finite" in report.text()


def test_single_cloud_is_replayed(run_folder):
    single = open_run(run_folder / "frames" / "000002.ply")
    report, sent = recorded(single, ReplayConfig())
    assert [kind for _, kind, _ in sent] == ["odom", "cloud"]
    assert report.text().startswith("1 frame and 1 odometry")
    _, sent = recorded(single, ReplayConfig(loop=True), TestClock(end=0.35))
    clouds = [m.stamp_ns for _, kind, m in sent if kind == "cloud"]
    assert clouds == [0, 100_000_000, 200_000_000, 300_000_000]


@pytest.mark.parametrize("cloud", ["xyz", "xyzi", "foxglove", "cdr", "keelson"])
@pytest.mark.parametrize("odometry", ["json", "cdr"])
def test_replay_encodings(run, cloud, odometry):
    report, sent = recorded(run, ReplayConfig(), cloud_encoding=cloud, odometry_encoding=odometry)
    assert report.frames == 4
    assert sent[3][2].points[:, 0] == pytest.approx(np.full(5, 2.0))
    assert sent[2][2].T_odom_body == pytest.approx(run.poses[1])


def test_read_ahead_error_reaches_the_caller(run):
    crooked = replace(run, poses=np.zeros((4, 4, 4)))  # finite, but no rotations
    with pytest.raises(ValueError, match="rigid"):
        recorded(crooked, ReplayConfig())


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"rate": 0.0}, "--rate"),
        ({"rate": float("nan")}, "--rate"),
        ({"speed": -1.0}, "--speed"),
        ({"odometry_rate": float("inf")}, "--odometry-rate"),
        ({"rate": 5.0, "speed": 2.0}, "one of them"),
        ({"read_ahead": 0}, "read_ahead"),
    ],
)
def test_bad_replay_config_is_refused(options, text):
    with pytest.raises(ConfigError, match=text):
        ReplayConfig(**options)


def test_odometry_spacing(run, run_folder):
    assert odometry_spacing(run, ReplayConfig()) == pytest.approx(0.1)
    assert odometry_spacing(run, ReplayConfig(odometry_rate=50.0)) == pytest.approx(0.02)
    assert odometry_spacing(run, ReplayConfig(speed=0.1)) == pytest.approx(1.0)
    assert odometry_spacing(run, ReplayConfig(rate=100.0)) == pytest.approx(0.1)  # the stamps stay what they are
    for sparse in (ReplayConfig(speed=0.1), ReplayConfig(rate=100.0)):  # 1 s of real time, 0.1 s of sensor time
        enough = ReplayConfig(sparse.rate, sparse.speed, enough_odometry(run, sparse))
        assert odometry_spacing(run, enough) == pytest.approx(0.05)
    assert odometry_spacing(open_run(run_folder / "frames" / "000000.ply"), ReplayConfig()) == 0.0
