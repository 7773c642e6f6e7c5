"""Runs and trajectories: layouts, lazy reading, and everything that does not fit together."""

import numpy as np
import pytest

from coview_stream.clouds import read_tum, write_cloud, write_tum
from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.recordings.layouts import find_layout
from coview_stream.recordings.open_run import open_run

POINTS = np.random.default_rng(3).normal(0, 20, (30, 3)).astype(np.float32)
COUNT = 4
POSES = np.stack([pose_from(rot_z(0.3 * i), (2.0 * i, -1.0, 0.1)) for i in range(COUNT)])
STAMPS = 1_700_000_000.125 + 0.1 * np.arange(COUNT)
LINES = [f"{i}.5 {i} 0 0 0 0 0 1" for i in range(COUNT)]


@pytest.fixture
def run(tmp_path):
    (tmp_path / "frames").mkdir()
    for i in range(COUNT):
        write_cloud(tmp_path / "frames" / f"{i:06d}.pcd", POINTS + i)
    write_tum(tmp_path / "odometry.tum", STAMPS, POSES)
    return tmp_path


def _kitti(root, poses):
    (root / "velodyne").mkdir()
    for i in range(len(poses)):
        write_cloud(root / "velodyne" / f"{i:06d}.bin", POINTS + i)
    np.savetxt(root / "times.txt", np.arange(len(poses)) * 0.1)
    np.savetxt(root / "poses.txt", poses[:, :3].reshape(-1, 12))
    return root


def test_run_yields_frames_in_order(run):
    opened = open_run(run)
    frames = list(opened)
    assert len(opened) == len(frames) == COUNT
    for i, frame in enumerate(frames):
        assert frame.index == i
        assert frame.stamp == pytest.approx(STAMPS[i], abs=1e-6)
        np.testing.assert_array_equal(frame.points, POINTS + np.float32(i))
        np.testing.assert_allclose(frame.T_odom_body, POSES[i], atol=1e-6)
        assert not frame.origin.any()


def test_frames_are_sorted_by_number(run):
    for i in range(COUNT):
        (run / "frames" / f"{i:06d}.pcd").rename(run / "frames" / f"{i + 8}.pcd")
    assert [path.name for path in open_run(run).frames_paths] == ["8.pcd", "9.pcd", "10.pcd", "11.pcd"]


def test_damaged_frame_fails_alone(run):
    (run / "frames" / "000002.pcd").write_bytes(b"")
    opened = open_run(run)
    assert len(opened.read(3).points) == 30
    with pytest.raises(CloudError, match=r"000002\.pcd"):
        opened.read(2)
    with pytest.raises(IndexError):
        opened.read(COUNT)


def test_frames_of_a_run_must_be_in_the_body_frame(run):
    write_cloud(run / "frames" / "000001.pcd", POINTS, origin=(500_000.0, 4e6, 0.0))
    with pytest.raises(CloudError, match="body frame"):
        open_run(run).read(1)


def test_single_cloud_run_keeps_its_origin(tmp_path):
    origin = np.array([500_000.25, 4_000_000.5, 30.0])
    write_cloud(tmp_path / "scan.laz", POINTS, origin=origin)
    opened = open_run(tmp_path / "scan.laz")
    frame = opened.read(0)
    assert len(opened) == 1
    assert frame.stamp == 0.0
    np.testing.assert_array_equal(frame.T_odom_body, np.eye(4))
    np.testing.assert_allclose(frame.points + frame.origin, POINTS + origin, atol=1e-3)


def test_one_frame_needs_no_odometry(run):
    (run / "odometry.tum").unlink()
    with pytest.raises(RunError, match="4 frames but no odometry"):
        open_run(run)
    for i in range(1, COUNT):
        (run / "frames" / f"{i:06d}.pcd").unlink()
    assert len(open_run(run)) == 1


def test_odometry_from_another_file(run):
    write_tum(run / "other.tum", STAMPS + 5, POSES)
    assert open_run(run, run / "other.tum").stamps[0] == pytest.approx(STAMPS[0] + 5)
    with pytest.raises(RunError, match=r"missing\.tum: no such file"):
        open_run(run, run / "missing.tum")


def test_kitti_layout_is_read(tmp_path):
    opened = open_run(_kitti(tmp_path, POSES))
    np.testing.assert_allclose(opened.poses, POSES, atol=1e-9)
    np.testing.assert_allclose(opened.stamps, np.arange(COUNT) * 0.1)
    np.testing.assert_array_equal(opened.read(1).points, POINTS + np.float32(1))


