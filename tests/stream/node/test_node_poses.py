"""The node's poses: a drive through the small world, formats, silence."""

import time

import numpy as np
import pytest
from fake_node import STEP, declared
from fake_robot import T_MAP_ODOM, message, ns, tracking
from small_world import pose_error

from coview_stream.geometry.transforms import pose_from
from coview_stream.messages import decode_pose, encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample
from coview_stream.messages.validation import read_attachment
from coview_stream.stream.node.engines import SearchEngine, TrackEngine
from coview_stream.stream.transport.rmw import NO_HASH, gid_of


@pytest.mark.slow
def test_node_poses_are_correct_on_a_drive(world_map, world_drive):
    site = declared("r1", engines=(TrackEngine(world_map), SearchEngine(world_map)))
    right = []
    for k in range(8):
        moved = encode_odometry(OdometryMessage(ns(0.5 * k), world_drive.T_odom_body[k]), "json")
        seen = encode_cloud(CloudMessage(ns(0.5 * k), world_drive.clouds[k]), "xyz")
        for key, each in ((site.keys["r1"].odometry, moved), (site.keys["r1"].cloud, seen)):
            site.net.publish(Sample(key, each.payload, each.encoding, each.attachment))
        site.work("r1")
        before = len(right)
        for sent in site.poses("r1")[before:]:
            assert sent.stamp_ns == ns(0.5 * k)
            right.append(pose_error(sent.T_map_body, world_drive.T_map_body[k])[0])
    assert len(right) >= 3
    assert max(right) < 0.1
    assert site.net.raised == []
    assert site.net.samples("coview/r1/out/pose")[0].encoding == "application/json"
    status = site.status("r1")
    assert status["state"] == "TRACKING"
    assert status["counters"]["processed"] == 8
    assert status["counters"]["searches"] >= 1
    assert status["counters"]["fixes"] == 1
    assert 0.2 < status["evidence"]["score"] <= 1.0


def test_poses_follow_rmw_zenoh_conventions():
    site = declared("r1", "r2", preset="rmw_zenoh")
    keys = site.keys["r1"]
    for seconds in (0.0, STEP):
        moved = encode_odometry(message(seconds), "cdr")
        seen = encode_cloud(CloudMessage(ns(seconds), np.ones((20, 3), np.float32)), "cdr")
        # rmw_zenoh sets no Encoding
        site.net.publish(Sample(keys.odometry.replace("*", NO_HASH), moved.payload))
        site.net.publish(Sample(keys.cloud.replace("*", NO_HASH), seen.payload))
        site.work("r1")
        site.node.publish_poses(time.monotonic())
    sent = site.net.samples(keys.pose)
    assert [s.encoding for s in sent] == ["", ""]
    assert [read_attachment(s.attachment)[1] for s in sent] == [1, 2]
    nodes = [t for t in site.net.announced if "/NN/" in t]
    publishers = sorted(t for t in site.net.announced if "/MP/" in t)
    assert (len(nodes), len(publishers)) == (1, 2)
    assert len({t.split("/")[4] for t in publishers}) == 2  # entity ids
    assert "%r1%coview%pose" in publishers[0]
    assert sent[0].attachment[-16:] == gid_of(publishers[0])
    np.testing.assert_allclose(
        decode_pose(sent[1]).T_map_body, T_MAP_ODOM @ pose_from(np.eye(3), [2 * STEP, 0, 0]), atol=1e-6
    )


def test_pose_encoding_option():
    site = declared("r1", pose_format="cdr")
    site.frame("r1", 0.0)
    site.poses("r1")
    (sent,) = site.net.samples("coview/r1/out/pose")
    assert sent.encoding.startswith("application/cdr;")


def test_no_pose_while_a_frame_that_contradicts_the_place_is_worked_on():
    """A robot that was carried: the engine looks for other places for tenths of a second, odometry goes on."""
    site, counts = declared("r1"), []
    site.frame("r1", 0.0)

    def answer(job):
        for seconds in (0.12, 0.13):
            site.moves("r1", seconds)
            counts.append(len(site.poses("r1")))
            site.track.on_doubt()
        return tracking(job)

    site.engine.answer = answer
    site.frame("r1", 0.1)
    assert counts[0] == counts[1] == len(site.poses("r1")) - 1
