"""Settings of the search: keyframes, the stations they are compared with, their votes, and learned features."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from coview_stream.config.checks import check_types, counts, positive, require


@dataclass(frozen=True)
class KeyframeConfig:
    """Keyframes: when the robot's frames become a virtual local scan, VLS (paper, section 3.3); set by hand.

    Attributes:
        distance: metres driven from keyframe to keyframe, the paper's sigma_d.
        capacity: keyframes held, so that memory is fixed.
        voxel: metres; one point of a frame is kept in each cube of this size.
        range_min: metres; nearer points are the robot itself.
        min_points: points, after that, which a VLS needs before it may vote.
    """

    distance: float = 2.0
    capacity: int = 30
    voxel: float = 0.25
    range_min: float = 0.5
    min_points: int = 300

    def __post_init__(self) -> None:
        check_types(self)
        positive(self, "distance", "voxel")
        counts(self, "capacity", "min_points")
        require(self.range_min >= 0, self, "range_min", "zero or more")


@dataclass(frozen=True)
class RetrievalConfig:
    """Retrieval: which stations are scored (paper, section 3.4); ``python -m bench ablation`` compares the two modes.

    Attributes:
        mode: ``exhaustive`` scores all stations at all shifts. ``ring_key`` is the paper's way, kept for comparison:
            only the stations nearest in ring key are scored, all others count as worst.
        candidates: how many those are.
    """

    mode: Literal["exhaustive", "ring_key"] = "exhaustive"
    candidates: int = 200

    def __post_init__(self) -> None:
        check_types(self)
        require(self.mode in ("exhaustive", "ring_key"), self, "mode", "exhaustive or ring_key")
        counts(self, "candidates")


@dataclass(frozen=True)
class ConsensusConfig:
    """Consensus: the votes of keyframes for one ``T_map_odom``.

    Attributes:
        mode: ``consensus``; or ``single``, the paper's rule: the one smallest distance of all keyframes.
            ``python -m bench ablation`` compares them.
        window: newest keyframes that vote; set by hand.
        peaks: best hypotheses that are scored by the likelihood field; more of the co-view descriptors on maps of
            more than 20,000 stations, by the fourth root. Set by hand.
        distinct_distance: metres; a hypothesis farther than this from every better one is one of its own; set by hand.
        distinct_yaw: radians; so is one turned by more than this; set by hand.
    """

    mode: Literal["consensus", "single"] = "consensus"
    window: int = 10
    peaks: int = 184
    distinct_distance: float = 6.0
    distinct_yaw: float = math.radians(20)

    def __post_init__(self) -> None:
        check_types(self)
        require(self.mode in ("consensus", "single"), self, "mode", "consensus or single")
        counts(self, "window", "peaks")
        positive(self, "distinct_distance", "distinct_yaw")


Reloc = Literal["auto", "coview", "learned"]
"""Place recognition: the descriptors of the paper, learned features, or (auto) both where map and installation can."""


@dataclass(frozen=True)
class LearnedConfig:
    """Search of a scan's learned features among the map's (:mod:`coview_stream.localization.search.learned`).

    Set by hand; ``python -m bench forest`` prints what comes of it, ``bench learned_match`` what it costs.

    Attributes:
        reach: metres around the robot's newest position, horizontally, within which its keyframes' points are used.
        cell: metres from place to place at which their features are compared with the map's.
        yaws: headings at each, an even number.
        dense_area: square metres up to which a map is searched all over.
        shortlist: tiles of a larger one, those that look most alike, around which it is searched.
        peaks: best places that are scored by the likelihood field.
    """

    reach: float = 30.0
    cell: float = 2.0
    yaws: int = 36
    dense_area: float = 2.0e6
    shortlist: int = 50
    peaks: int = 64

    def __post_init__(self) -> None:
        check_types(self)
        positive(self, "dense_area")
        require(5.0 <= self.reach <= 32.0, self, "reach", "5 to 32 m, half a query's image")
        require(self.cell in (1.0, 2.0, 4.0), self, "cell", "1, 2 or 4 m")
        counts(self, "yaws", minimum=4)
        require(self.yaws <= 360, self, "yaws", "360 at most: memory and time grow with it")
        require(self.yaws % 2 == 0, self, "yaws", "an even number")
        counts(self, "shortlist", "peaks")
