"""Point cloud files: read and written by suffix, complete or not there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.cloud import LOCAL_LIMIT, Cloud
from coview_stream.clouds.e57 import require_pye57
from coview_stream.clouds.las import read_las, require_laspy
from coview_stream.clouds.laz_process import read_in_child
from coview_stream.clouds.npy_bin import read_bin, read_npy
from coview_stream.clouds.pcd import read_pcd
from coview_stream.clouds.ply import read_ply
from coview_stream.clouds.text import TEXT_SUFFIXES, read_text
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Reals


def read_e57(path: Path) -> Cloud:
    """Read an E57 file, in a process of its own; CloudError where it is damaged, DependencyError without pye57."""
    require_pye57()
    return read_in_child(path)


_READERS: dict[str, tuple[str, Callable[[Path], Cloud]]] = {
    ".las": ("LAS", read_las),
    ".laz": ("LAS", read_las),
    ".pcd": ("PCD", read_pcd),
    ".ply": ("PLY", read_ply),
    ".npy": ("NPY", read_npy),
    ".bin": ("KITTI bin", read_bin),
    ".e57": ("E57", read_e57),
    **dict.fromkeys(TEXT_SUFFIXES, ("text", read_text)),
}

CLOUD_SUFFIXES = frozenset(_READERS)
"""Suffixes, lower case with their dot, that ``read_cloud`` accepts."""

_ANY_TEXT = frozenset({".txt", ".csv"})
"""Suffixes of which a file in a folder may be anything: stamps, poses, notes."""

_MAGIC = (
    (b"LASF", "LAS"),
    (b"ply\n", "PLY"),
    (b"ply\r\n", "PLY"),
    (b"# .PCD", "PCD"),
    (b"VERSION", "PCD"),
    (b"FIELDS", "PCD"),
    (b"\x93NUMPY", "NPY"),
    (b"ASTM-E57", "E57"),
    (b"PK\x03\x04", "zip"),
    (b"\x1f\x8b", "gzip"),
    (b"\x89HDF", "HDF5"),
    (b"version https://git-lfs", "git-lfs pointer"),
)

_LAS_SCALE = 0.001  # metres


def is_cloud_name(path: str | os.PathLike[str]) -> bool:
    """Tell whether a file in a folder is a cloud by its suffix; hidden files are not, nor .txt and .csv."""
    name = Path(path).name
    return Path(name).suffix.lower() in CLOUD_SUFFIXES - _ANY_TEXT and not name.startswith(".")


def check_format(path: Path) -> str:
    """Return the format that a file's suffix names; CloudError where it is not there, or its first bytes disagree."""
    suffix = path.suffix.lower()
    head = _head(path)
    if suffix not in _READERS:
        known = ", ".join(sorted(CLOUD_SUFFIXES))
        raise CloudError(f"{path}: unknown cloud suffix {suffix!r}; convert it to one of {known}")
    name = _READERS[suffix][0]
    found = sniff(head)
    # raw float rows and text have no magic: anything that is not recognisably something else may be one
    silent = found is None and (suffix == ".bin" or (name == "text" and b"\0" not in head))
    if found != name and not silent:
        what = f"is {found}" if found else f"does not begin like {name}"
        remedy = "unpack it" if found in ("zip", "gzip") else "rename it, or get the real file"
        raise CloudError(f"{path}: named {suffix} but its content {what}; {remedy}")
    return name


def read_cloud(path: str | os.PathLike[str]) -> Cloud:
    """Read LAS, LAZ (COPC too), E57, PCD, PLY, NPY, text or KITTI ``.bin``; metres, in the file's own frame.

    The suffix names the format and the first bytes must agree with it. Rows that are not finite are dropped
    and counted, so are LAS points that are withheld or labelled as noise.

    Raises:
        CloudError: the file is missing, a directory, empty, truncated, of another or unsupported format, or
            holds no usable point. The message names the file and the remedy.
    """
    path = Path(path)
    check_format(path)
    reader = _READERS[path.suffix.lower()][1]
    try:
        return reader(path)
    except OSError as error:
        raise CloudError(f"{path}: cannot be read ({error.strerror or error}); check the disk") from error
    except MemoryError as error:
        raise CloudError(f"{path}: does not fit into memory; split it into tiles") from error


