"""Where am I, roughly: keyframes, the stations they are compared with, and how they vote."""

# FOLDED coview_stream/config/search.py: """Learned re-localization: whether it is used, and how a scan is compared with a map's features."""
# FOLDED coview_stream/config/search.py: """How keypoints of a scan and of the map are matched."""

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


Reloc = Literal["auto", "coview", "learned"]
"""Who says where to look: the descriptors of the paper, the learned features, or both where a map has features."""


@dataclass(frozen=True)
class LearnedConfig:
    """How a scan's learned features are looked up in the map's (see :mod:`coview_stream.localization.search.learned`).

    ``reach`` is how far around the robot's newest position (metres, horizontally) its keyframes' points are used. Their
    features are compared with the map's at every ``cell`` metres and at ``yaws`` headings; with all of a map of up to
    ``dense_area`` square metres, with the surroundings of the ``shortlist`` tiles that look most alike where it is
    larger. ``peaks`` best places go on to registration, and while both sources vote as many of the other source's.
    Keypoints that match make each of them exact first.
    """

    reach: float = 30.0
    cell: float = 2.0
    yaws: int = 36
    dense_area: float = 2.0e6
    shortlist: int = 50
    peaks: int = 5

    def __post_init__(self) -> None:
        positive(self, "dense_area")
        require(5.0 <= self.reach <= 32.0, self, "reach", "5 to 32 m, half a query's image")
        require(self.cell in (1.0, 2.0, 4.0), self, "cell", "1, 2 or 4 m")
        counts(self, "yaws", least=4)
        require(self.yaws <= 360, self, "yaws", "360 at most: memory and time grow with it")
        counts(self, "shortlist", "peaks")


@dataclass(frozen=True)
class LearnedMatchConfig:
    """Keypoints, pairs, their consistency, and what a match has to be.

    ``keypoints`` of least uncertainty describe a query; a pair is kept where each is the other's nearest among those
    that can meet, the ``pairs`` most similar of them. Two pairs agree where the distance between their points differs
    by less than ``tolerance`` between the views (weight: a bell of width ``spread``); pairs less than ``least_apart``
    away from each other say nothing about the heading and do not count. The search for the largest consistent set
    gives up being exact after ``nodes`` branches. A match has at least ``least_inliers`` and lies within ``most_shift``
    (metres) and ``most_turn`` (radians) of where it was sought; the query reaches ``reach`` metres around its middle.
    Pairing only points that can meet within these bounds finds many more right pairs, but chance agreement too lies
    near the start. Of 200 keypoints without any partner, mutual nearest ones agree in sets of up to 7 by chance:
    ``least_inliers`` has to be more.
    """

    keypoints: int = 200
    pairs: int = 300
    tolerance: float = 1.0
    spread: float = 0.4
    least_apart: float = 2.0
    nodes: int = 2000
    least_inliers: int = 8
    most_shift: float = 6.0
    most_turn: float = math.radians(15.0)
    reach: float = 30.0

    def __post_init__(self) -> None:
        counts(self, "keypoints", "nodes")
        counts(self, "least_inliers", least=2)
        counts(self, "pairs", least=2)
        require(self.pairs <= 400, self, "pairs", "400 at most: the time grows with their square")
        positive(self, "tolerance", "spread", "least_apart", "most_shift", "most_turn", "reach")
