"""MulRan's folders: Ouster sweeps named by their stamps, and poses of the vehicle in ``global_pose.csv``."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.errors import RunError
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Pose, Poses, exp_so3, interpolate, inverse, orthonormal, pose_from, rot_z
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


_SWEEP_FOLDERS = ("sensor_data/Ouster", "Ouster")
_POSE_FILE = "global_pose.csv"
_POSE_COLUMNS = 13  # stamp and the first three rows of world <- vehicle
_MAX_POSE_GAP = 0.5  # seconds between two poses; set by hand
_LAST_DIGITS = 1e-3  # that poses may be off an exact rotation; set by hand


def find_sweeps(path: Path) -> Path | None:
    """Return the folder of the sweeps, if ``path`` is such a run."""
    return next((path / each for each in _SWEEP_FOLDERS if path.is_dir() and (path / each).is_dir()), None)


def open_mulran(path: Path, sweeps: Path, mount: Mount | None = None) -> Run:
    """Open a run; sweeps outside the poses, or in a gap of them, are left out and counted in its notes.

    The poses are the vehicle's, and the clouds the lidar's: give the lidar's place by ``mount`` (``--mount``).

    Raises:
        RunError: there are no sweeps, no poses, or lines that are none; the message names file and line.
    """
    poses_file = next((each for each in (path / _POSE_FILE, sweeps.parent / _POSE_FILE) if each.is_file()), None)
    if poses_file is None:
        raise RunError(f"{path / _POSE_FILE}: no such file; MulRan's sweeps need it for their odometry")
    files = sorted((file for file in sweeps.glob("*.bin") if file.stem.isdecimal()), key=lambda file: int(file.stem))
    if not files:
        raise RunError(f"{sweeps}: no sweeps named by their stamps (1564718964270138112.bin)")
    stamps_ns, T = _mulran_poses(poses_file)
    wanted = np.array([int(file.stem) for file in files], dtype=np.int64)
    after = np.searchsorted(stamps_ns, wanted)
    inside = (after > 0) & (after < len(stamps_ns))
    gap = np.full(len(wanted), np.inf)
    gap[inside] = (stamps_ns[after[inside]] - stamps_ns[after[inside] - 1]) * 1e-9
    kept = gap <= _MAX_POSE_GAP
    if not kept.any():
        raise RunError(f"{path}: none of {len(files)} sweeps has a pose around its stamp in {poses_file.name}")
    end = after[kept]
    share = (wanted[kept] - stamps_ns[end - 1]) / (stamps_ns[end] - stamps_ns[end - 1])
    between: Poses = np.asarray(interpolate(T[end - 1], T[end], share), dtype=np.float64)
    left_out = int(len(files) - kept.sum())
    notes = (f"{left_out} of {len(files)} sweeps have no pose around them in {poses_file.name} and are left out",)
    chosen = tuple(file for file, keep in zip(files, kept, strict=True) if keep)
    return Run(
        path,
        chosen,
        np.asarray(wanted[kept] * 1e-9, dtype=np.float64),
        between,
        notes=notes if left_out else (),
        mount=mount,
    )


def _mulran_poses(path: Path) -> tuple[Ints, Poses]:
    """Read stamps (N,) int64 nanoseconds and poses (N, 4, 4), increasing."""
    stamps, rows = [], []
    with path.open(encoding="ascii", errors="replace") as stream:
        for number, line in enumerate(stream, start=1):
            cells = line.strip().split(",")
            if cells == [""]:
                continue
            try:
                if len(cells) != _POSE_COLUMNS:
                    raise ValueError(f"{len(cells)} columns, {_POSE_COLUMNS} expected")
                stamps.append(int(cells[0]))
                values = np.array([float(cell) for cell in cells[1:]]).reshape(3, 4)
            except ValueError as error:
                raise RunError(f"{path}:{number}: no pose ({error}); restore the file") from error
            T = pose_from(values[:, :3], values[:, 3])
            if not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > _LAST_DIGITS:
                raise RunError(f"{path}:{number}: its rotation is none; restore the file")
            rows.append(orthonormal(T))
    if len(rows) < 2 or (np.diff(stamps) <= 0).any():
        raise RunError(f"{path}: has fewer than two poses, or stamps that do not increase; restore the file")
    return np.array(stamps, dtype=np.int64), np.array(rows)
