"""What a frame must be before anything is registered: a wrong one costs an error here, and the local map beyond."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.errors import CloudError
from coview_stream.geometry import Points, lengths
from coview_stream.odometry.config import LidarOdometryConfig

Times = npt.NDArray[np.float64]

_INSTANT = 1e-4  # seconds: times that differ by less are one
_LONGEST_SWEEP = 1.0  # seconds from the stamp: points farther away in time have another clock


def checked(points: Points, times: Times | None, config: LidarOdometryConfig) -> tuple[Points, Times | None]:
    """Finite points (N, 3) float32, and their times (N,).

    Raises:
        CloudError: another shape, times that are not one per point, or too few points in range.
    """
    try:
        with np.errstate(over="ignore"):
            rows = np.asarray(points).astype(np.float32)  # a copy: the caller may write the next frame there
        at = None if times is None else np.asarray(times, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CloudError(f"frame is not an array of numbers ({error}); expected (N, 3) float32") from error
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise CloudError(f"frame has shape {rows.shape}; expected (N, 3)")
    if at is not None and at.shape != (len(rows),):
        raise CloudError(
            f"frame has {len(rows)} points and times of shape {at.shape}; give one time per point"
        )
    finite: npt.NDArray[np.bool_] = np.all(np.isfinite(rows), axis=1)
    if not finite.all():
        rows, at = rows[finite], None if at is None else at[finite]
    with np.errstate(over="ignore"):
        ranges = lengths(rows)
    usable = int(((ranges > config.min_range) & (ranges < config.max_range)).sum())
    if usable < config.least_points:
        raise CloudError(
            f"frame has {usable} of {len(finite)} points between {config.min_range:g} and {config.max_range:g} m; "
            f"lidar odometry needs {config.least_points}: is the sensor covered, or the cloud not in its frame?"
        )
    return rows, at


def dated(times: Times) -> tuple[float, float] | None:
    """First and last of times (N,) in seconds around the stamp; None if they do not differ, or are no such times."""
    known = times[np.isfinite(times)]
    if not len(known) or np.abs(known).max() > _LONGEST_SWEEP or np.ptp(known) < _INSTANT:
        return None
    return float(known.min()), float(known.max())