def test_kitti_camera_poses_need_their_calibration(tmp_path):
    T_camera_body = pose_from([[0, -1, 0], [0, 0, -1], [1, 0, 0]], (0.1, -0.2, -0.3))
    body = np.stack([pose_from(np.eye(3), (4.0 * i, 0.0, 0.0)) for i in range(COUNT)])
    _kitti(tmp_path, T_camera_body @ body @ inverse(T_camera_body))
    with pytest.raises(RunError, match=r"calib\.txt"):
        open_run(tmp_path)
    numbers = " ".join(map(str, T_camera_body[:3].ravel()))
    (tmp_path / "calib.txt").write_text(f"P0: 1 2 3\nTr: {numbers}\n")
    np.testing.assert_allclose(open_run(tmp_path).poses, body, atol=1e-9)
    (tmp_path / "calib.txt").write_text("Tr: 1 2 3\n")
    with pytest.raises(RunError, match="calibration"):
        open_run(tmp_path)


def test_kitti_times_must_fit(tmp_path):
    _kitti(tmp_path, POSES)
    (tmp_path / "times.txt").write_text("0\n1\n2\n")
    with pytest.raises(RunError, match=r"times\.txt: too short, 3 stamps for 4 frames"):
        open_run(tmp_path)
    (tmp_path / "times.txt").unlink()
    with pytest.raises(RunError, match=r"times\.txt: no such file"):
        open_run(tmp_path)


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (LINES[:3], "too short, 3 poses for 4 frames"),
        ([*LINES, "9 0 0 0 0 0 0 1"], "too long, 5 poses for 4 frames"),
        ([], "too short, 0 poses"),
        ([LINES[1], LINES[0], *LINES[2:]], r"tum:2: stamp 0\.500000 comes before"),
        ([LINES[0], LINES[0], *LINES[2:]], r"tum:2: stamp 0\.5.* repeats .*; give each frame the time at which"),
        ([LINES[0], "1.5 nan 0 0 0 0 0 1", *LINES[2:]], "tum:2: NaN"),
        ([LINES[0], "1.5 0 0 1e30 0 0 0 1", *LINES[2:]], "tum:2: NaN, infinite or absurd"),
        ([LINES[0], "1.5 0 0 0 0 0 0 0", *LINES[2:]], "tum:2: quaternion is zero"),
        ([LINES[0], "1.5 0 0 0 0 0 1", *LINES[2:]], "tum:2: 7 columns instead of 8"),
        (["# t x y z qx qy qz qw", "", LINES[0], "1.5 a 0 0 0 0 0 1", *LINES[2:]], "tum:4: not a number"),
        (["<html>"], "tum:1: 1 columns"),
        (["1 0 0 0 1 0 0 0 1 0 0 0"] * 4, "times"),
    ],
)
def test_odometry_not_matching_the_frames_is_refused(run, lines, reason):
    (run / "odometry.tum").write_text("\n".join(lines))
    with pytest.raises(RunError, match=reason) as caught:
        open_run(run)
    assert "\n" not in str(caught.value)


def test_binary_odometry_file_is_refused(run):
    (run / "odometry.tum").write_bytes(bytes(range(256)))
    with pytest.raises(RunError, match="is not text"):
        open_run(run)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda d: d / "nothing", r"nothing: no such file or directory; check the path$"),
        (lambda d: d, "no frames/ directory"),
        (lambda d: (d / "frames").mkdir() or d, "no frames"),
        (lambda d: write_cloud(d / "a.pcd", POINTS) or d, "in the directory itself"),
        (lambda d: (d / "a.mcap").touch() or d / "a.mcap", "seems to be empty.*copy or record"),
        (lambda d: (d / "metadata.yaml").touch() or d, r"cannot be read \(Invalid bag metadata.*reindex"),
        (lambda d: (d / "a.coview").touch() or d / "a.coview", "is a map, no run; give the run here .*after the map"),
        (lambda d: (d / "manifest.json").touch() or d, "is a map, no run; give the run here .*after the map"),
        (lambda d: (d / "a.tum").touch() or d / "a.tum", "is a trajectory, no run; give the run here"),
        (lambda d: (d / "a.wrl").touch() or d / "a.wrl", "neither a run nor a cloud"),
    ],
)
def test_path_without_a_run_is_refused(tmp_path, make, reason):
    with pytest.raises(RunError, match=reason):
        open_run(make(tmp_path))


def test_run_that_does_not_exist_is_answered_by_its_neighbour(run):
    with pytest.raises(RunError, match=f"no such file or directory; did you mean {run}") as caught:
        open_run(run.with_name(f"{run.name}s"))
    assert "odom_poses.txt" not in str(caught.value)
    run.with_name("monday.mcap").touch()
    with pytest.raises(RunError, match="check the path"):
        open_run(run.with_name("garage.mcap"))


