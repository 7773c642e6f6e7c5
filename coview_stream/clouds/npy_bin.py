"""Files of bare rows: NPY and KITTI's ``.bin``."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Floats32, Ints

_KITTI_COLUMNS, _NUSCENES_COLUMNS = 4, 5
_COLUMNS = (3, 4, 5, 6, 7, 8)  # that files of rows may have
_COMMON_ROW = 840  # a multiple of each: all are judged by the same values
# set by hand, and looked at for 3 to 8 columns of frames of three scanners (tests/clouds/test_bin_columns.py)
_JUDGED, _MIN_JUDGED = 100_000, 3000  # values
_BINS = 64
_ALIKE = 0.9  # of the best: a multiple of the right number tells no more than that
_CLEARLY, _LEAST = 1.4, 0.02  # times as much as the expected number, and nats more
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
    """Read KITTI rows, little-endian float32 x, y, z, intensity; of ``.pcd.bin`` nuScenes', with a fifth column.

    Raises:
        CloudError: the size is no multiple of a row, or the numbers look like rows of another length.
    """
    nuscenes = path.name.lower().endswith(".pcd.bin")
    columns = _NUSCENES_COLUMNS if nuscenes else _KITTI_COLUMNS
    size = path.stat().st_size
    if size % (4 * columns):
        what = "nuScenes" if nuscenes else "KITTI"
        names = "x, y, z, intensity" + (", ring" if nuscenes else "")
        raise CloudError(
            f"{path}: {size} bytes are no multiple of a {what} row ({4 * columns} bytes: float32 {names}); "
            "truncated, or of another layout: copy it again or convert it to PCD or PLY"
        )
    values = np.fromfile(path, dtype="<f4")
    likely = likely_columns(values, columns)
    if likely != columns:
        raise CloudError(
            f"{path}: looks like rows of {likely} float32, not of {columns}; "
            f"np.save('cloud.npy', np.fromfile(name, '<f4').reshape(-1, {likely})[:, :3]) makes a file that can be read"
        )
    builder = CloudBuilder()
    builder.add(values.reshape(-1, columns)[:, :3])
    return builder.finish(os.fspath(path))


def likely_columns(values: Floats32, expected: int) -> int:
    """Guess how many columns a file of float32 rows has: those that tell most about a value (mutual information).

    Heights, intensities and rings are distributed otherwise than x and y; read with a wrong length, every column holds
    all of them alike, in whatever order the rows are. ``expected`` unless another number is clearly better.
    """
    values = values[:_JUDGED]
    values = values[: len(values) // _COMMON_ROW * _COMMON_ROW]
    if len(values) < _MIN_JUDGED:
        return expected
    edges = np.unique(np.quantile(values[np.isfinite(values)], np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    bins = np.searchsorted(edges, values, side="right")
    told = {columns: _information(bins, columns, len(edges) + 1) for columns in _COLUMNS}
    best = min(columns for columns in _COLUMNS if told[columns] > _ALIKE * max(told.values()))
    return best if told[best] > _CLEARLY * told[expected] + _LEAST else expected


def _information(bins: Ints, columns: int, count: int) -> float:
    """Return how much the column tells about the bin of a value, nats."""
    table = np.bincount(np.arange(len(bins)) % columns * count + bins, minlength=columns * count).reshape(
        columns, count
    )
    share = table / len(bins)
    apart = share.sum(axis=1, keepdims=True) * share.sum(axis=0, keepdims=True)
    known = share > 0
    return float(np.sum(share[known] * np.log(share[known] / apart[known])))
