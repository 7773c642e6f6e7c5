"""Runs of public datasets with their own layouts: drives of KITTI's raw data, and MulRan.

In both, sweeps and poses have different stamps. Sweeps without poses around their stamps are left out and counted in
the run's notes. The poses serve as odometry; nothing is read as ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.errors import RunError
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Pose, Poses, exp_so3, interpolate, inverse, orthonormal, pose_from, rot_z
from coview_stream.recordings.layouts import sweeps_in
from coview_stream.recordings.run import Run

_MAX_GAP = 0.5  # seconds between two poses

_KITTI_SWEEPS, _KITTI_INERTIAL = "velodyne_points", "oxts"
_KITTI_CALIBRATION = "calib_imu_to_velo.txt"
_KITTI_COLUMNS = 6  # latitude, longitude, height, roll, pitch, yaw; more follow
_EARTH = 6_378_137.0  # metres; radius of the sphere in the dataset's own tools

_MULRAN_POSES = "global_pose.csv"
_MULRAN_COLUMNS = 13  # stamp and the first three rows of world <- vehicle
_MAX_SKEW = 1e-3  # of a rotation matrix in text


def is_kitti_raw(path: Path) -> bool:
    """Return whether a directory is a drive of KITTI's raw data."""
    return (path / _KITTI_SWEEPS / "data").is_dir()


def open_kitti_raw(path: Path, mount: Mount | None = None) -> Run:
    """Open a drive of KITTI's raw data, with the poses of the car's inertial system (OXTS) as odometry.

    The first position is zero; its heading is kept, so the odometry frame is level. The body is the lidar if
    ``calib_imu_to_velo.txt`` is in the drive's folder or its parent; else the lidar is assumed to be at the inertial
    system.

    Raises:
        RunError: no sweeps, no poses, or a malformed line; the message names file and line.
    """
    files = sorted(file for file in (path / _KITTI_SWEEPS / "data").glob("*.bin") if file.stem.isdecimal())
    if not files:
        raise RunError(
            f"{path / _KITTI_SWEEPS / 'data'}: no sweeps (0000000000.bin); unpack the drive's velodyne_points"
        )
    stamps_file = path / _KITTI_SWEEPS / "timestamps.txt"
    stamps = _kitti_stamps(stamps_file)
    if int(files[-1].stem) >= len(stamps):
        raise RunError(f"{stamps_file}: has {len(stamps)} stamps, and sweep {files[-1].name} none")
    T_velo_imu, notes = _kitti_calibration(path)
    pose_stamps, T_odom_imu = _kitti_poses(path / _KITTI_INERTIAL)
    sweeps = stamps[[int(file.stem) for file in files]]
    run = _paired(path, files, sweeps, pose_stamps, T_odom_imu, _KITTI_INERTIAL, notes, mount)
    return replace(run, poses=run.poses @ inverse(T_velo_imu))


def open_mulran(path: Path, sweeps: Path, mount: Mount | None = None) -> Run:
    """Open a MulRan run: Ouster sweeps named by their stamps, and the vehicle's poses in ``global_pose.csv``.

    The clouds are in the lidar's frame, the poses are the vehicle's: ``mount`` (``--mount``) is the lidar's pose on it.

    Raises:
        RunError: no sweeps, no poses, or a malformed line; the message names file and line.
    """
    poses_file = next((folder / _MULRAN_POSES for folder in (path, sweeps.parent)
                       if (folder / _MULRAN_POSES).is_file()), None)  # fmt: skip
    if poses_file is None:
        raise RunError(f"{path / _MULRAN_POSES}: no such file; MulRan's sweeps need it for their odometry")
    files, stamps = sweeps_in(sweeps)
    pose_stamps, T = _mulran_poses(poses_file)
    return _paired(path, files, stamps, pose_stamps, T, poses_file.name, (), mount)


def _paired(
    path: Path,
    files: Sequence[Path],
    stamps: Floats | Ints,
    pose_stamps: Floats | Ints,
    T: Poses,
    source: str,
    notes: tuple[str, ...],
    mount: Mount | None,
) -> Run:
    """Return the run of sweeps (N) between poses (K, 4, 4); stamps in float seconds or integer nanoseconds."""
    unit = 1e-9 if stamps.dtype.kind == "i" else 1.0
    after = np.clip(np.searchsorted(pose_stamps, stamps), 1, len(pose_stamps) - 1)
    inside = (stamps >= pose_stamps[0]) & (stamps <= pose_stamps[-1])
    inside &= unit * (pose_stamps[after] - pose_stamps[after - 1]) <= _MAX_GAP
    if not inside.any():
        raise RunError(f"{path}: none of {len(files)} sweeps has a pose around its stamp in {source}")
    end = after[inside]
    share = (stamps[inside] - pose_stamps[end - 1]) / (pose_stamps[end] - pose_stamps[end - 1])
    left_out = len(files) - int(inside.sum())
    if left_out:
        notes = (f"{left_out} of {len(files)} sweeps have no pose around them in {source} and are left out", *notes)
    return Run(
        path,
        tuple(file for file, keep in zip(files, inside, strict=True) if keep),
        np.asarray(stamps[inside] * unit, dtype=np.float64),
        np.asarray(interpolate(T[end - 1], T[end], share), dtype=np.float64),
        notes=notes,
        mount=mount,
    )


