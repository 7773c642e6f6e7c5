"""Drives of KITTI's raw data: Velodyne sweeps, and odometry out of the poses of the car's inertial system (OXTS).

The poses are by satellite and inertia. Only how they change counts: the first lies at zero, and the heading there is
kept, so that the odometry frame is level. Nothing is read as the truth.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.errors import RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, Poses, exp_so3, interpolate, inverse, pose_from, rot_z
from coview_stream.recordings.run import Run

_SWEEPS, _INERTIAL = "velodyne_points", "oxts"
_CALIBRATION = "calib_imu_to_velo.txt"
_EARTH = 6_378_137.0  # metres, of the sphere that the data's own tools take
_COLUMNS = 6  # latitude, longitude, height, roll, pitch, yaw; more follow
_MAX_GAP = 0.5  # seconds between two poses; set by hand


def is_kitti_raw(path: Path) -> bool:
    """Tell whether a directory is such a drive."""
    return (path / _SWEEPS / "data").is_dir()


def open_kitti_raw(path: Path, mount: Mount | None = None) -> Run:
    """Open a drive; sweeps without poses around their stamps are left out and counted in its notes.

    The body is the lidar where ``calib_imu_to_velo.txt`` lies beside the drive or in the folder of its day; otherwise
    the lidar is taken to sit at the inertial system.

    Raises:
        RunError: no sweeps, no poses, or a line that is none; the message names file and line.
    """
    files = sorted(file for file in (path / _SWEEPS / "data").glob("*.bin") if file.stem.isdecimal())
    if not files:
        raise RunError(f"{path / _SWEEPS / 'data'}: no sweeps (0000000000.bin); unpack the drive's velodyne_points")
    stamps = _stamps(path / _SWEEPS / "timestamps.txt")
    if int(files[-1].stem) >= len(stamps):
        raise RunError(
            f"{path / _SWEEPS / 'timestamps.txt'}: has {len(stamps)} stamps, and sweep {files[-1].name} none"
        )
    when = stamps[[int(file.stem) for file in files]]
    known, T_odom_imu = _inertial_poses(path / _INERTIAL)
    T_velo_imu, note = _calibration(path)
    after = np.clip(np.searchsorted(known, when, side="left"), 1, len(known) - 1)
    inside = (when >= known[0]) & (when <= known[-1]) & (known[after] - known[after - 1] <= _MAX_GAP)
    if not inside.any():
        raise RunError(f"{path}: none of {len(files)} sweeps has a pose around its stamp in {_INERTIAL}")
    end = after[inside]
    share = (when[inside] - known[end - 1]) / (known[end] - known[end - 1])
    between: Poses = np.asarray(interpolate(T_odom_imu[end - 1], T_odom_imu[end], share), dtype=np.float64)
    left_out = len(files) - int(inside.sum())
    notes = [f"{left_out} of {len(files)} sweeps have no pose around them in {_INERTIAL} and are left out"] * (
        left_out > 0
    )
    return Run(
        path,
        tuple(file for file, keep in zip(files, inside, strict=True) if keep),
        when[inside],
        between @ inverse(T_velo_imu),
        notes=(*notes, *note),
        mount=mount,
    )


def _stamps(path: Path) -> Floats:
    """Read stamps (N,) seconds, one a line: ``2011-09-26 13:02:25.964389445``."""
    found = []
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
            found.append(seconds + (float(f"0.{int(fraction):0{len(fraction)}d}") if fraction else 0.0))
        except ValueError as error:
            raise RunError(f"{path}:{number}: no stamp ({error}); restore the file") from error
    if not found or (np.diff(found) < 0).any():
        raise RunError(f"{path}: has no stamps, or some that go back; restore the file")
    return np.array(found)


def _inertial_poses(folder: Path) -> tuple[Floats, Poses]:
    """Read stamps (N,) seconds and poses (N, 4, 4) of the inertial system, the first position at zero."""
    files = sorted((folder / "data").glob("*.txt"))
    stamps = _stamps(folder / "timestamps.txt")
    if len(files) != len(stamps) or len(files) < 2:
        raise RunError(f"{folder}: {len(files)} poses and {len(stamps)} stamps; unpack the drive's oxts whole")
    rows = []
    for file in files:
        try:
            row = [float(word) for word in file.read_text(encoding="ascii").split()]
        except (OSError, ValueError) as error:
            raise RunError(f"{file}: no pose ({error}); restore the file") from error
        if len(row) < _COLUMNS or not np.isfinite(row[:_COLUMNS]).all() or abs(row[0]) >= 89.0:
            raise RunError(f"{file}: no latitude, longitude, height, roll, pitch and yaw; restore the file")
        rows.append(row[:_COLUMNS])
    table = np.array(rows)
    latitude, longitude = np.radians(table[:, 0]), np.radians(table[:, 1])
    scale = _EARTH * np.cos(latitude[0])  # of Mercator's projection there: metres on the ground
    places = np.column_stack([scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2)), table[:, 2]])
    places -= places[0]
    turns = [rot_z(yaw) @ exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0]) for roll, pitch, yaw in table[:, 3:]]
    once = np.append(True, np.diff(stamps) > 0)
    return stamps[once], np.array([pose_from(R, t) for R, t in zip(turns, places, strict=True)])[once]


def _calibration(path: Path) -> tuple[Pose, tuple[str, ...]]:
    """Return lidar <- inertial system, and a note where it is not known."""
    file = next((each / _CALIBRATION for each in (path, path.parent) if (each / _CALIBRATION).is_file()), None)
    if file is None:
        return np.eye(4), (f"no {_CALIBRATION} beside the drive: the lidar is taken to sit at the inertial system",)
    values = {}
    for line in file.read_text(encoding="ascii", errors="replace").splitlines():
        name, _, numbers = line.partition(":")
        if name in ("R", "T"):
            try:
                values[name] = np.array([float(word) for word in numbers.split()])
            except ValueError as error:
                raise RunError(f"{file}: {name} is no list of numbers; restore the file") from error
    if {name: value.size for name, value in values.items()} != {"R": 9, "T": 3}:
        raise RunError(f"{file}: has no R of nine and T of three numbers; restore the file")
    R = values["R"].reshape(3, 3)
    if not np.isfinite(R).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
        raise RunError(f"{file}: R is no rotation; restore the file")
    return pose_from(R, values["T"]), ()
