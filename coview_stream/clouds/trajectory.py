"""Trajectories as text: TUM (``t x y z qx qy qz qw``) and KITTI (3x4 matrices, with separate times)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import InputError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, Poses, nearest_rotation, pose_to_tum, quat_to_matrix
from coview_stream.geometry.validation import MAX_COORDINATE

_TUM_COLUMNS = 8
_MIN_QUATERNION_NORM = 1e-6
_ROTATION_TOLERANCE = 1e-2  # greatest element of R R^T - I


def read_tum(path: str | os.PathLike[str]) -> tuple[Floats, Poses]:
    """Read stamps (N,) in seconds and poses (N, 4, 4) in metres from a TUM file; N may be 0.

    Blank lines and lines that start with ``#`` are skipped; quaternions need not be normalised. RunError names a line
    with text, a wrong number of columns, NaN, a zero quaternion or a stamp that does not increase.
    """
    path = Path(path)
    rows, lines = _read_rows(path, _TUM_COLUMNS, "t x y z qx qy qz qw")
    stamps, quaternions = rows[:, 0], rows[:, 4:]
    check_stamps(stamps, lines, path)
    short = np.linalg.norm(quaternions, axis=1) < _MIN_QUATERNION_NORM
    if short.any():
        raise RunError(f"{path}:{lines[int(np.argmax(short))]}: quaternion is zero; write qx qy qz qw")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        poses[:, :3, :3] = quat_to_matrix(quaternions)
    poses[:, :3, 3] = rows[:, 1:4]
    return stamps, poses


def read_kitti_poses(path: str | os.PathLike[str]) -> Poses:
    """Read poses (N, 4, 4) from a KITTI file, 12 numbers per line; RunError as in ``read_tum``, or for no rotation."""
    path = Path(path)
    rows, lines = _read_rows(path, 12, "the 3x4 pose, row by row")
    parts = rows.reshape(-1, 3, 4)
    R = parts[:, :, :3]
    wrong = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > _ROTATION_TOLERANCE
    wrong |= np.linalg.det(R) <= 0
    if wrong.any():
        raise RunError(f"{path}:{lines[int(np.argmax(wrong))]}: the 3x3 part is not a rotation; check the columns")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        poses[:, :3, :3] = nearest_rotation(R)
    poses[:, :3, 3] = parts[:, :, 3]
    return poses


def read_times(path: str | os.PathLike[str]) -> Floats:
    """Read increasing stamps (N,) in seconds, one per line; RunError as in ``read_tum``."""
    path = Path(path)
    rows, lines = _read_rows(path, 1, "one stamp in seconds")
    check_stamps(rows[:, 0], lines, path)
    return rows[:, 0]


def write_tum(path: str | os.PathLike[str], stamps: Sequence[float] | Floats, poses: Sequence[Pose] | Poses) -> None:
    """Write stamps (N,) in seconds and poses (N, 4, 4) in metres, atomically.

    InputError if the lengths differ, or the file cannot be written.
    """
    path = Path(path)
    if len(stamps) != len(poses):
        raise InputError(f"{path}: {len(stamps)} stamps for {len(poses)} poses; give as many of both")
    lines = []
    for stamp, T in zip(stamps, poses, strict=True):
        x, y, z, qx, qy, qz, qw = pose_to_tum(np.asarray(T, dtype=np.float64))
        lines.append(f"{stamp:.6f} {x:.6f} {y:.6f} {z:.6f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}\n")
    try:
        with atomic_file(path) as stream:
            stream.write("".join(lines).encode("ascii"))
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be written ({reason}); check the directory and the disk") from error


def check_stamps(stamps: Floats, lines: Sequence[int], path: Path) -> None:
    """Raise RunError at the first stamp that does not increase."""
    late = np.diff(stamps) <= 0
    if late.any():
        at = int(np.argmax(late)) + 1
        verb = "repeats" if stamps[at] == stamps[at - 1] else "comes before"
        raise RunError(
            f"{path}:{lines[at]}: stamp {stamps[at]:.6f} {verb} the one of the line before; "
            "give each frame the time at which it was measured, in order"
        )


def columns_of(path: Path) -> int:
    """Count the columns in the first line with content; 0 if there is none."""
    return next((len(words) for _, words in _words(path)), 0)


def _words(path: Path) -> list[tuple[int, list[str]]]:
    """Return (line number, words) of all lines except blank lines and comments."""
    try:
        text = path.read_bytes().decode("ascii")
    except FileNotFoundError as error:
        raise RunError(f"{path}: no such file; check the path") from error
    except IsADirectoryError as error:
        raise RunError(f"{path}: is a directory; name the trajectory file") from error
    except UnicodeDecodeError as error:
        raise RunError(f"{path}: is not text; give a trajectory as numbers in lines") from error
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: cannot be read ({error}); check path and permissions") from error
    numbered = ((number, line.split()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, words) for number, words in numbered if words and not words[0].startswith("#")]


def _read_rows(path: Path, columns: int, meaning: str) -> tuple[Floats, list[int]]:
    rows, lines = [], []
    for number, words in _words(path):
        if len(words) != columns:
            raise RunError(f"{path}:{number}: {len(words)} columns instead of {columns}; each line is {meaning}")
        try:
            rows.append(list(map(float, words)))
        except ValueError as error:
            raise RunError(f"{path}:{number}: not a number ({error}); each line is {meaning}") from error
        lines.append(number)
    table = np.array(rows, dtype=np.float64).reshape(-1, columns)
    # stamps may be any finite number
    absurd = ~np.isfinite(table).all(axis=1) | (np.abs(table[:, 1:]) > MAX_COORDINATE).any(axis=1)
    if absurd.any():
        number = lines[int(np.argmax(absurd))]
        raise RunError(f"{path}:{number}: NaN, infinite or absurd number; repair or drop the line")
    return table, lines
