"""When and by which beam each point was measured: per-point fields of the usual lidar drivers.

The meaning of a time follows from its type and size:

================================  =========  ==================================================
name, and who writes it           type       meaning
================================  =========  ==================================================
``time`` (Velodyne)               float32    seconds after the stamp
``t`` (Ouster)                    uint32     nanoseconds after the stamp
``offset_time`` (Livox)           uint32     nanoseconds after the stamp
``timestamp`` (Hesai, RoboSense)  float64    seconds on the stamp's clock
``timestamp`` (Livox driver 2)    float64    nanoseconds on the stamp's clock
``time_offset``, others above     float64    seconds after the stamp, if on no clock near the stamp
``ring``, ``line``, ``channel``   any        number of the beam; floats too, if they are whole
================================  =========  ==================================================

Any of the time names may carry any of these types (int32 as uint32). Times farther than 1 s from the stamp, or spanning
more than 1 s, are not understood, and none are better than wrong ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Points

Times = npt.NDArray[np.float64]
Rings = npt.NDArray[np.uint16]

TIME_NAMES = ("time", "t", "time_offset", "offset_time", "timestamp")
RING_NAMES = ("ring", "line", "channel")
_LONGEST = 1.0  # seconds: no lidar frame lasts longer


def times_from(values: npt.NDArray[Any], points: Points, stamp_ns: int) -> Times | None:
    """(N,) seconds after ``stamp_ns``; 0 where a point is not finite. None if they make no sense."""
    measured = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2])  # many times faster than all(axis=1)
    complete = bool(measured.all())
    if not measured.any():
        return None
    for candidate in _meanings(values, stamp_ns):
        seen = candidate if complete else candidate[measured]
        low, high = float(seen.min()), float(seen.max())  # NaN fails the comparisons below
        if low >= -_LONGEST and high <= _LONGEST and high - low <= _LONGEST:
            return candidate if complete else np.where(measured, candidate, 0.0)
    return None


def _meanings(values: npt.NDArray[Any], stamp_ns: int) -> list[Times]:
    """Seconds after the stamp in every sense that the type allows, likeliest first."""
    seconds = values.astype(np.float64)
    if values.dtype.kind in "ui":
        return [1e-9 * seconds] if values.dtype.itemsize == 4 else []
    if values.dtype.itemsize == 4:
        return [seconds]
    return [seconds - 1e-9 * stamp_ns, 1e-9 * (seconds - stamp_ns), seconds]


def rings_from(values: npt.NDArray[Any]) -> Rings | None:
    """(N,) beam numbers; None if they are no whole numbers in the uint16 range."""
    if values.dtype.kind == "f" and not np.array_equal(values, np.trunc(values)):  # NaN fails it as well
        return None
    if len(values) and (values.min() < 0 or values.max() > np.iinfo(np.uint16).max):
        return None
    return values.astype(np.uint16)
