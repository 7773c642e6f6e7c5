"""Array types that the kernels share."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
C64 = npt.NDArray[np.complex64]
Mask = npt.NDArray[np.bool_]

Mode = Literal["paper", "eye", "off"]
Vertical = Literal["max", "mean", "off"]


class PolarGrid(NamedTuple):
    """Heights and counts in rings x sectors around a centre; bins without points hold 0 in all three."""

    max_height: F32
    """(..., R, S) greatest height above the centre, metres."""
    sum_height: F32
    """(..., R, S) sum of the heights above the centre, metres."""
    count: I32  # type: ignore[assignment]  # hides tuple.count, which nobody misses
    """(..., R, S) number of points; the only witness of occupancy, since a height of 0 is a valid height."""
