"""Every counter of a session, by the message that causes it."""

import numpy as np
from fake_robot import (
    KEYS,
    POINTS,
    Robot,
    cloud,
    counted,
    ns,
    numbered,
    odometry,
    search_request,
    search_result,
    tracking,
    unknown,
)

from coview_stream.config.node import NodeConfig
from coview_stream.localization.state import State
from coview_stream.messages.types import Sample


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


def test_fixes_poses_and_losses_are_counted(robot):
    robot.localized()
    assert (robot.counters.fixes, robot.counters.poses, robot.counters.losses) == (1, 1, 0)
    robot.frame(0.1)
    robot.session.pose()
    assert (robot.counters.fixes, robot.counters.poses) == (1, 2)
    robot.frame(0.2, unknown, state=State.LOST)
    assert robot.session.pose() is None
    assert (robot.counters.fixes, robot.counters.poses, robot.counters.losses) == (1, 2, 1)
    robot.frame(0.3, unknown, state=State.LOST)
    assert robot.counters.losses == 1
    robot.frame(0.4)
    assert robot.counters.fixes == 2


def test_missing_frames_are_counted_by_sequence_number(robot):
    robot.moved(0.0, x=0.0)
    robot.job_for(0.0, attachment=numbered(1, 0.0))
    robot.saw(0.3, attachment=numbered(2, 0.3))
    robot.session.tick(robot.now + 1.0)  # the second frame has no odometry, but it did come
    robot.moved(0.45, x=0.0)
    for sequence, seconds, missing in ((3, 0.45, 0), (6, 0.46, 2)):
        robot.saw(seconds, attachment=numbered(sequence, seconds))
        assert (robot.counters.no_odometry, robot.counters.missing) == (1, missing)