def _kitti_stamps(path: Path) -> Floats:
    """Read stamps (N,) seconds, one per line: ``2011-09-26 13:02:25.964389445``."""
    stamps = []
    try:
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); unpack the drive whole") from error
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        whole, _, fraction = line.strip().partition(".")
        try:
            seconds = datetime.fromisoformat(f"{whole}+00:00").timestamp()
            stamps.append(seconds + (float(f"0.{int(fraction):0{len(fraction)}d}") if fraction else 0.0))
        except ValueError as error:
            raise RunError(f"{path}:{number}: no stamp ({error}); restore the file") from error
    if not stamps or (np.diff(stamps) < 0).any():
        raise RunError(f"{path}: has no stamps, or some that go back; restore the file")
    return np.array(stamps)


def _kitti_poses(folder: Path) -> tuple[Floats, Poses]:
    """Read stamps (N,) seconds and poses (N, 4, 4) of the inertial system, with the first position at zero."""
    files = sorted((folder / "data").glob("*.txt"))
    stamps = _kitti_stamps(folder / "timestamps.txt")
    if len(files) != len(stamps) or len(files) < 2:
        raise RunError(f"{folder}: {len(files)} poses and {len(stamps)} stamps; unpack the drive's oxts whole")
    rows = []
    for file in files:
        try:
            row = [float(word) for word in file.read_text(encoding="ascii").split()]
        except (OSError, ValueError) as error:
            raise RunError(f"{file}: no pose ({error}); restore the file") from error
        if len(row) < _KITTI_COLUMNS or not np.isfinite(row[:_KITTI_COLUMNS]).all() or abs(row[0]) >= 89.0:
            raise RunError(f"{file}: no latitude, longitude, height, roll, pitch and yaw; restore the file")
        rows.append(row[:_KITTI_COLUMNS])
    table = np.array(rows)
    latitude, longitude = np.radians(table[:, 0]), np.radians(table[:, 1])
    scale = _EARTH * np.cos(latitude[0])  # of the Mercator projection: metres on the ground
    positions = np.column_stack([scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2)), table[:, 2]])
    positions -= positions[0]
    turns = [rot_z(yaw) @ exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0]) for roll, pitch, yaw in table[:, 3:]]
    once = np.append(True, np.diff(stamps) > 0)
    return stamps[once], np.array([pose_from(R, t) for R, t in zip(turns, positions, strict=True)])[once]


def _kitti_calibration(path: Path) -> tuple[Pose, tuple[str, ...]]:
    """Return lidar <- inertial system, and a note if it is unknown."""
    name = _KITTI_CALIBRATION
    file = next((folder / name for folder in (path, path.parent) if (folder / name).is_file()), None)
    if file is None:
        return np.eye(4), (f"no {name} beside the drive: the lidar is taken to sit at the inertial system",)
    values = {}
    for line in file.read_text(encoding="ascii", errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        if name in ("R", "T"):
            try:
                values[name] = np.array([float(word) for word in numbers.split()])
            except ValueError as error:
                raise RunError(f"{file}: {name} is not a list of numbers; restore the file") from error
    if {name: value.size for name, value in values.items()} != {"R": 9, "T": 3}:
        raise RunError(f"{file}: has no R of nine and T of three numbers; restore the file")
    R = values["R"].reshape(3, 3)
    if not np.isfinite(R).all() or np.abs(R @ R.T - np.eye(3)).max() > _MAX_SKEW:
        raise RunError(f"{file}: R is not a rotation; restore the file")
    return pose_from(R, values["T"]), ()


def _mulran_poses(path: Path) -> tuple[Ints, Poses]:
    """Read stamps (N,) int64 nanoseconds, increasing, and poses (N, 4, 4)."""
    stamps, poses = [], []
    with path.open(encoding="ascii", errors="replace") as stream:
        for number, line in enumerate(stream, start=1):
            cells = line.strip().split(",")
            if cells == [""]:
                continue
            try:
                if len(cells) != _MULRAN_COLUMNS:
                    raise ValueError(f"{len(cells)} columns, {_MULRAN_COLUMNS} expected")
                stamps.append(int(cells[0]))
                values = np.array([float(cell) for cell in cells[1:]]).reshape(3, 4)
            except ValueError as error:
                raise RunError(f"{path}:{number}: no pose ({error}); restore the file") from error
            T = pose_from(values[:, :3], values[:, 3])
            if not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > _MAX_SKEW:
                raise RunError(f"{path}:{number}: its rotation is none; restore the file")
            poses.append(orthonormal(T))
    if len(poses) < 2 or (np.diff(stamps) <= 0).any():
        raise RunError(f"{path}: has fewer than two poses, or stamps that do not increase; restore the file")
    return np.array(stamps, dtype=np.int64), np.array(poses)
