"""Point cloud files: found by name, read and (atomically) written in the format of their suffix."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from coview_stream.clouds import las
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.cloud import LOCAL_LIMIT, Cloud, CloudBuilder
from coview_stream.clouds.decode import decode_in_child
from coview_stream.clouds.e57 import require_pye57
from coview_stream.clouds.pcd import read_pcd
from coview_stream.clouds.ply import read_ply
from coview_stream.clouds.rows import TEXT_SUFFIXES, read_bin, read_npy, read_text, suffix_of
from coview_stream.clouds.survey_unit import InMetres, SurveyUnit
from coview_stream.errors import CloudError, warn
from coview_stream.geometry.arrays import Reals

_FORMATS = {
    ".las": "LAS", ".laz": "LAS", ".pcd": "PCD", ".ply": "PLY", ".npy": "NPY", ".bin": "KITTI bin", ".e57": "E57",
    **dict.fromkeys(TEXT_SUFFIXES, "text"),
}  # fmt: skip
_WHOLE_READERS: dict[str, Callable[[Path], Cloud]] = {
    "PCD": read_pcd, "PLY": read_ply, "NPY": read_npy, "KITTI bin": read_bin, "text": read_text,
}  # fmt: skip

CLOUD_SUFFIXES = frozenset(_FORMATS)
"""Suffixes that ``read_cloud`` accepts, lower case with the dot."""

_ANY_TEXT = frozenset({".txt", ".csv", ".txt.gz", ".csv.gz"})  # in a folder such files may be stamps, poses or notes

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
_FORMAT_BYTE = 104  # of a LAS header


def is_cloud_name(path: str | os.PathLike[str]) -> bool:
    """Return whether a file in a folder is a cloud by its suffix; .txt, .csv and hidden files do not count."""
    name = Path(path).name
    return suffix_of(Path(name)) in CLOUD_SUFFIXES - _ANY_TEXT and not name.startswith(".")


def expand_cloud_paths(given: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the files for names, folders and patterns (``tiles/*.laz``), in natural order within each.

    A folder gives the clouds directly in it, by suffix, with a warning if its subfolders have clouds. A named file may
    have any suffix; its reader checks it. CloudError if a folder or a pattern has no cloud.
    """
    out: list[Path] = []
    for path in map(Path, given):
        if path.is_dir():
            files = sorted(filter(is_cloud_name, path.iterdir()), key=natural_key)
            within = next(filter(is_cloud_name, path.glob("*/**/*")), None)
            if not files:
                remedy = f"did you mean {within.parent}?" if within else "name another folder, or the files"
                raise CloudError(f"{path}: holds no cloud ({', '.join(sorted(CLOUD_SUFFIXES))}); {remedy}")
            if within:
                warn(f"{path}: clouds in subfolders, such as {within}, are not read; '{path}/**/*' names all")
            out += files
        elif not path.exists() and glob.has_magic(str(path)):  # the shell has not expanded it
            names = glob.glob(str(path), recursive=True)  # noqa: PTH207 - Path.glob takes no absolute pattern
            files = sorted(map(Path, names), key=natural_key)
            out += [file for file in files if is_cloud_name(file) and file.is_file()]
            if not any(map(is_cloud_name, files)):
                raise CloudError(f"{path}: no cloud has such a name; check the pattern")
        else:
            out.append(path)
    return out


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Return a sorting key that puts ``tile2`` before ``tile10``."""
    parts = re.split(r"(\d+)", str(path))
    return tuple((1, int(part), "") if k % 2 else (0, 0, part) for k, part in enumerate(parts))


def suffix_of_content(head: bytes) -> str | None:
    """Return the suffix for a cloud's first bytes, by default the suffix of text; None if they are not a cloud's."""
    content = sniff(head)
    if content == "gzip":
        return ".xyz.gz"
    if content is None:
        return ".xyz" if head.strip() and b"\0" not in head else None
    return next((suffix for suffix, name in _FORMATS.items() if name == content), None)


def check_format(path: Path) -> str:
    """Return the format for a file's suffix; CloudError if the first bytes belong to another format."""
    suffix = suffix_of(path)
    head = _head(path)
    if suffix not in _FORMATS:
        known = ", ".join(sorted(CLOUD_SUFFIXES))
        raise CloudError(f"{path}: unknown cloud suffix {suffix!r}; convert it to one of {known}")
    name = _FORMATS[suffix]
    content = sniff(head)
    # raw float rows and text have no magic bytes
    unmarked = content is None and (suffix == ".bin" or (name == "text" and b"\0" not in head))
    expected = "gzip" if suffix.endswith(".gz") else name
    if content != expected and not (unmarked and expected == name):
        reason = f"is {content}" if content else f"does not begin like {name}"
        remedy = "unpack it" if content in ("zip", "gzip") else "rename it, or get the real file"
        raise CloudError(f"{path}: named {suffix} but its content {reason}; {remedy}")
    return name


