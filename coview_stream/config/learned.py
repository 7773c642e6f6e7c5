"""Learned re-localization: whether it is used, and how a scan is compared with a map's features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from coview_stream.config.checks import counts, positive, require

Reloc = Literal["auto", "coview", "learned"]
"""Who says where to look: the descriptors of the paper, the learned features, or both where a map has features."""


@dataclass(frozen=True)
class LearnedConfig:
    """How a scan's learned features are looked up in the map's (see :mod:`coview_stream.place.learned`).

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
