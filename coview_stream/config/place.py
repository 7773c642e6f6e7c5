"""Where am I, roughly: keyframes, the stations they are compared with, and how they vote."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from coview_stream.config.checks import counts, positive, require


@dataclass(frozen=True)
class KeyframeConfig:
    """When the robot's frames become a virtual local scan (paper, section 3.3).

    ``distance`` is the paper's sigma_d. The ring buffer holds ``capacity`` keyframes, so memory is fixed;
    ``min_points`` after voxel de-duplication is what a VLS needs before it may vote.
    """

    distance: float = 2.0
    capacity: int = 30
    voxel: float = 0.25
    range_min: float = 0.5
    min_points: int = 300

    def __post_init__(self) -> None:
        positive(self, "distance", "voxel")
        counts(self, "capacity", "min_points")
        require(self.range_min >= 0, self, "range_min", "zero or more")


@dataclass(frozen=True)
class RetrievalConfig:
    """Which stations are scored (paper, section 3.4).

    ``exhaustive`` scores all stations at all shifts. ``ring_key`` is the paper's way, kept for comparison: only
    the ``candidates`` stations nearest in ring key are scored, all others count as worst.
    """

    mode: Literal["exhaustive", "ring_key"] = "exhaustive"
    candidates: int = 200

    def __post_init__(self) -> None:
        require(self.mode in ("exhaustive", "ring_key"), self, "mode", "exhaustive or ring_key")
        counts(self, "candidates")


@dataclass(frozen=True)
class ConsensusConfig:
    """How keyframes vote for one ``T_map_odom``.

    ``window`` newest keyframes vote; ``peaks`` best hypotheses that differ by more than ``distinct_distance`` or
    ``distinct_yaw`` from every better one go on to registration. ``single`` is the paper's rule instead: the one
    smallest distance of all keyframes.
    """

    mode: Literal["consensus", "single"] = "consensus"
    window: int = 10
    peaks: int = 6
    distinct_distance: float = 6.0
    distinct_yaw: float = math.radians(20)

    def __post_init__(self) -> None:
        require(self.mode in ("consensus", "single"), self, "mode", "consensus or single")
        counts(self, "window", "peaks")
        positive(self, "distinct_distance", "distinct_yaw")
