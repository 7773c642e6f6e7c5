"""Folders as SC-LIO-SAM, MulRan, KITTI's raw data and FAST-LIO have them."""

import numpy as np
import pytest
from fake_lidar_odometry import Truth

from coview_stream.clouds.files import write_cloud
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import RunError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.odometry.lidar_odometry import LidarOdometry
from coview_stream.recordings.layouts import find_bag, is_run
from coview_stream.recordings.lidar_runs import open_bare_run
from coview_stream.recordings.open_run import open_run

POINTS = np.random.default_rng(1).uniform(-20, 20, (3000, 3)).astype(np.float32)
POSES = [pose_from(rot_z(0.1 * k), [1.0 * k, 0.2 * k, 0.0]) for k in range(5)]


def rows(mark, poses, *before):
    lines = []
    for k, T in enumerate(poses):
        cells = [str(each[k]) for each in before] + [f"{value:.9f}" for value in T[:3].ravel()]
        lines.append(mark.join(cells) + "\n")
    return "".join(lines)


def test_folder_of_sc_lio_sam(tmp_path):
    (tmp_path / "Scans").mkdir()
    for k in range(5):
        write_cloud(tmp_path / "Scans" / f"{k:06d}.pcd", POINTS)
    (tmp_path / "times.txt").write_text("".join(f"{100 + 0.5 * k}\n" for k in range(5)))
    (tmp_path / "optimized_poses.txt").write_text(rows(" ", POSES[::-1]))
    (tmp_path / "odom_poses.txt").write_text(rows(" ", POSES))
    run = open_run(tmp_path)
    assert run.stamps.tolist() == [100, 100.5, 101, 101.5, 102]
    np.testing.assert_allclose(run.poses, POSES, atol=1e-8)  # odometry, not the poses after loop closure
    (tmp_path / "odom_poses.txt").unlink()
    np.testing.assert_allclose(open_run(tmp_path).poses, POSES[::-1], atol=1e-8)


@pytest.fixture
def mulran(tmp_path):
    folder = tmp_path / "KAIST01" / "sensor_data" / "Ouster"
    folder.mkdir(parents=True)
    start = 1_561_000_444_390_000_000
    for k in range(5):
        sweep = np.column_stack([POINTS, np.zeros(len(POINTS))]).astype("<f4")
        sweep.tofile(folder / f"{start + k * 100_000_000 + 50_000_000}.bin")
    stamps = [start + k * 100_000_000 for k in range(5)]  # the last sweep comes after the last pose
    (tmp_path / "KAIST01" / "global_pose.csv").write_text(rows(",", POSES, stamps))
    return tmp_path / "KAIST01"


def test_folder_of_mulran_has_poses_between_those_that_are_given(mulran):
    run = open_run(mulran)
    assert len(run) == 4
    np.testing.assert_allclose(run.poses[:, 0, 3], [0.5, 1.5, 2.5, 3.5], atol=1e-6)
    assert run.notes == ("1 of 5 sweeps have no pose around them in global_pose.csv and are left out",)
    np.testing.assert_allclose(run.read(0).points, POINTS, atol=1e-6)


def test_incomplete_folder_of_mulran_names_what_is_missing(mulran):
    file = mulran / "global_pose.csv"
    text = file.read_text()
    file.write_text(text.replace(",", ";", 3))
    with pytest.raises(RunError, match=r"global_pose\.csv:1: no pose"):
        open_run(mulran)
    file.unlink()
    with pytest.raises(RunError, match=r"global_pose\.csv: no such file"):
        open_run(mulran)


def test_folder_of_mulran_needs_no_poses_if_odometry_is_made_of_the_clouds(mulran):
    (mulran / "global_pose.csv").unlink()
    assert is_run(mulran)
    lidar = LidarOdometry(LidarOdometryConfig(gravity="level"), registration=Truth(POSES))
    for run in (open_run(mulran, "kiss-icp", lidar=lidar), open_bare_run(mulran)):
        np.testing.assert_allclose(run.stamps, 1_561_000_444.44 + 0.1 * np.arange(5), atol=1e-6)


