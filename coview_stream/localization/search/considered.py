"""Places that a search considers, as few numbers: for people to look at, nothing is decided by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import yaw_of
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.scoring import Scored

MAX_PLACES = 20  # set by hand: more cannot be told apart on a screen, and a message of them stays below 3 kB


@dataclass(frozen=True)
class Considered:
    """The most probable places of a robot at a keyframe.

    Attributes:
        stamp: seconds, of the keyframe.
        places: (K, 6) float64, the most probable first: x, y, z and yaw of the body in the frame of the map's sources
            (metres, radians), the posterior probability, and the log-likelihood ratio against chance.
        none: probability that the robot is at no place of the map.
    """

    stamp: float
    places: Floats
    none: float

    @classmethod
    def of(cls, scored: Scored, request: SearchRequest, origin: Floats) -> Considered | None:
        """Sum up what a keyframe's places came to; ``origin`` (3,) is the map's; None without any place."""
        best = sorted(scored.places, key=lambda place: -place.probability)[:MAX_PLACES]
        if not best:
            return None
        rows = []
        for place in best:
            T_map_body = place.hypothesis.T_map_odom @ request.T_odom_body
            position = T_map_body[:3, 3] + origin
            rows.append([*position, yaw_of(T_map_body), place.probability, place.ratio])
        return cls(request.stamp, np.array(rows, dtype=np.float64), float(scored.none))
