"""Layouts of runs on disk: frame files, stamps and odometry."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np

from coview_stream.clouds.files import CLOUD_SUFFIXES, is_cloud_name
from coview_stream.clouds.rows import suffix_of
from coview_stream.clouds.trajectory import columns_of, read_kitti_poses, read_times, read_tum
from coview_stream.errors import RunError, nearest
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Pose, Poses, inverse

_KITTI_COLUMNS = 12
_BAGS = (".mcap", ".db3", ".bag")
_FOLDERS = {
    "frames": ("odometry.tum",),
    "velodyne": ("odometry.tum", "poses.txt"),  # KITTI's
    "velodyne_points/data": ("odometry.tum",),  # KITTI's raw data, whose own poses lie elsewhere
    "Scans": ("odom_poses.txt", "optimized_poses.txt"),  # saved by SC-LIO-SAM and SC-A-LOAM
}
"""Folders of frames, and odometry files next to them; the first existing file counts."""
_NUMBERS = re.compile(r"((?<![\d.])\d+\.\d+(?![\d.])|\d+)")  # in a frame's name: stamps, dates and numbers
_MULRAN_SWEEPS = ("sensor_data/Ouster", "Ouster")
_LAYOUTS = (
    "frames/NNNNNN.pcd (ply, bin, npy, las, laz) beside odometry.tum, KITTI's velodyne/*.bin with times.txt and "
    "poses.txt, SC-LIO-SAM's Scans/*.pcd with times.txt and odom_poses.txt, MulRan's folders, a drive of KITTI's raw "
    "data, or a ROS recording (rosbag2 directory, .mcap, .db3, .bag)"
)
_GIVE_RUN = "no run; give the run here (a folder, .mcap, .db3 or .bag), after the map if the command takes one"


@dataclass(frozen=True)
class Layout:
    """Files of a run."""

    path: Path
    """The directory, or the single cloud."""
    frames: tuple[Path, ...]
    """The clouds in order."""
    odometry: Path | None = None
    """TUM or KITTI poses."""
    times: Path | None = None
    """Stamps of the frames."""


def find_layout(path: Path) -> Layout:
    """Find the files of a run, a directory or a cloud file; RunError if missing, of unknown layout, without frames."""
    if not path.exists():
        beside = {other.stem: other for other in path.parent.iterdir()} if path.parent.is_dir() else {}
        near = nearest(path.stem, list(beside))  # a common suffix is no similarity
        remedy = f"did you mean {beside[near]}?" if near else "check the path"
        raise RunError(f"{path}: no such file or directory; {remedy}")
    if path.is_file():
        if (kind := {".coview": "a map", ".tum": "a trajectory"}.get(path.suffix)) is not None:
            raise RunError(f"{path}: is {kind}, {_GIVE_RUN}")
        if suffix_of(path) not in CLOUD_SUFFIXES:
            raise RunError(f"{path}: neither a run nor a cloud ({', '.join(sorted(CLOUD_SUFFIXES))})")
        return Layout(path, (path,))
    if (sweeps := find_sweeps(path)) is not None:
        return Layout(path, sweeps_in(sweeps)[0])
    for folder, names in _FOLDERS.items():
        if (path / folder).is_dir():
            frames = _frames(path / folder)
            odometry = next((path / name for name in names if (path / name).exists()), None)
            times = path / "times.txt"
            return Layout(path, frames, odometry, times if times.exists() else None)
    if fused := next((folder for folder in (path, path / "PCD") if any(folder.glob("scans*.pcd"))), None):
        raise RunError(
            f"{fused}: scans*.pcd, as FAST-LIO saves them, lie in its own world frame: a map, and no run; record its "
            "/cloud_registered_body and /Odometry in a bag, and give that"
        )
    for within in sorted(path.iterdir()):
        if _has_frames(within):
            raise RunError(f"{path}: is not a run; did you mean {within}?")
    if any(is_cloud_name(file) for file in path.iterdir()):
        raise RunError(f"{path}: clouds lie in the directory itself; a run has {_LAYOUTS}")
    if (path / "manifest.json").exists():  # a site's
        raise RunError(f"{path}: is a map, {_GIVE_RUN}")
    raise RunError(f"{path}: no frames/ directory; a run has {_LAYOUTS}")


def find_sweeps(path: Path) -> Path | None:
    """Return the folder with a MulRan run's sweeps; None if ``path`` is not such a run."""
    return next((path / name for name in _MULRAN_SWEEPS if (path / name).is_dir()), None)


def sweeps_in(folder: Path) -> tuple[tuple[Path, ...], Ints]:
    """Return the sweeps of a MulRan run and their stamps (N,) nanoseconds, in order; RunError for none."""
    files = {int(file.stem): file for file in folder.glob("*.bin") if file.stem.isdecimal()}
    if not files:
        raise RunError(f"{folder}: no sweeps named by their stamps (1564718964270138112.bin)")
    stamps = sorted(files)
    return tuple(files[stamp] for stamp in stamps), np.array(stamps, dtype=np.int64)


def is_run(path: Path) -> bool:
    """Return whether a path is a recording, or a directory with a run's frames."""
    return find_bag(path) is not None or _has_frames(path)


