"""Odometry of a whole recording: poses at many stamps at once, and the samples around a sweep."""

from __future__ import annotations

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.geometry.arrays import Bools, Ints
from coview_stream.geometry.transforms import Poses, interpolate
from coview_stream.odometry.buffer import Segment

SAME_NS = 1000
"""Stamps this close are one moment: text files and float64 seconds are good to a microsecond."""

_NS = 1e-9
_JUMP_DISTANCE = 1.0  # metres, set by hand: shorter steps are no jump at any rate


class Track:
    """Odometry by stamp, interpolated, but not across gaps and jumps: neither does the node.

    Attributes:
        stamps: (K,) nanoseconds, increasing.
        poses: (K, 4, 4) odometry <- body, metres.
    """

    def __init__(self, stamps: Ints, poses: Poses) -> None:
        """Sort the samples; of equal stamps the first counts. At least one sample."""
        config = NodeConfig()
        self.stamps, first = np.unique(stamps, return_index=True)
        self.poses = poses[first]
        seconds = _NS * np.diff(self.stamps)
        driven = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        steady = (seconds <= config.max_gap) & (driven <= np.maximum(_JUMP_DISTANCE, config.max_speed * seconds))
        self._part = np.concatenate([[0], np.cumsum(~steady)])

    def at(self, stamps: Ints) -> tuple[Poses, Bools]:
        """Interpolate poses (N, 4, 4) at the stamps (N,); also return whether each is known (N,)."""
        last = len(self.stamps) - 1
        after = np.clip(np.searchsorted(self.stamps, stamps), 0, last)
        before = np.clip(after - 1, 0, last)
        share = (stamps - self.stamps[before]) / np.maximum(self.stamps[after] - self.stamps[before], 1)
        known = (share >= 0) & (share <= 1) & (self._part[before] == self._part[after]) & (before < after)
        share = np.clip(share, 0.0, 1.0)
        for side, value in ((before, 0.0), (after, 1.0)):
            same = np.abs(stamps - self.stamps[side]) <= SAME_NS
            share, known = np.where(same, value, share), known | same
        return interpolate(self.poses[before], self.poses[after], share), known

    def around(self, begin_ns: int, end_ns: int, stamp_ns: int) -> Segment:
        """Return the samples from the last before ``begin_ns`` to the first after ``end_ns``.

        Samples beyond a gap or jump, seen from ``stamp_ns``, are left out.
        """
        first = np.searchsorted(self.stamps, begin_ns + 1) - 1
        last = np.searchsorted(self.stamps, end_ns) + 1
        part = self._part[max(0, int(np.searchsorted(self.stamps, stamp_ns + SAME_NS, side="right")) - 1)]
        low, high = np.searchsorted(self._part, part, "left"), np.searchsorted(self._part, part, "right")
        chosen = slice(max(0, first, low), min(last, high))
        return Segment(self.stamps[chosen], self.poses[chosen])
