"""Validation of input: clouds, poses, stamps and covariances.

Arrays are copied where the caller may reuse them.
"""

from __future__ import annotations

import numbers
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.geometry.transforms import Points, Pose, is_pose, orthonormal, pose_from, why_no_pose

_Real = TypeVar("_Real", np.float32, np.float64)

MAX_COORDINATE = 1e8
"""Limit in metres beyond all coordinates on Earth, even geocentric ones; squares of it stay finite."""

# all set by hand
_MIN_POINTS = 10
_SAMPLED_POINTS = 2000  # sampled from a frame to find its extent
_MAX_DISTANCE = 10_000.0  # metres: no lidar sees this far, and float32 is coarse there
_MAX_FROM_MAP = 1e7  # metres from the map's origin: not on this planet
_MAX_STAMP = 1e11  # seconds, more than 3,000 years; present stamps in milliseconds exceed it
_MIN_EIGENVALUE = 1e-12  # of a correlation matrix


def to_array(
    values: npt.ArrayLike, dtype: type[_Real], name: str, error: type[InputError] = CloudError
) -> npt.NDArray[_Real]:
    """Return ``values`` as an array of ``dtype``, copied only if needed; ``error`` if they are not numbers."""
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(values)
            if array.dtype.kind in "bcmM":  # NumPy would convert them, dropping imaginary parts
                raise TypeError(f"they are {array.dtype}")
            return array.astype(dtype, copy=False)
    except (TypeError, ValueError) as reason:
        raise error(f"{name} is not an array of numbers ({reason})") from reason


def cloud_rows(cloud: npt.ArrayLike) -> Points:
    """Return the points (N, 3) float32 of rows (N, 3), or (N, 4) with an intensity; CloudError for other shapes."""
    rows = to_array(cloud, np.float32, "cloud")
    if rows.ndim == 2 and rows.shape[1] in (3, 4):
        return rows[:, :3]
    remedy = ""
    if rows.ndim == 2 and rows.shape[0] in (3, 4):
        remedy = ": give cloud.T"
    elif rows.ndim == 2 and rows.shape[1] > 4:
        remedy = ": give cloud[:, :3]"
    elif rows.ndim == 3 and rows.shape[2] >= 3:
        remedy = ": give cloud[..., :3].reshape(-1, 3)"
    raise CloudError(f"cloud has shape {rows.shape}; expected (N, 3), or (N, 4) with intensities{remedy}")


def finite_rows(rows: Points) -> tuple[Points, Bools | None]:
    """Return a copy of the finite rows (K, 3) of (N, 3), and their mask (N,), None if all are finite."""
    if np.isfinite(rows).all():
        return rows.copy(order="C"), None
    finite: Bools = np.all(np.isfinite(rows), axis=1)
    return rows.compress(finite, axis=0), finite


def validate_cloud(cloud: npt.ArrayLike) -> Points:
    """Return a copy of a frame's finite points, row-major (N, 3) float32; CloudError if it is not a cloud."""
    finite, _ = finite_rows(cloud_rows(cloud))
    if len(finite) < _MIN_POINTS:
        raise CloudError(f"cloud has {len(finite)} finite points; a frame needs {_MIN_POINTS} or more")
    if np.median(np.abs(finite[:: 1 + len(finite) // _SAMPLED_POINTS])) > _MAX_DISTANCE:
        raise CloudError(
            "cloud lies kilometres from its origin; give it relative to the sensor, in metres (millimetres?)"
        )
    return finite


def check_stamp(stamp: float, newest: float | None = None) -> None:
    """Refuse a stamp that is not a finite number of seconds, or not after that of the previous frame (RunError)."""
    if isinstance(stamp, bool | np.bool_) or not isinstance(stamp, numbers.Real):
        raise RunError(f"stamp {stamp!r} is not numeric; give seconds, as a float")
    if not np.isfinite(stamp):
        raise RunError(f"stamp is {stamp}; it must be finite, in seconds")
    if abs(stamp) >= _MAX_STAMP:
        raise RunError(f"stamp {stamp:.6g} cannot be seconds; give seconds, not milli- or nanoseconds")
    if newest is not None and stamp <= newest:
        what = "is that" if stamp == newest else "is before that"
        raise RunError(
            f"stamp {stamp:.3f} {what} of the frame before ({newest:.3f}); frames go forward in time: "
            "give each the time at which it was measured, or call reset() before another run"
        )


def check_rigid(T: npt.ArrayLike, name: str, error: type[InputError] = InputError) -> Pose:
    """Return a rigid pose (4, 4) float64, orthonormal to rounding; ``error`` for anything else."""
    pose = to_array(T, np.float64, name, error)
    if not is_pose(pose):
        raise error(f"{name} {why_no_pose(pose)}")
    return orthonormal(pose)


def validate_odometry(T_odom_body: npt.ArrayLike, stamp: float, newest: float | None = None) -> Pose:
    """Return a frame's pose (4, 4), exactly rigid; RunError if it is not a pose, or as :func:`check_stamp`."""
    check_stamp(stamp, newest)
    return check_rigid(T_odom_body, "T_odom_body", RunError)


def validate_pose(T_map_body: npt.ArrayLike, origin: Floats) -> Pose:
    """Return a place (4, 4), given in the frame of the map's sources, about the map's ``origin`` (3,).

    RunError if it is not rigid or not on this planet.
    """
    T = check_rigid(T_map_body, "T_map_body", RunError)
    local = pose_from(T[:3, :3], T[:3, 3] - origin)
    if np.abs(local[:3, 3]).max() > _MAX_FROM_MAP:
        raise RunError("T_map_body lies 10,000 km off the map; is it in the frame of the map's sources?")
    return local


def check_covariance(covariance: npt.ArrayLike, name: str) -> Floats:
    """Return a covariance (6, 6) float64, exactly symmetric; InputError unless it is positive definite."""
    C = np.asarray(covariance, dtype=np.float64)
    if C.shape != (6, 6) or not np.isfinite(C).all():
        raise InputError(f"{name} has shape {C.shape} or is not finite; expected a covariance (6, 6)")
    C = np.asarray(0.5 * (C + C.T))
    sigma = np.sqrt(np.clip(np.diag(C), 1e-300, None))
    if (np.diag(C) <= 0).any() or np.linalg.eigvalsh(C / np.outer(sigma, sigma))[0] < _MIN_EIGENVALUE:
        raise InputError(f"{name} is not positive definite; give every direction a variance")
    return C