def _has_frames(path: Path) -> bool:
    return find_sweeps(path) is not None or any((path / folder).is_dir() for folder in _FOLDERS)


def find_bag(path: Path) -> Path | None:
    """Find the recording at ``path``, file or rosbag2 directory, else None. RunError: several, no metadata.yaml."""
    if not path.is_dir():
        return path if path.suffix in _BAGS and path.is_file() else None
    if _has_frames(path):
        return None
    if (path / "metadata.yaml").is_file():
        return path
    files = sorted(file for file in path.iterdir() if file.suffix in _BAGS and file.is_file())
    if len(files) > 1:
        names = ", ".join(file.name for file in files[:5])
        raise RunError(
            f"{path}: several recordings ({names}) without metadata.yaml; name one file, or run: ros2 bag reindex"
        )
    return files[0] if files else None


def _frames(folder: Path) -> tuple[Path, ...]:
    """List a folder's cloud files by the numbers in their names; RunError for none, twins, strangers or non-files."""
    files = [file for file in folder.iterdir() if is_cloud_name(file)]
    if not files:
        raise RunError(f"{folder}: no frames ({', '.join(sorted(CLOUD_SUFFIXES))}); put one cloud per scan there")
    for file in files:
        if not file.is_file():
            raise RunError(f"{file}: is not a file (a directory or a broken link); put the cloud itself there")
    names = {file: file.name[: -len(suffix_of(file))] for file in files}
    numbered = [file for file in files if _NUMBERS.fullmatch(names[file])]
    if numbered and (others := sorted(set(files) - set(numbered))):
        raise RunError(f"{others[0]}: is not named by a number alone, unlike {min(numbered).name}; rename or remove it")
    order = {
        file: [Decimal(part) if at % 2 else part for at, part in enumerate(_NUMBERS.split(name))]
        for file, name in names.items()
    }
    files.sort(key=lambda file: (order[file], file.name))
    for before, after in pairwise(files):
        if order[before] == order[after]:
            raise RunError(f"{folder}: {before.name} and {after.name} are the same frame; remove one")
    return tuple(files)


def read_odometry(layout: Layout, explicit: Path | None = None) -> tuple[Floats, Poses]:
    """Read stamps (N,), seconds, and poses (N, 4, 4), odometry <- body; RunError if invalid or not one per frame."""
    file = explicit or layout.odometry
    assert file is not None
    if columns_of(file) == _KITTI_COLUMNS:
        stamps, poses = _kitti(layout, file)
    else:
        stamps, poses = read_tum(file)
    _check_count(file, len(poses), "poses", layout)
    return stamps, poses


def read_stamps(layout: Layout) -> Floats | None:
    """Read stamps (N,), seconds, without odometry; None without any. RunError if invalid or not one per frame."""
    file, stamps = layout.times, None
    if file is not None:
        stamps = read_times(file)
    elif layout.odometry is not None and columns_of(layout.odometry) != _KITTI_COLUMNS:
        file, stamps = layout.odometry, read_tum(layout.odometry)[0]
    elif (sweeps := find_sweeps(layout.path)) is not None:
        stamps = sweeps_in(sweeps)[1].astype(np.float64) * 1e-9
    if file is not None and stamps is not None:
        _check_count(file, len(stamps), "stamps", layout)
    return stamps


def _check_count(file: Path, count: int, noun: str, layout: Layout) -> None:
    if count != len(layout.frames):
        relation = "too short" if count < len(layout.frames) else "too long"
        raise RunError(f"{file}: {relation}, {count} {noun} for {len(layout.frames)} frames; give one line per frame")


def _kitti(layout: Layout, file: Path) -> tuple[Floats, Poses]:
    if layout.times is None:
        raise RunError(f"{layout.path / 'times.txt'}: no such file; KITTI poses need one stamp per frame")
    stamps = read_times(layout.times)
    _check_count(layout.times, len(stamps), "stamps", layout)
    poses = read_kitti_poses(file)
    T_camera_body = _calibration(layout.path / "calib.txt")
    if T_camera_body is not None:
        return stamps, inverse(T_camera_body) @ poses @ T_camera_body
    steps = np.einsum("nij,ni->nj", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    x, _, z = np.abs(steps).sum(axis=0)
    if z > 5.0 and z > 5.0 * x:  # a camera's z axis points forward
        raise RunError(f"{file}: poses drive along z, so they are the camera's; add KITTI's calib.txt with Tr")
    return stamps, poses


def _calibration(path: Path) -> Pose | None:
    """Read T_camera_velodyne (4, 4) from a KITTI ``calib.txt``; None without the file or a Tr line."""
    if not path.is_file():
        return None
    try:
        for number, line in enumerate(path.read_text(encoding="ascii").splitlines(), start=1):
            name, _, rest = line.partition(":")
            if name.strip() in ("Tr", "Tr_velo_to_cam"):
                T = np.eye(4)
                T[:3] = np.array([float(word) for word in rest.split()]).reshape(3, 4)
                if not np.isfinite(T).all() or abs(np.linalg.det(T) - 1.0) > 0.1:
                    raise RunError(f"{path}:{number}: Tr is not a rigid transform; restore the file")
                return T
    except (ValueError, OSError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"{path}: unreadable calibration ({error}); restore the file") from error
    return None
