"""A node that makes odometry itself, and its engine in a process that dies and comes back."""

import os
import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fake_node import PATIENT, Runner, Site, declared
from fake_robot import KEYS, cloud, message, ns
from sockets import until

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.geometry.transforms import inverse
from coview_stream.stream.node.engine_process import EngineProcess
from coview_stream.stream.node.engine_queue import OdometryJob, OdometryResult

LEVEL = LidarOdometryConfig(gravity="level", keep_level=False)
CLOUD = np.random.default_rng(0).uniform(-30, 30, (500, 3)).astype(np.float32)
FATAL = np.concatenate([CLOUD, CLOUD])

STAND_IN = """
import os
import types
import numpy as np

class KISSConfig:
    def __init__(self):
        self.data, self.mapping, self.registration = (types.SimpleNamespace() for _ in range(3))

class KissICP:
    def __init__(self, config):
        self.last_pose = self.last_delta = np.eye(4)

    def register_frame(self, points, times):
        if len(points) == 1000:
            os.abort()
        self.last_pose = self.last_pose @ self.last_delta
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A kiss-icp for child processes: the robot goes on as it went, and a frame of 1000 points is the end."""
    package = tmp_path / "kiss_icp"
    package.mkdir()
    for name in ("__init__", "config", "kiss_icp"):
        (package / f"{name}.py").write_text(STAND_IN if name != "__init__" else "")
    monkeypatch.syspath_prepend(tmp_path)


def placing(job):
    assert isinstance(job, OdometryJob)
    return OdometryResult(message((job.stamp_ns - ns(0)) * 1e-9).T_odom_body, None, False, 0.01)


@pytest.fixture
def engine():
    return Runner(SimpleNamespace(run=placing), "odometry")


@pytest.fixture
def site(engine):
    return declared("r1", session={"lidar": LidarOdometryConfig()}, odometry=engine)


def test_lidar_node_subscribes_to_no_odometry(site):
    assert site.net.subscribed == {KEYS.cloud: "newest", "coview/r1/in/initial_pose": "all"}
    site.moves("r1", 0.0)
    assert site.status("r1")["odometry"] == "kiss-icp"
    assert site.status("r1")["counters"]["odometry_received"] == 0
    site.frame("r1", 0.0)
    assert site.status("r1")["state"] == "TRACKING"
    assert len(site.poses("r1")) == 1


def test_odometry_engine_death_loses_the_place_but_not_the_node(site, engine):
    site.frame("r1", 0.0)
    engine.dead = True
    site.frame("r1", 0.1)
    said = site.status("r1")
    why = "lidar odometry was started again: the odometry engine died"
    assert (said["state"], said["reason"]) == ("LOST", why)
    assert said["counters"]["engine_restarts"] == 1
    assert said["errors"] == [
        "the odometry engine is started again: the odometry engine died",
        "r1: frames that lidar odometry failed at; the first: the odometry engine died",
    ]
    site.frame("r1", 0.2)
    assert site.status("r1")["state"] == "TRACKING"


@pytest.mark.slow
def test_node_survives_killed_and_aborted_odometry_engine(stand_in):
    config = replace(PATIENT, max_outage=30.0, pose_rate=50.0)
    engine = EngineProcess("odometry", "unused", "")
    site = Site("r1", config=config, session={"lidar": LEVEL}, odometry=engine)
    session = site.sessions["r1"]
    site.node.start()
    stamps = iter(0.1 * k for k in range(100_000))

    def tracked(points=CLOUD):
        site.net.publish(cloud(next(stamps), points))
        return session.state()[0].value == "TRACKING"

    try:
        until(tracked, 20.0)
        first = engine.pid
        os.kill(first, signal.SIGKILL)
        until(lambda: tracked() and session.counters.engine_restarts == 1, 20.0)
        assert engine.pid not in (None, first)
        until(lambda: tracked(FATAL) or session.counters.engine_restarts == 2, 20.0)
        until(lambda: session.counters.engine_restarts >= 2, 20.0)
        until(tracked, 20.0)
    finally:
        site.node.close()
    assert "lidar odometry was started again: the odometry engine died" in [s["reason"] for s in site.statuses("r1")]
    assert site.net.raised == []
    assert not [t for t in threading.enumerate() if t.name == "coview-odometry"]


@pytest.mark.slow
def test_odometry_engine_process_with_kiss_icp(world_drive):
    pytest.importorskip("kiss_icp.kiss_icp", reason="kiss-icp is not installed")
    engine = EngineProcess("odometry", "unused", "")
    try:
        poses = []
        for k in range(3):
            times = np.zeros(len(world_drive.clouds[k]))  # these end the interpreter if kiss-icp reads them
            level = LidarOdometryConfig(gravity="level")
            job = OdometryJob("r1", 1, ns(0.5 * k), world_drive.clouds[k], times, level)
            poses.append(engine.run(job).T_odom_body)
    finally:
        engine.close()
    assert all(np.isfinite(pose).all() for pose in poses)
    assert np.linalg.norm((inverse(poses[0]) @ poses[2])[:3, 3]) > 0.5