def read_cloud(path: str | os.PathLike[str]) -> Cloud:
    """Read LAS, LAZ (COPC too), E57, PCD, PLY, NPY, text or KITTI ``.bin``; metres, in the file's own frame.

    The suffix names the format, and the first bytes must agree with it. Rows that are not finite are dropped and
    counted, as are LAS points that are withheld or labelled as noise.

    Raises:
        CloudError: the file is missing, a directory, empty or truncated, has another or an unsupported format, or has
            no usable point. The message names the file and the remedy.
    """
    path = Path(path)
    try:
        kind = check_format(path)
        if kind in _WHOLE_READERS:
            return _WHOLE_READERS[kind](path)
        builder = CloudBuilder()
        _decode(path, kind, builder)
        return builder.finish(os.fspath(path))
    except OSError as error:
        raise CloudError(f"{path}: cannot be read ({error.strerror or error}); check the disk") from error
    except MemoryError as error:
        raise CloudError(f"{path}: does not fit into memory; split it into tiles") from error


def stream_cloud(path: Path, builder: CloudBuilder, unit: SurveyUnit | None = None) -> str | None:
    """Pass a file's raw points, float64 metres, to a builder; return the reference system, if the file states one.

    ``unit`` is for a file that states none. LAS, LAZ and E57 are read in chunks; other formats are read whole first.
    CloudError as in :func:`read_cloud`, but not for LAS, LAZ or E57 without points.
    """
    kind = check_format(path)
    builder = builder if unit is None else InMetres(builder, unit)
    if kind in _WHOLE_READERS:
        cloud = read_cloud(path)
        builder.add(cloud.map_points(), cloud.classification, cloud.dropped)
        return cloud.crs
    _decode(path, kind, builder)
    return builder.crs


def _decode(path: Path, kind: str, builder: CloudBuilder) -> None:
    # report a missing library here, not from the child
    require = las.require_laspy if kind == "LAS" else require_pye57
    require()
    if kind == "E57" or _head(path)[_FORMAT_BYTE : _FORMAT_BYTE + 1] >= b"\x80":  # the bit that marks compressed points
        decode_in_child(path, builder)
    else:
        las.decode(path, builder)


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
    """Return the name of the format whose magic bytes begin ``head``; None for other bytes."""
    for magic, name in _MAGIC:
        if head.startswith(magic):
            return name
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:1] == b"<":
        return "an HTML or XML page"
    if text.startswith(b"#") and b".PCD" in text[:80]:
        return "PCD"
    if all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in head):
        # comment lines may precede a PCD's first keyword
        return "PCD" if b"\nFIELDS" in head or b"\nVERSION" in head else "text"
    return None


def write_cloud(path: str | os.PathLike[str], points: Reals, origin: npt.ArrayLike | None = None) -> None:
    """Write (N, 3) points in metres, shifted by a float64 ``origin`` (3,), in the format of the suffix.

    PCD and PLY are binary little-endian. PCD, PLY and NPY hold float32, or float64 if shifted float64 points
    reach beyond 10 km; LAS and LAZ hold millimetres; ``.bin`` is always float32 with zero intensity.

    CloudError for an unknown suffix, a wrong shape, coordinates that the format cannot hold, or a failed write.
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


def _write_pcd(stream: BinaryIO, rows: Reals, _: Path) -> None:
    size = rows.dtype.itemsize
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\n"
        f"SIZE {size} {size} {size}\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    stream.write(header.encode("ascii") + rows.tobytes())


def _write_ply(stream: BinaryIO, rows: Reals, _: Path) -> None:
    kind = "double" if rows.dtype.itemsize == 8 else "float"
    axes = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{axes}end_header\n"
    stream.write(header.encode("ascii") + rows.tobytes())


def _write_bin(stream: BinaryIO, rows: Reals, path: Path) -> None:
    if rows.dtype.itemsize == 8:
        raise CloudError(f"{path}: float32 rows cannot hold coordinates beyond 10 km; write PCD, PLY or LAZ")
    padded = np.zeros((len(rows), 4), "<f4")
    padded[:, :3] = rows
    stream.write(padded.tobytes())


def _write_las(stream: BinaryIO, rows: Reals, path: Path) -> None:
    laspy = las.require_laspy()
    if not np.isfinite(rows).all():
        raise CloudError(f"{path}: LAS cannot hold NaN or infinite coordinates; drop those rows first")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, _LAS_SCALE)
    header.offsets = np.floor(rows.min(axis=0)).astype(np.float64) if len(rows) else np.zeros(3)
    record = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
    record.x, record.y, record.z = rows.astype(np.float64).T
    with las.las_writer(stream, header, path) as writer:
        writer.write_points(record)


_WRITERS: dict[str, Callable[[BinaryIO, Reals, Path], None]] = {
    ".pcd": _write_pcd, ".ply": _write_ply, ".npy": lambda stream, rows, _: np.save(stream, rows, allow_pickle=False),
    ".bin": _write_bin, ".las": _write_las, ".laz": _write_las,
}  # fmt: skip

WRITABLE_SUFFIXES = frozenset(_WRITERS)
"""Suffixes that ``write_cloud`` accepts."""
