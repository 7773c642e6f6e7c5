"""Runs without odometry, in files and in recordings, around a registration that knows the truth."""

import shutil

import numpy as np
import pytest
import small_world
from bag_files import cloud, odometry, write_bag
from fake_lidar_odometry import Told, Truth

from coview_stream.cli import main
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import RunError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.odometry import lidar_odometry as module
from coview_stream.odometry.lidar_odometry import LidarOdometry
from coview_stream.recordings.open_run import open_run


@pytest.fixture
def bare(world_run, tmp_path):
    """The small world's run without its odometry."""
    run = tmp_path / "run"
    shutil.copytree(world_run, run)
    (run / "odometry.tum").unlink()
    return run


def truthful(world_drive):
    return LidarOdometry(registration=Truth(world_drive.T_map_body))


def times(run, stamps):
    (run / "times.txt").write_text("\n".join(map(str, stamps)) + "\n")


def test_run_without_odometry_gets_poses_and_notes(bare, world_drive):
    done = []
    times(bare, 100.0 + 0.5 * np.arange(7))
    run = open_run(bare, "kiss-icp", lidar=truthful(world_drive), progress=lambda *at: done.append(at))
    assert len(run) == 7
    assert run.stamps[3] == 101.5
    motion, truth = (inverse(T[0]) @ T[6] for T in (run.poses, world_drive.T_map_body))
    assert small_world.pose_error(motion, truth)[0] < 0.02
    assert abs(run.poses[0, 2, 2] - 1.0) < 1e-4
    assert done[-1] == (7, 7)
    assert "down is taken from the ground" in run.notes[0]


def test_frames_without_stamps_are_taken_at_10_hz(bare, world_drive):
    run = open_run(bare, "kiss-icp", lidar=truthful(world_drive))
    assert np.allclose(run.stamps, 0.1 * np.arange(7))
    assert "no times.txt" in run.notes[0]


def test_stamps_come_from_ignored_odometry_file(world_run, world_drive):
    run = open_run(world_run, "kiss-icp", lidar=truthful(world_drive))
    assert np.allclose(run.stamps, 100.0 + 0.5 * np.arange(7))
    assert np.abs(run.poses[:, :3, 3]).max() < 30  # not those of the file, kilometres away


def test_frames_without_lidar_odometry_are_skipped(bare, world_drive):
    (bare / "frames" / "000006.ply").write_bytes(b"")
    run = open_run(bare, "kiss-icp", lidar=truthful(world_drive))
    assert len(run) == 6
    assert "could not place 1 of 7 frames" in run.notes[-1]
    assert "000006.ply" in run.notes[-1]


def test_run_without_any_placeable_frame_is_an_error(bare, world_drive):
    for path in (bare / "frames").iterdir():
        path.write_bytes(b"")
    with pytest.raises(RunError, match="not one of 7 frames"):
        open_run(bare, "kiss-icp", lidar=truthful(world_drive))


def test_mismatched_times_and_topic_options_are_refused(bare, world_drive):
    times(bare, [1.0, 2.0])
    with pytest.raises(RunError, match="too short"):
        open_run(bare, "kiss-icp", lidar=truthful(world_drive))
    with pytest.raises(RunError, match="odometry-topic"):
        open_run(bare, "kiss-icp", odometry_topic="/odom")
    with pytest.raises(RunError, match="cloud-topic"):
        open_run(bare, "kiss-icp", cloud_topic="/points")


def test_single_frame_needs_no_lidar_odometry(bare):
    only = bare / "frames" / "000000.ply"
    assert len(open_run(only, "kiss-icp")) == 1


@pytest.mark.slow
def test_locate_command_with_lidar_odometry(world_file, bare, world_drive, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(module, "KissRegistration", lambda config: Truth(world_drive.T_map_body))
    times(bare, 100.0 + 0.5 * np.arange(7))
    out = tmp_path / "out"
    command = ["locate", "--no-pictures", "--odometry", "kiss-icp"]
    files = [str(world_file), str(bare), "-o", str(out)]
    assert main([*command, *files]) == 0
    assert "down is taken from the ground" in capsys.readouterr().err
    stamps, poses = read_tum(out / "trajectory.tum")
    truth = np.array(world_drive.T_map_body)[np.round((stamps - 100.0) / 0.5).astype(int)]
    assert len(stamps) >= 2
    assert np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.08
    assert main([*command, "--gravity", "level", *files]) == 0
    assert "down is taken" not in capsys.readouterr().err
    assert main([*command, "--gravity=-1e-3,0,-9.81", *files]) == 0


START = 1_700_000_000_000_000_000
STEP = pose_from(rot_z(0.05), [0.6, 0.0, 0.0])  # in 0.1 s
POSES = [np.linalg.matrix_power(STEP, k) for k in range(6)]
STAMPS = [START + k * 100_000_000 for k in range(6)]
WORLD = np.random.default_rng(5).uniform(-30, 30, (400, 3))


def lidar():
    return LidarOdometry(LidarOdometryConfig(gravity="level", keep_level=False), Told(*POSES))


def sweep(k):
    """Each point as seen at its own time, up to 0.1 s before the stamp."""
    times = np.linspace(-0.1, 0.0, len(WORLD))
    before, here = (np.linalg.matrix_power(STEP, n)[:3, 3] for n in (k - 1, k))
    points = np.empty_like(WORLD)
    for i, share in enumerate(times / 0.1 + 1.0):
        T = pose_from(rot_z(0.05 * (k - 1 + share)), (1 - share) * before + share * here)
        points[i] = transform(inverse(T), WORLD[i : i + 1])[0]
    return cloud(STAMPS[k], points.astype(np.float32), times.astype(np.float32))


def test_bag_without_odometry_gets_lidar_odometry_and_deskewed_clouds(tmp_path):
    bag = write_bag(tmp_path / "bag", {"/points": [sweep(k) for k in range(6)]})
    run = open_run(bag, "kiss-icp", lidar=lidar())
    assert np.allclose(run.stamps, np.array(STAMPS) / 1e9)
    for k, frame in enumerate(run):
        assert np.allclose(frame.T_odom_body, POSES[k])
        if k:
            truth = transform(inverse(frame.T_odom_body), WORLD)
            assert np.abs(frame.points - truth).max() < 0.02


def test_odometry_topic_is_ignored_with_lidar_odometry(tmp_path):
    elsewhere = [odometry(ns, pose_from(np.eye(3), [500.0, 0, 0])) for ns in STAMPS]
    bag = write_bag(tmp_path / "bag", {"/points": [sweep(k) for k in range(6)], "/odom": elsewhere})
    assert np.abs(open_run(bag, "kiss-icp", lidar=lidar()).poses[:, :3, 3]).max() < 10
    with pytest.raises(RunError, match="odometry-topic"):
        open_run(bag, "kiss-icp", odometry_topic="/odom", lidar=lidar())


def test_frames_of_covered_sensor_are_skipped(tmp_path):
    dark = cloud(STAMPS[5], np.full((50, 3), 0.1, np.float32))
    bag = write_bag(tmp_path / "bag", {"/points": [*(sweep(k) for k in range(5)), dark]})
    run = open_run(bag, "kiss-icp", lidar=lidar())
    assert len(run) == 5
    assert "could not place 1 of 6 frames" in run.notes[0]
