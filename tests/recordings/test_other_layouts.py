"""Folders as SC-LIO-SAM and MulRan have them."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.clouds.files import write_cloud
from coview_stream.errors import RunError
from coview_stream.geometry.transforms import pose_from, rot_z
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
    np.testing.assert_allclose(run.poses, POSES, atol=1e-8)  # odometry before what loops have closed
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
