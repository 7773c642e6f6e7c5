"""Read a point cloud of any supported format, or say in one line why not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from coview_stream.clouds.cloud import Cloud
from coview_stream.clouds.las import read_las
from coview_stream.clouds.pcd import read_pcd
from coview_stream.clouds.plain import read_bin, read_npy
from coview_stream.clouds.ply import read_ply
from coview_stream.errors import CloudError

_READERS: dict[str, tuple[str, Callable[[Path], Cloud]]] = {
    ".las": ("LAS", read_las),
    ".laz": ("LAS", read_las),
    ".pcd": ("PCD", read_pcd),
    ".ply": ("PLY", read_ply),
    ".npy": ("NPY", read_npy),
    ".bin": ("KITTI bin", read_bin),
}

CLOUD_SUFFIXES = frozenset(_READERS)
"""Suffixes, lower case with their dot, that ``read_cloud`` accepts."""

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


def is_cloud_name(path: str | os.PathLike[str]) -> bool:
    """Whether the suffix is one that ``read_cloud`` accepts (hidden files are not clouds)."""
    name = Path(path).name
    return Path(name).suffix.lower() in CLOUD_SUFFIXES and not name.startswith(".")


def read_cloud(path: str | os.PathLike[str]) -> Cloud:
    """Read LAS, LAZ (COPC too), PCD, PLY, NPY or KITTI ``.bin``; metres, in the file's own frame.

    The suffix names the format and the first bytes must agree with it. Rows that are not finite are dropped
    and counted, so are LAS points that are withheld or labelled as noise.

    Raises:
        CloudError: the file is missing, a directory, empty, truncated, of another or unsupported format, or
            holds no usable point. The message names the file and the remedy.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    head = _head(path)
    if suffix == ".e57" or head.startswith(b"ASTM-E57"):
        raise CloudError(f"{path}: E57 is not supported yet: convert it to LAZ or PLY")
    if suffix not in _READERS:
        known = ", ".join(sorted(CLOUD_SUFFIXES))
        raise CloudError(f"{path}: unknown cloud suffix {suffix!r}; convert it to one of {known}")
    name, reader = _READERS[suffix]
    found = sniff(head)
    # raw float rows have no magic: anything that is not recognisably something else may be one
    if found != name and not (suffix == ".bin" and found is None):
        what = f"is {found}" if found else f"does not begin like {name}"
        remedy = "unpack it" if found in ("zip", "gzip") else "rename it, or get the real file"
        raise CloudError(f"{path}: named {suffix} but its content {what}; {remedy}")
    try:
        return reader(path)
    except OSError as error:
        raise CloudError(f"{path}: cannot be read ({error.strerror or error}); check the disk") from error
    except MemoryError as error:
        raise CloudError(f"{path}: does not fit into memory; split it into tiles") from error


def _head(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise CloudError(f"{path}: is a directory; name the cloud files themselves")
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
    """Name of the format whose magic bytes start ``head``; None if they say nothing."""
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
