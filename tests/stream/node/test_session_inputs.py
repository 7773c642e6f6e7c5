"""Inputs of a session: frames are paired with odometry, and every message is counted by what became of it."""

import numpy as np
import pytest
from fake_robot import (
    KEYS,
    POINTS,
    SHA,
    Robot,
    cloud,
    counted,
    ends,
    ns,
    numbered,
    odometry,
    pose,
    reason,
    search_request,
    search_result,
    tracking,
    unknown,
)

from coview_stream.config.node import NodeConfig
from coview_stream.localization.state import State
from coview_stream.messages.types import Sample
from coview_stream.stream.node.session import Session


def test_frame_waits_for_odometry_after_its_stamp(robot):
    robot.drive(0.0, 0.1)
    assert robot.job_for(0.12) is None
    robot.moved(0.15)
    job = robot.session.take_job("track")
    assert job.stamp_ns == ns(0.12)
    np.testing.assert_allclose(job.T_odom_body, pose(0.24), atol=1e-9)


def test_frame_without_odometry_does_not_block_others(robot):
    robot.drive(0.0, 0.1)
    robot.saw(3600.0, now=1000.1)  # from the far future
    assert robot.job_for(0.05, now=1000.1).stamp_ns == ns(0.05)
    robot.session.tick(1000.5)
    assert robot.counters.no_odometry == 1
    robot.drive(0.15, 0.6)
    robot.saw(0.55)
    assert robot.counters.out_of_order == 0


def test_waiting_clouds_are_bounded(robot):
    robot.drive(0.0, 0.1)
    for k in range(100):
        robot.saw(0.2 + 0.001 * k, now=1000.2)
    assert 92 - 1 <= robot.counters.dropped <= 92 + 1
    robot.moved(0.35)
    assert robot.session.take_job("track").stamp_ns == ns(0.299)


def test_sweep_waits_for_odometry_at_its_end_but_not_for_ever(robot):
    robot.drive(0.0, 0.2)
    times = np.linspace(0.0, 0.1, len(POINTS))
    assert robot.job_for(0.15, now=1000.26, codec="foxglove", times=times) is None
    robot.session.tick(1000.40)
    assert robot.session.take_job("track") is None
    robot.session.tick(1000.42)
    assert robot.answered().stamp_ns == ns(0.15)
    assert robot.job_for(0.18, now=1000.43, codec="foxglove", times=times) is None
    robot.drive(0.22, 0.32)
    job = robot.session.take_job("track")
    np.testing.assert_allclose(job.times, times, atol=1e-6)
    assert job.segment.stamps.tolist()[0] <= ns(0.18)
    assert job.segment.stamps.tolist()[-1] >= ns(0.28)


def test_sweep_with_times_before_the_stamp(robot):
    robot.drive(0.0, 0.2)
    job = robot.job_for(0.18, codec="foxglove", times=np.linspace(-0.1, 0.0, len(POINTS)))
    assert job.segment.stamps.tolist()[0] <= ns(0.08)
    assert job.segment.stamps.tolist()[-1] >= ns(0.18)


def test_deskew_option_off():
    robot = Robot(NodeConfig(deskew=False))
    robot.drive(0.0, 0.2)
    assert robot.job_for(0.18, codec="foxglove", times=np.linspace(0.0, 0.1, len(POINTS))).segment is None


def test_reason_names_the_missing_messages(robot):
    robot.session.tick(2000.0)
    assert robot.session.state() == (State.SEARCHING, f"waiting for clouds on {KEYS.cloud}")
    robot.saw(1000.0)
    assert reason(robot) == f"waiting for odometry on {KEYS.odometry}"
    robot.moved(1000.0)
    assert "no frame has been processed yet" in reason(robot)


@pytest.mark.parametrize("difference", [-3600.0, 3600.0])
def test_reason_names_clock_difference(robot, difference):
    for k in range(20):
        robot.moved(0.1 * k)
        robot.saw(0.1 * k + difference, now=robot.now)
        robot.session.tick(robot.now)
    assert "clock" in reason(robot)
    assert ends(robot.counters) >= 15


