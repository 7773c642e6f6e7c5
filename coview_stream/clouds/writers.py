"""Write point clouds: complete files or none."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from coview_stream.errors import CloudError

_LAS_SCALE = 0.001
_FLOAT32_LIMIT = 10_000.0

Rows = npt.NDArray[np.floating]


@contextmanager
def atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a binary stream that becomes ``path`` only if the block ends without an error.

    Raises:
        OSError: the directory does not exist or cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_cloud(
    path: str | os.PathLike[str], points: npt.NDArray[np.floating], origin: npt.ArrayLike | None = None
) -> None:
    """Write (N, 3) points in metres, shifted by a float64 ``origin`` (3,), as the suffix says.

    PCD and PLY are binary little-endian. PCD, PLY and NPY hold float32, or float64 where ``origin`` moves the
    points beyond 10 km; LAS and LAZ hold millimetres; ``.bin`` is always float32 with zero intensity.

    Raises:
        CloudError: unknown suffix, wrong shape, far coordinates for ``.bin``, or the file cannot be written.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise CloudError(f"{path}: cannot write {path.suffix!r}; use one of {', '.join(sorted(_WRITERS))}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"{path}: points have shape {points.shape}; give (N, 3)")
    rows = points
    if origin is not None and np.any(origin):
        rows = points.astype(np.float64) + np.asarray(origin, dtype=np.float64)
    far = bool(len(rows)) and float(np.nanmax(np.abs(rows), initial=0.0)) > _FLOAT32_LIMIT
    rows = rows.astype("<f8" if far and rows.dtype == np.float64 else "<f4", copy=False)
    try:
        with atomic(path) as stream:
            writer(stream, np.ascontiguousarray(rows), path)
    except OSError as error:
        reason = error.strerror or error
        raise CloudError(f"{path}: cannot be written ({reason}); check the directory and the disk") from error


def _pcd(stream: BinaryIO, rows: Rows, _: Path) -> None:
    size = rows.dtype.itemsize
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\n"
        f"SIZE {size} {size} {size}\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    stream.write(header.encode("ascii"))
    stream.write(rows.tobytes())


def _ply(stream: BinaryIO, rows: Rows, _: Path) -> None:
    kind = "double" if rows.dtype.itemsize == 8 else "float"
    axes = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{axes}end_header\n"
    stream.write(header.encode("ascii"))
    stream.write(rows.tobytes())


def _npy(stream: BinaryIO, rows: Rows, _: Path) -> None:
    np.save(stream, rows, allow_pickle=False)


def _bin(stream: BinaryIO, rows: Rows, path: Path) -> None:
    if rows.dtype.itemsize == 8:
        raise CloudError(f"{path}: float32 rows cannot hold coordinates beyond 10 km; write PCD, PLY or LAZ")
    padded = np.zeros((len(rows), 4), "<f4")
    padded[:, :3] = rows
    stream.write(padded.tobytes())


def _las(stream: BinaryIO, rows: Rows, path: Path) -> None:
    import laspy

    if not np.isfinite(rows).all():
        raise CloudError(f"{path}: LAS cannot hold NaN or infinite coordinates; drop those rows first")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, _LAS_SCALE)
    header.offsets = np.floor(rows.min(axis=0)).astype(np.float64) if len(rows) else np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = rows.astype(np.float64).T
    las.write(stream, do_compress=path.suffix.lower() == ".laz")


_WRITERS: dict[str, Callable[[BinaryIO, Rows, Path], None]] = {
    ".pcd": _pcd,
    ".ply": _ply,
    ".npy": _npy,
    ".bin": _bin,
    ".las": _las,
    ".laz": _las,
}