def test_duplicate_frames_and_broken_links_are_refused(run):
    write_cloud(run / "frames" / "000001.ply", POINTS)
    with pytest.raises(RunError, match="same frame"):
        open_run(run)
    (run / "frames" / "000001.ply").unlink()
    (run / "frames" / "000004.pcd").symlink_to(run / "gone")
    with pytest.raises(RunError, match="broken link"):
        open_run(run)


@pytest.mark.parametrize(
    "names",
    [
        ("scan_9.25", "scan_9.5", "scan_10", "scan_100"),
        ("1564718964", "1564718964.1", "1564718964.15", "1564718964.2"),
        ("2020.9.30", "2020.10.1", "2020.10.2", "2020.10.10"),
    ],
)
def test_frames_are_ordered_by_the_numbers_in_their_names(run, names):
    for k, name in enumerate(names):
        (run / "frames" / f"{k:06d}.pcd").rename(run / "frames" / f"{name}.pcd")
    assert tuple(path.stem for path in find_layout(run).frames) == names


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("000001 (1).pcd", r"000001 \(1\)\.pcd: is not named by a number alone, unlike 000000\.pcd"),
        ("1.xyz.gz", "are the same frame; remove one"),
    ],
)
def test_copies_of_a_frame_are_refused(run, name, reason):
    """One frame more would shift all poses behind it."""
    (run / "frames" / name).touch()
    with pytest.raises(RunError, match=reason):
        find_layout(run)


def test_tum_trajectory_round_trip_normalizes_quaternions(tmp_path):
    write_tum(tmp_path / "a.tum", STAMPS, POSES)
    stamps, poses = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(stamps, STAMPS, atol=1e-6)
    np.testing.assert_allclose(poses, POSES, atol=1e-6)
    (tmp_path / "b.tum").write_text("1 0 0 0 0 0 3 3\n")
    np.testing.assert_allclose(read_tum(tmp_path / "b.tum")[1][0, :3, :3], rot_z(np.pi / 2), atol=1e-12)


def test_empty_trajectory_round_trip(tmp_path):
    write_tum(tmp_path / "a.tum", [], [])
    stamps, poses = read_tum(tmp_path / "a.tum")
    assert stamps.shape == (0,)
    assert poses.shape == (0, 4, 4)
    assert (tmp_path / "a.tum").read_bytes() == b""


def test_unwritable_or_mismatched_trajectory_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_tum(tmp_path / "nowhere" / "a.tum", STAMPS, POSES)
    with pytest.raises(InputError, match="3 stamps for 4 poses"):
        write_tum(tmp_path / "a.tum", STAMPS[:3], POSES)
    assert not list(tmp_path.iterdir())


def test_run_can_be_indexed(run):
    opened = open_run(run)
    frames = list(opened)
    assert opened[1].path == frames[1].path
    assert opened[-1].index == opened[np.int64(len(frames) - 1)].index == len(frames) - 1
    for beyond in (len(frames), -len(frames) - 1):
        with pytest.raises(IndexError, match="no frame"):
            opened[beyond]
    with pytest.raises(TypeError):
        opened["first"]


def test_slice_of_a_run_is_a_run(run):
    opened = open_run(run)
    part = opened[1:]
    assert [frame.stamp for frame in part] == opened.stamps[1:].tolist()
    np.testing.assert_array_equal(part[0].points, opened[1].points)
    np.testing.assert_array_equal(part[0].T_odom_body, opened[1].T_odom_body)
    assert part[0].index == 0
    with pytest.raises(RunError, match="goes backwards"):
        opened[::-1]
    with pytest.raises(RunError, match="holds no frame"):
        opened[9:9]


@pytest.mark.parametrize("delay", [0.05, -0.15])
def test_clouds_that_are_late_have_earlier_odometry(run, delay):
    opened = open_run(run)
    assert opened.with_late_clouds(0.0) is opened
    with pytest.raises(RunError, match="longer than the run"):
        opened.with_late_clouds(100.0 * delay)
    moved = opened.with_late_clouds(delay)
    kept = [k for k, stamp in enumerate(STAMPS - delay) if STAMPS[0] <= stamp <= STAMPS[-1]]
    np.testing.assert_allclose(moved.stamps, STAMPS[kept] - delay, atol=1e-6)
    np.testing.assert_allclose(moved.poses[:, 0, 3], 20.0 * (moved.stamps - STAMPS[0]), atol=1e-4)
    np.testing.assert_array_equal(moved[0].points, opened[kept[0]].points)


def test_runs_and_frames_say_what_they_are_in_one_line(run):
    opened = open_run(run)
    assert repr(opened).startswith(f"Run({str(run)!r}: {len(opened)} frames, ")
    assert repr(opened).endswith(" m driven)")
    assert repr(opened[0]).startswith(f"Frame(0: {opened.stamps[0]:.3f} s, ")
    assert "\n" not in repr(opened[0])