def test_error_log_is_deduplicated_and_bounded(robot):
    for _ in range(50):
        robot.session.on_cloud(Sample(KEYS.cloud, b"x", "video/raw"), 0.0)
    assert len(robot.session.errors.texts) == 1
    for k in range(50):
        robot.session.on_cloud(Sample(KEYS.cloud, b"x", f"video/{k}"), 0.0)
    assert len(robot.session.errors.texts) <= 10
    assert any("video/49" in text for text in robot.session.errors.texts)


def test_latency_is_measured_from_cloud_to_result(robot):
    robot.drive(0.0, 0.2)
    robot.saw(0.15, now=1000.2)
    robot.answered(tracking, 1000.26)
    assert robot.session.queue.latency.to_json()["p50"] == pytest.approx(60.0, abs=0.1)
    assert robot.session.queue.engine_latency.to_json()["p50"] == 10.0


def test_longest_wait_excludes_sender_pauses(robot):
    robot.frame(0.0)
    robot.frame(60.0)  # a minute without clouds
    assert robot.session.queue.longest_wait < 0.1
    robot.drive(60.1, 60.4)
    robot.saw(60.2)
    robot.saw(60.3)  # takes the place of the other, which has waited since 60.2
    robot.answered(tracking, 1061.0)
    assert robot.session.queue.longest_wait == pytest.approx(0.8, abs=0.01)


def test_codec_options_override_encoding():
    session = Session(KEYS, SHA, codecs=("xyz", "json"))
    sample, moved = cloud(0.0), odometry(0.0)
    session.on_cloud(Sample(sample.key, sample.payload, "video/raw", sample.attachment), 0.0)
    session.on_odometry(Sample(moved.key, moved.payload, "video/raw"), 0.0)
    assert session.take_job("track") is not None


def test_frame_that_replaced_another_defers_registration(robot):
    robot.drive(-0.1, 0.5)
    robot.saw(0.0)
    robot.saw(0.1)
    job = robot.answered()
    assert (job.stamp_ns, job.defer) == (ns(0.1), True)
    assert not robot.job_for(0.2).defer


def test_running_frame_is_not_dropped(robot):
    robot.drive(0.0, 1.0)
    busy = robot.job_for(0.2, now=1001.0)
    robot.saw(0.3, now=1001.0)
    assert robot.job_for(0.4, now=1001.0) is None  # one at a time
    assert robot.counters.dropped == 1
    robot.session.handle_result(busy, tracking(busy), 1001.1)
    assert robot.session.take_job("track").stamp_ns == ns(0.4)


def test_late_frame_is_counted(robot):
    robot.drive(0.0, 7.0)
    robot.saw(1.9, now=1007.0)
    assert robot.counters.late == 1
    assert robot.session.take_job("track") is None
    assert robot.job_for(2.1, now=1007.0) is not None


def test_out_of_order_and_duplicate_frames_are_counted(robot):
    robot.drive(0.0, 1.0)
    robot.saw(0.5, now=1001.0)
    robot.saw(0.5, now=1001.0)
    assert (robot.counters.duplicate, robot.counters.out_of_order) == (1, 0)
    assert "with the stamp of another cloud" in robot.session.errors.texts[0]
    robot.saw(0.4, now=1001.0)
    assert (robot.counters.duplicate, robot.counters.out_of_order) == (1, 1)
    assert robot.session.take_job("track").stamp_ns == ns(0.5)


def test_waiting_frames_are_sorted_by_stamp(robot):
    """The network may change their order; that alone loses nothing."""
    robot.drive(0.0, 0.1)
    for t in (0.3, 0.2, 0.3):
        robot.saw(t, now=1000.3)
    robot.moved(0.25, now=1000.3)
    assert robot.session.take_job("track").stamp_ns == ns(0.2)
    robot.moved(0.35, now=1000.35)
    assert counted(robot) == {"received": 3, "duplicate": 1, "odometry_received": 5}