@pytest.mark.parametrize("folder", ["frames", "velodyne", "velodyne_points/data", "Scans", "sensor_data/Ouster"])
def test_recording_beside_the_frames_of_a_run_is_not_the_run(tmp_path, folder):
    (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "recorded.bag").touch()
    assert find_bag(tmp_path) is None


@pytest.fixture
def kitti_raw(tmp_path):
    """A drive to the north-east, a metre from sweep to sweep; the lidar sits 0.8 m ahead of the IMU, 0.3 m aside."""
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for name in ("velodyne_points", "oxts"):
        (drive / name / "data").mkdir(parents=True)
    latitude, longitude = 49.0, 8.4
    metre = 180.0 / (np.pi * 6_378_137.0)
    stamps = []
    for k in range(5):
        north_east = k * 1.0 / np.sqrt(2.0)
        oxts = [latitude + north_east * metre, longitude + north_east * metre / np.cos(np.radians(latitude)), 110.0]
        values = [*oxts, 0.0, 0.0, np.pi / 4, *([0.0] * 24)]
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{v:.12f}" for v in values))
        stamps.append(f"2011-09-26 13:02:25.{100_000_000 * k + 64_389_445:09d}")
        if k != 2:  # as in some drives, a sweep is missing
            sweep = np.column_stack([POINTS, np.zeros(len(POINTS))]).astype("<f4")
            sweep.tofile(drive / "velodyne_points" / "data" / f"{k:010d}.bin")
    for name in ("velodyne_points", "oxts"):
        (drive / name / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    calibration = "calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n"
    (drive.parent / "calib_imu_to_velo.txt").write_text(calibration)
    return drive


def test_drive_of_kittis_raw_data(kitti_raw):
    run = open_run(kitti_raw)
    assert len(run) == 4
    np.testing.assert_allclose(np.diff(run.stamps), [0.1, 0.2, 0.1], atol=1e-6)
    lidar = pose_from(rot_z(np.pi / 4), [0.0, 0.0, 0.0]) @ pose_from(np.eye(3), [0.8, -0.3, 0.8])
    np.testing.assert_allclose(run.poses[0], lidar, atol=1e-6)
    steps = np.linalg.norm(np.diff(run.poses[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, [1.0, 2.0, 1.0], atol=1e-4)
    assert run.notes == ()
    (kitti_raw.parent / "calib_imu_to_velo.txt").unlink()
    assert "taken to sit at the inertial system" in open_run(kitti_raw).notes[0]


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("oxts/data/0000000001.txt", "49.0 8.4 nan 0 0 0", r"0000000001\.txt: no latitude"),
        ("oxts/data/0000000001.txt", "a b", r"0000000001\.txt: no pose"),
        ("oxts/timestamps.txt", "2011-09-26 13:02:25.1\n", r"5 poses and 1 stamps"),
        ("velodyne_points/timestamps.txt", "yesterday\n", r"timestamps\.txt:1: no stamp"),
        ("velodyne_points/timestamps.txt", "2011-09-26 13:02:25.1\n", r"has 1 stamps"),
        ("../calib_imu_to_velo.txt", "R: 1 2 3\nT: 0 0 0\n", r"calib_imu_to_velo\.txt: has no R of nine"),
    ],
)
def test_damaged_drive_of_kittis_raw_data_names_the_file(kitti_raw, file, text, match):
    (kitti_raw / file).write_text(text)
    with pytest.raises(RunError, match=match):
        open_run(kitti_raw)


def test_map_that_fast_lio_saved_is_no_run(tmp_path):
    (tmp_path / "PCD").mkdir()
    write_cloud(tmp_path / "PCD" / "scans.pcd", POINTS)
    with pytest.raises(RunError, match=r"as FAST-LIO saves them.*/cloud_registered_body"):
        open_run(tmp_path)
