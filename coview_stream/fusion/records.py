"""Records of a fused cloud: coordinates, source, change and stamp of each point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Floats

SAME, NEW, GONE = 0, 1, 2
"""Tags of change."""

RECORD = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("stamp", "<f8"), ("source", "<u2"), ("change", "u1")])
"""A point: metres in the frame of the map's sources, seconds, number of the source, tag of change."""


def records(points: Floats, source: npt.ArrayLike, change: npt.ArrayLike, stamp: npt.ArrayLike) -> npt.NDArray[np.void]:
    """Return points (N, 3) with their tags as records (N,)."""
    rows = np.zeros(len(points), dtype=RECORD)
    rows["x"], rows["y"], rows["z"] = points.T
    rows["source"], rows["change"], rows["stamp"] = source, change, stamp
    return rows