def test_frame_without_odometry_is_counted_after_the_wait_or_at_once_in_a_gap(robot):
    robot.drive(0.0, 1.0)
    robot.saw(1.2)
    robot.session.tick(robot.now + 0.29)
    assert robot.counters.no_odometry == 0
    robot.session.tick(robot.now + 0.31)
    assert robot.counters.no_odometry == 1
    robot.moved(2.0)
    robot.saw(1.6, now=1002.0)
    assert robot.counters.no_odometry == 2


def test_malformed_oversized_and_unknown_clouds_are_counted(robot):
    good = cloud(0.0)
    robot.session.on_cloud(Sample(KEYS.cloud, b"12345", good.encoding, good.attachment), 0.0)
    robot.session.on_cloud(Sample(KEYS.cloud, good.payload, good.encoding, None), 0.0)
    assert (robot.counters.received, robot.counters.malformed) == (2, 2)
    robot.session.on_cloud(Sample(KEYS.cloud, good.payload, "video/raw", good.attachment), 0.0)
    assert robot.counters.unknown_encoding == 1
    assert any("video/raw" in text for text in robot.session.errors.texts)
    small = Robot(NodeConfig(max_payload=len(good.payload)))
    small.saw(0.0)
    assert small.counters.oversized == 0
    small.saw(0.1, points=np.zeros((len(POINTS) + 1, 3), np.float32))
    assert (small.counters.oversized, small.counters.received) == (1, 2)


def test_malformed_oversized_and_unknown_odometry_is_counted():
    robot = Robot(NodeConfig(max_payload=1000))
    good = odometry(0.0)
    robot.session.on_odometry(Sample(good.key, b'{"stamp_ns": 1', good.encoding), 0.0)
    robot.session.on_odometry(Sample(good.key, good.payload, "video/raw"), 0.0)
    robot.session.on_odometry(Sample(good.key, b"{" + bytes(1000), good.encoding), 0.0)
    assert counted(robot) == {
        "odometry_received": 3,
        "odometry_malformed": 1,
        "odometry_unknown_encoding": 1,
        "odometry_oversized": 1,
    }


def test_odometry_with_an_old_stamp_is_counted(robot):
    robot.drive(0.0, 1.0)
    robot.moved(1.0)
    robot.moved(0.9)
    assert (robot.counters.odometry_duplicate, robot.counters.odometry_out_of_order) == (1, 1)


def test_searches_and_skipped_searches_are_counted(robot):
    robot.frame(0.0, unknown, ask=search_request(0.0))
    job = robot.session.take_job("search")
    assert job.request.stamp == 0.0
    robot.frame(0.1, unknown, ask=search_request(0.1))
    assert robot.session.take_job("search") is None  # one at a time
    assert robot.counters.searches_skipped == 0
    robot.frame(0.2, unknown, ask=search_request(0.2))
    assert (robot.counters.searches_skipped, robot.counters.searches) == (1, 0)
    robot.session.handle_result(job, search_result(), robot.now)
    assert robot.counters.searches == 1
    assert robot.session.take_job("search").request.stamp == 0.2
    assert robot.session.take_job("search") is None


def test_missing_frames_are_counted_by_sequence_number(robot):
    robot.moved(0.0, x=0.0)
    robot.job_for(0.0, attachment=numbered(1, 0.0))
    robot.saw(0.3, attachment=numbered(2, 0.3))
    robot.session.tick(robot.now + 1.0)  # the second frame has no odometry, but it did come
    robot.moved(0.45, x=0.0)
    for sequence, seconds, missing in ((3, 0.45, 0), (6, 0.46, 2)):
        robot.saw(seconds, attachment=numbered(sequence, seconds))
        assert (robot.counters.no_odometry, robot.counters.missing) == (1, missing)