def _head(path: Path) -> bytes:
    if path.is_dir():
        raise CloudError(f"{path}: is a directory; name the cloud files themselves")
    try:
        with path.open("rb") as stream:
            head = stream.read(512)
    except FileNotFoundError as error:
        raise CloudError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CloudError(f"{path}: cannot be opened ({reason}); check path and permissions") from error
    if not head:
        raise CloudError(f"{path}: is empty (0 bytes); copy or export it again")
    return head


def sniff(head: bytes) -> str | None:
    """Return the name of the format whose magic bytes start ``head``; None if there is none."""
    for magic, name in _MAGIC:
        if head.startswith(magic):
            return name
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:1] == b"<":
        return "an HTML or XML page"
    if text.startswith(b"#") and b".PCD" in text[:80]:
        return "PCD"
    if all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in head):
        # comment lines may come before a PCD's first keyword
        return "PCD" if b"\nFIELDS" in head or b"\nVERSION" in head else "text"
    return None


def write_cloud(path: str | os.PathLike[str], points: Reals, origin: npt.ArrayLike | None = None) -> None:
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
    far = bool(len(rows)) and float(np.nanmax(np.abs(rows), initial=0.0)) > LOCAL_LIMIT
    rows = rows.astype("<f8" if far and rows.dtype == np.float64 else "<f4", copy=False)
    try:
        with atomic_file(path) as stream:
            writer(stream, np.ascontiguousarray(rows), path)
    except OSError as error:
        reason = error.strerror or error
        raise CloudError(f"{path}: cannot be written ({reason}); check the directory and the disk") from error


def _pcd(stream: BinaryIO, rows: Reals, _: Path) -> None:
    size = rows.dtype.itemsize
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\n"
        f"SIZE {size} {size} {size}\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    stream.write(header.encode("ascii"))
    stream.write(rows.tobytes())


def _ply(stream: BinaryIO, rows: Reals, _: Path) -> None:
    kind = "double" if rows.dtype.itemsize == 8 else "float"
    axes = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{axes}end_header\n"
    stream.write(header.encode("ascii"))
    stream.write(rows.tobytes())


def _npy(stream: BinaryIO, rows: Reals, _: Path) -> None:
    np.save(stream, rows, allow_pickle=False)


def _bin(stream: BinaryIO, rows: Reals, path: Path) -> None:
    if rows.dtype.itemsize == 8:
        raise CloudError(f"{path}: float32 rows cannot hold coordinates beyond 10 km; write PCD, PLY or LAZ")
    padded = np.zeros((len(rows), 4), "<f4")
    padded[:, :3] = rows
    stream.write(padded.tobytes())


def _las(stream: BinaryIO, rows: Reals, path: Path) -> None:
    laspy = require_laspy()
    if not np.isfinite(rows).all():
        raise CloudError(f"{path}: LAS cannot hold NaN or infinite coordinates; drop those rows first")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, _LAS_SCALE)
    header.offsets = np.floor(rows.min(axis=0)).astype(np.float64) if len(rows) else np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = rows.astype(np.float64).T
    las.write(stream, do_compress=path.suffix.lower() == ".laz")


_WRITERS: dict[str, Callable[[BinaryIO, Reals, Path], None]] = {
    ".pcd": _pcd,
    ".ply": _ply,
    ".npy": _npy,
    ".bin": _bin,
    ".las": _las,
    ".laz": _las,
}

WRITABLE_SUFFIXES = frozenset(_WRITERS)
"""Suffixes that ``write_cloud`` accepts."""
