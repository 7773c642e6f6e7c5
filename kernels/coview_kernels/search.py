"""The kernel that answers a query, and the memory that it shares with NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels import runtime
from coview_kernels.arrays import F32, F64, I32, I64
from coview_kernels.launch import Launch
from coview_kernels.screen import Bounds, Screen, aligned

MOST_BEST = 128
_LISTED = 2048  # stations that may be among the best; the kernel looks through all for each that it scores
_SERIAL = 4_096  # stations from which other threads are worth waking
_FRESH, _K = 23, 24  # arguments of the kernel


class Search:
    """Screens all stations for a query and scores those that matter; on the owner thread, or as :meth:`ready` says.

    Args:
        screen: of the stations.
        descriptors: their (M, R, S); scores are for float16, C-contiguous, only.
    """

    def __init__(self, screen: Screen, descriptors: npt.NDArray[Any]) -> None:
        rings, blocks, lanes = screen.rings, screen.blocks, screen.lanes
        self._scores_any = descriptors.dtype == np.float16 and descriptors.flags.c_contiguous
        self._missed = screen.missed
        self.query = aligned((2, rings, 2, blocks))
        self.turn = aligned((6 + 2 * blocks, lanes))
        self._raw = np.zeros((rings, screen.sectors), dtype=np.float32)
        # the query's norm, the turn's unit, the error common to all, stations listed
        self._found = np.zeros(4)
        self._best = np.empty(len(descriptors), dtype=np.int32)
        self._listed, self._shifts = np.zeros((2, _LISTED), dtype=np.int32)
        self._scores = np.zeros(_LISTED)
        arguments = (
            *(self._raw, screen.waves, screen.step.astype(np.float64), screen.norm, screen.room()),
            *(screen.turns, screen.reach),
            *(np.empty((rings, 2, blocks)), np.empty((rings, 2 * screen.sectors)), np.empty(blocks)),
            *(self.query, self.turn, self._found),
            *(screen.stations, self._missed, self._best, lanes),
            descriptors.view(np.uint16) if self._scores_any else np.empty(1, dtype=np.uint16),
            *(np.empty(MOST_BEST), self._listed, np.empty(_LISTED), self._scores, self._shifts, 1, 0),
        )
        self._serial = runtime.workers() == 1 or len(descriptors) < _SERIAL
        self._launch = Launch(
            "matching",
            f"match_{rings}_{screen.sectors}_{blocks}_{lanes}_{screen.shifts}_{int(self._serial)}",
            *(np.ascontiguousarray(a).reshape(-1) if isinstance(a, np.ndarray) else a for a in arguments),
        )
        self._k = 0

    def ready(self) -> bool:
        """Whether :meth:`scored` may run on any thread, by :func:`coview_kernels.runtime.dispatch_here`."""
        return self._launch.ready()

    def scored(self, query: F32, k: int) -> tuple[I64, I64, F64] | None:
        """Stations, shifts and correlations, rounded to 1e-9: the ``k`` best of all and some more, in any order.

        None if too many may be among them: :meth:`bounds` says which.
        """
        if k > MOST_BEST or not self._scores_any:
            k = 0
        if k != self._k:
            self._launch.put(_K, k)
            self._k = k
        self._raw[:] = query
        self._launch()
        n = int(self._found[3])
        if not 0 < n <= _LISTED or not k:
            return None
        return self._listed[:n].astype(np.int64), self._shifts[:n].astype(np.int64), self._scores[:n]

    def bounds(self) -> Bounds:
        """Bounds for the query of the last call."""
        size, unit, rest, _ = (float(x) for x in self._found)
        return Bounds(self._best.astype(np.float64) * unit, self._missed.astype(np.float64) * size + rest)

    def best(self, query: npt.NDArray[np.int16], turn: npt.NDArray[np.int16]) -> I32:
        """Greatest correlation over the shifts, (M,), in units of the turn, for a query's integers."""
        self.query[:] = query
        self.turn[:] = turn
        self._launch.put(_FRESH, 0)
        try:
            self._launch()
        finally:
            self._launch.put(_FRESH, 1)
        copied: I32 = self._best.copy()
        return copied
