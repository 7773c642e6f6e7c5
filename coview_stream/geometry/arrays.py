"""Names of array types by number type; docstrings give shapes and units."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Reals = npt.NDArray[np.floating]  # of any precision
Complexes = npt.NDArray[np.complex64]
Ints = npt.NDArray[np.int64]
Int32s = npt.NDArray[np.int32]
Int8s = npt.NDArray[np.int8]
Indices = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]
