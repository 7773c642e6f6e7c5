"""The paper's rule, kept for comparison: of all keyframes' distances the one smallest names the place."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from coview_stream.config import ConsensusConfig
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.search.consensus import Hypothesis, yaw_of_shift
from coview_stream.localization.search.votes import ScoreVolume


class SmallestDistance:
    """Mode ``single`` of the consensus: the newest keyframes' smallest distances, and the place of the smallest."""

    def __init__(self, stations: Floats32, config: ConsensusConfig) -> None:
        self.stations = stations
        self._found: deque[Hypothesis] = deque(maxlen=config.window)

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._found)

    def clear(self) -> None:
        """Forget all votes."""
        self._found.clear()

    def vote(self, centre: Floats, volumes: Iterable[ScoreVolume]) -> None:
        """Add a keyframe's distances (M, S), one volume per channel; ``centre`` (3,) as in a vote."""
        best = min(volumes, key=lambda volume: float(volume.min()))
        station, shift = (int(n) for n in np.unravel_index(int(best.argmin()), best.shape))
        turn = rot_z(float(yaw_of_shift(shift, best.shape[1])))  # eq. 12, corrected: about the keyframe
        T = pose_from(turn, self.stations[station].astype(np.float64)) @ pose_from(np.eye(3), -centre)
        self._found.append(Hypothesis(T, station, shift, float(best.min())))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the one hypothesis; none before the first vote."""
        return [min(self._found, key=lambda each: each.score)] if self._found else []
