"""The newest frames' points: what a registration is made of."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from coview_stream.config import TrackingConfig
from coview_stream.geometry import Points

MOST_FRAMES = 40


@dataclass(frozen=True)
class _Recent:
    travelled: float
    points: Points  # (N, 3) odometry frame


class RecentFrames:
    """Points of at most 40 frames, odometry frame, newest last."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._frames: deque[_Recent] = deque(maxlen=MOST_FRAMES)

    def add(self, points: Points, travelled: float) -> None:
        """Take in a frame (N, 3), seen after ``travelled`` metres."""
        self._frames.append(_Recent(travelled, points))

    def clear(self) -> None:
        """Forget them all."""
        self._frames.clear()

    def keep(self, most: int) -> None:
        """Forget all but the newest ``most``."""
        while len(self._frames) > most:
            self._frames.popleft()

    @property
    def newest(self) -> Points | None:
        """(N, 3) points of the newest frame, odometry frame."""
        return self._frames[-1].points if self._frames else None

    def window(self) -> Points:
        """Points of the newest frames: of the last metres, more if they are too few."""
        parts: list[Points] = []
        count = 0
        for frame in reversed(self._frames):
            old = self._frames[-1].travelled - frame.travelled > self._config.window
            if count >= self._config.max_points or (old and count >= self._config.min_points):
                break
            parts.append(frame.points)
            count += len(frame.points)
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.float32)
