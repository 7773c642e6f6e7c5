"""How keypoints of a scan and of the map are matched."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import counts, positive, require


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
