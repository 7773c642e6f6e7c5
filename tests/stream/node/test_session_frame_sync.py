"""Pairing of frames with odometry, and the reasons of a state without either."""

import numpy as np
import pytest
from fake_robot import KEYS, POINTS, SHA, Robot, cloud, ends, ns, odometry, pose, reason, tracking

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


def test_sweep_waits_for_odometry_at_its_end(robot):
    robot.drive(0.0, 0.2)
    times = np.linspace(0.0, 0.1, len(POINTS))
    assert robot.job_for(0.15, now=1000.26, codec="foxglove", times=times) is None
    robot.moved(0.26)
    job = robot.session.take_job("track")
    np.testing.assert_allclose(job.times, times, atol=1e-6)
    assert job.segment.stamps.tolist()[0] <= ns(0.15)
    assert job.segment.stamps.tolist()[-1] >= ns(0.25)


def test_sweep_wait_is_bounded(robot):
    robot.drive(0.0, 0.2)
    robot.saw(0.15, now=1000.26, codec="foxglove", times=np.linspace(0.0, 0.1, len(POINTS)))
    robot.session.tick(1000.40)
    assert robot.session.take_job("track") is None
    robot.session.tick(1000.42)
    assert robot.session.take_job("track") is not None


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
