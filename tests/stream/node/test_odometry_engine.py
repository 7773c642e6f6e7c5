"""The engine behind ``serve --odometry kiss-icp``: robots apart, and honest about every new beginning."""

import importlib.util
import sys

import numpy as np
import pytest
import small_world
from fake_lidar_odometry import Told, swept

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import DependencyError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.stream.node.engine_queue import FrameJob, OdometryJob
from coview_stream.stream.node.engines import OdometryEngine, open_engine

LEVEL = LidarOdometryConfig(gravity="level", keep_level=False)


@pytest.fixture(scope="module")
def cloud(scene):
    return small_world.scan(scene, small_world.drive()[0])


def moved(x, yaw=0.0):
    return pose_from(rot_z(yaw), [x, 0.0, 0.0])


def job(cloud, seconds, robot="r1", epoch=1, times=None, config=LEVEL):
    return OdometryJob(robot, epoch, round(1e9 * seconds), cloud, times, config)


def engine_of(*poses):
    """An engine whose every robot moves like this."""
    return OdometryEngine(lambda config: Told(*poses))


def test_each_robot_has_its_own_odometry(cloud):
    engine = engine_of(np.eye(4), moved(1.0), moved(2.0))
    one = [engine.run(job(cloud, 0.1 * k)) for k in range(3)]
    other = engine.run(job(cloud, 7.0, "r2"))
    assert [r.T_odom_body[0, 3] for r in one] == pytest.approx([0.0, 1.0, 2.0])
    assert other.T_odom_body[0, 3] == 0.0
    assert [r.restarted for r in (*one, other)] == [True, False, False, True]
    assert all(r.points is None for r in one)


@pytest.mark.parametrize("bring_about", ["epoch", "gap", "forget"])
def test_odometry_restart_is_reported(cloud, bring_about):
    engine = engine_of(np.eye(4), moved(1.0), moved(2.0))
    for k in range(2):
        engine.run(job(cloud, 0.1 * k))
    if bring_about == "forget":
        engine.forget("r1")
    again = {"epoch": job(cloud, 0.05, epoch=2), "gap": job(cloud, 9.0), "forget": job(cloud, 0.0)}
    result = engine.run(again[bring_about])
    assert result.restarted
    stamp = again[bring_about].stamp_ns * 1e-9
    assert not engine.run(job(cloud, stamp + 0.1, epoch=again[bring_about].epoch)).restarted


def test_frames_come_back_deskewed(cloud):
    step = moved(1.0, 0.05)
    engine = engine_of(np.eye(4), step, step @ step)
    for k in range(2):
        engine.run(job(cloud, 0.1 * k))
    skewed, times = swept(cloud, step)
    result = engine.run(job(skewed, 0.2, times=times))
    assert np.abs(skewed - cloud).max() > 0.5
    assert np.abs(result.points - cloud).max() < 0.1
    assert np.allclose(inverse(step @ step) @ result.T_odom_body, np.eye(4))


def test_job_of_another_engine_is_refused(cloud):
    with pytest.raises(TypeError, match="FrameJob"):
        engine_of().run(FrameJob("r1", 1, 0, cloud, np.eye(4)))


def test_odometry_engine_needs_kiss_icp_but_no_map(monkeypatch):
    if importlib.util.find_spec("kiss_icp") is not None:
        assert open_engine("odometry", "no/such.coview", "").kernels == ()
    for name in [name for name in sys.modules if name.startswith("kiss_icp.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    with pytest.raises(DependencyError, match="pip install"):
        open_engine("odometry", "no/such.coview", "")
