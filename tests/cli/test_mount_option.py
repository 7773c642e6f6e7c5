"""``--mount`` of ``locate``, ``serve`` and ``replay``: clouds of a turned lidar are those of the body."""

import json
import shutil

import numpy as np
import pytest
from fake_robot import Robot
from sockets import free_endpoint, until

from coview_stream.cli import main
from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config.mount import Mount, parse_mount
from coview_stream.config.node import NodeConfig
from coview_stream.geometry.transforms import inverse, rotation_angle, transform
from coview_stream.messages import decode_cloud
from coview_stream.odometry.deskew import deskew
from coview_stream.recordings.open_run import open_run
from coview_stream.stream.transport.zenoh_transport import open_transport

MOUNT = "180,10,90,0.3,-0.2,0.5"


def turned(points):
    """The same scan by a lidar that hangs upside down, pitched, turned and away from the body's origin."""
    return transform(inverse(parse_mount(MOUNT).T_body_sensor), points.astype(np.float64)).astype(np.float32)


@pytest.fixture(scope="module")
def turned_run(world_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("turned") / "run"
    shutil.copytree(world_run, folder)
    for path in sorted((folder / "frames").iterdir()):
        write_cloud(path, turned(read_cloud(path).points))
    return folder


@pytest.mark.slow
def test_level_contains_the_lever_arm_and_heading_that_nobody_has_stated(
    world_file, world_run, world_drive, turned_run, tmp_path
):
    """As after the doctor's remedy, which sees neither the place of the lidar nor its heading to a degree."""
    out = tmp_path / "out"
    assert main(["locate", str(world_file), str(turned_run), "-o", str(out), "--no-pictures", "--mount=180,10,88"]) == 0
    level = json.loads((out / "result.json").read_text())["protection_level"]
    stamps, poses = read_tum(out / "trajectory.tum")
    off = inverse(world_drive.T_map_body[round((stamps[-1] - 100.0) / 0.5)]) @ poses[-1]
    assert 0.4 < np.linalg.norm(off[:3, 3]) < level["m"] < 12.0
    assert np.degrees(rotation_angle(off[:3, :3])) < level["deg"]


def test_live_sweep_of_a_turned_lidar_is_deskewed_as_that_of_the_body():
    """The lever arm swings with the body: clouds are turned before they are deskewed."""
    points = np.random.default_rng(0).uniform(-20, 20, (200, 3)).astype(np.float32)
    times = np.linspace(-0.1, 0.0, 200)

    def deskewed(seen, mount):
        robot = Robot(NodeConfig(mount=mount))
        for k in range(12):
            robot.moved(0.05 * k, x=0.5 * k, yaw=0.05 * k)
        job = robot.job_for(0.5, points=seen, times=times, codec="foxglove")
        return deskew(job.points, job.times, job.segment, job.stamp_ns, job.T_odom_body)

    body = deskewed(points, Mount())
    assert np.abs(body - points).max() > 0.5  # there is something to deskew
    assert np.allclose(deskewed(turned(points), parse_mount(MOUNT)), body, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("given", [[], ["--odometry", "none"]])
def test_replay_sends_clouds_in_the_body_frame(world_run, turned_run, given):
    sent, endpoint = [], free_endpoint()
    node = open_transport(listen=[endpoint])
    node.subscribe("coview/r1/in/cloud", lambda sample: sent.append(decode_cloud(sample).points), "all")
    command = ["replay", str(turned_run), "--robot", "r1", "--connect", endpoint, "--rate", "50"]
    assert main([*command, f"--mount={MOUNT}", *given]) == 0
    until(lambda: len(sent) == 7)
    node.close()
    for here, there in zip(open_run(world_run), sent, strict=True):
        assert np.allclose(here.points, there, atol=1e-4)


@pytest.mark.parametrize("wrong", ["1,2", "0,0,x", "0,400,0", ""])
def test_wrong_mount_is_refused_before_anything_is_read(tmp_path, refused, wrong):
    none = str(tmp_path / "not-even-looked-for")
    commands = (
        ["locate", none, none, "-o", str(tmp_path / "o")],
        ["serve", none, "--robot", "r1", "--no-state"],
        ["replay", none, "--robot", "r1"],
    )
    for command in commands:
        assert f"--mount={wrong}: " in refused(*command, f"--mount={wrong}")
