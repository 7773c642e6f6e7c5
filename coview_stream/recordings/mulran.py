"""MulRan's folders: Ouster sweeps named by their stamps, and poses of the vehicle in ``global_pose.csv``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.errors import RunError
from coview_stream.geometry.arrays import Ints
from coview_stream.geometry.transforms import Poses, interpolate, orthonormal, pose_from
from coview_stream.recordings.run import Run

_FOLDERS = ("sensor_data/Ouster", "Ouster")
_POSES = "global_pose.csv"
_COLUMNS = 13  # stamp and the first three rows of world <- vehicle
_MAX_GAP = 0.5  # seconds between two poses; set by hand
_LAST_DIGITS = 1e-3  # that poses may be off an exact rotation; set by hand


def find_sweeps(path: Path) -> Path | None:
    """Return the folder of the sweeps, if ``path`` is such a run."""
    return next((path / each for each in _FOLDERS if path.is_dir() and (path / each).is_dir()), None)


def open_mulran(path: Path, sweeps: Path, mount: Mount | None = None) -> Run:
    """Open a run; sweeps outside the poses, or in a gap of them, are left out and counted in its notes.

    The poses are the vehicle's, and the clouds the lidar's: give the lidar's place by ``mount`` (``--mount``).

    Raises:
        RunError: there are no sweeps, no poses, or lines that are none; the message names file and line.
    """
    poses_file = next((each for each in (path / _POSES, sweeps.parent / _POSES) if each.is_file()), None)
    if poses_file is None:
        raise RunError(f"{path / _POSES}: no such file; MulRan's sweeps need it for their odometry")
    files = sorted((file for file in sweeps.glob("*.bin") if file.stem.isdecimal()), key=lambda file: int(file.stem))
    if not files:
        raise RunError(f"{sweeps}: no sweeps named by their stamps (1564718964270138112.bin)")
    stamps_ns, T = _poses(poses_file)
    wanted = np.array([int(file.stem) for file in files], dtype=np.int64)
    after = np.searchsorted(stamps_ns, wanted)
    inside = (after > 0) & (after < len(stamps_ns))
    gap = np.full(len(wanted), np.inf)
    gap[inside] = (stamps_ns[after[inside]] - stamps_ns[after[inside] - 1]) * 1e-9
    kept = gap <= _MAX_GAP
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


def _poses(path: Path) -> tuple[Ints, Poses]:
    """Read stamps (N,) int64 nanoseconds and poses (N, 4, 4), increasing."""
    stamps, rows = [], []
    with path.open(encoding="ascii", errors="replace") as stream:
        for number, line in enumerate(stream, start=1):
            cells = line.strip().split(",")
            if cells == [""]:
                continue
            try:
                if len(cells) != _COLUMNS:
                    raise ValueError(f"{len(cells)} columns, {_COLUMNS} expected")
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
