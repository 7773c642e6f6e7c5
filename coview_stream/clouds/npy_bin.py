"""Files of bare rows: NPY and KITTI's ``.bin``."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.errors import CloudError

_KITTI_ROW = 16  # bytes
_CHUNK = 1_000_000  # rows


def read_npy(path: Path) -> Cloud:
    """Read an (N, 3 or more) array of numbers whose first three columns are x, y and z in metres.

    Raises:
        CloudError: the file is damaged, truncated, holds objects, or is of another shape or type.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:  # NumPy parses the header as Python, so anything may come out of a damaged one
        reason = " ".join(str(error).split())[:120]
        raise CloudError(f"{path}: damaged or truncated NPY ({reason}); save the array again") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise CloudError(f"{path}: NPY does not hold an array of numbers; save (N, 3) floats")
    if array.ndim != 2 or array.shape[1] < 3:
        raise CloudError(f"{path}: NPY array has shape {array.shape}; save (N, 3) floats with columns x, y, z")
    builder = CloudBuilder()
    wide = np.float32 if array.dtype == np.float32 else np.float64
    for start in range(0, len(array), _CHUNK):
        builder.add(np.array(array[start : start + _CHUNK, :3], dtype=wide))
    return builder.finish(os.fspath(path))


def read_bin(path: Path) -> Cloud:
    """Read KITTI rows: little-endian float32 x, y, z, intensity.

    Raises:
        CloudError: the size is no multiple of 16 bytes, or the content is text.
    """
    size = path.stat().st_size
    if size % _KITTI_ROW:
        raise CloudError(
            f"{path}: {size} bytes are no multiple of a KITTI row (16 bytes: float32 x, y, z, intensity); "
            "truncated, or of another layout: copy it again or convert it to PCD or PLY"
        )
    rows = np.fromfile(path, dtype="<f4").reshape(-1, 4)
    builder = CloudBuilder()
    builder.add(rows[:, :3])
    return builder.finish(os.fspath(path))
