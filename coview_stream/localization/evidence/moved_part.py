"""Evidence of a moved part: what a place leaves unexplained may all be explained some metres beside it.

Where a survey has the buildings a few metres off, and trees, poles and hedges where they are, the scan fits at two
places: most of it at one, and what is left at the other. Which of the two is right nothing here can tell. Objects that
were replaced since the survey do not agree on a shift, but for chance: so the points that the place leaves unexplained
are held against the map at shifts all around it, the best shift against the background of the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats
from coview_stream.localization.evidence.background import estimate_background, scatter
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.observed_scan import ObservedScan, ScanPart

# set by hand
_PRIOR = 1e-4  # probability that a survey has a part of the site shifted as a whole
_LEAST, _MOST = 2.0, 8.0  # metres, of shifts
_SAME = 2.5  # metres: shifts that share what they explain
_MIN_POINTS = 30  # left unexplained; fewer agree on anything


@dataclass(frozen=True)
class MovedPart:
    """A part of what is seen that fits elsewhere.

    Attributes:
        probability: that there is one.
        metres: how far off it fits.
    """

    probability: float
    metres: float


NO_PART = MovedPart(0.0, 0.0)


def find_moved_part(field: kernels.FieldMap, seen: ObservedScan, T_map_odom: Floats) -> MovedPart:
    """Look for a part of a scan that is unexplained at a place (4, 4) and fits at one shift of it."""
    pose = seen.poses(T_map_odom[None])
    structure = seen.many.points.structure
    left = structure[kernels.unexplained(field, structure, pose[0])]
    if len(left) < _MIN_POINTS:
        return NO_PART
    nothing = np.empty((0, 3), dtype=np.float32)
    part = ScanPart(kernels.FieldScan(left, nothing, nothing), (1.0, 1.0, 1.0))
    shifts = _shifts()
    _, observed, _ = part.look_up(field, pose + np.column_stack([shifts, np.zeros((len(shifts), 2))]), "near")
    chance = np.ones(len(shifts), dtype=bool)
    for _ in range(2):
        background = estimate_background(observed[chance], scatter(observed[chance]), observed[chance])
        background = replace(background, number=(background.number[0], 0.0))  # there is only structure
        ratios = log_likelihood_ratios(observed, background)[0]
        best = int(ratios.argmax())
        chance = np.linalg.norm(shifts - shifts[best], axis=1) > _SAME
    odds = _PRIOR * math.exp(min(float(ratios[best]), 100.0)) / len(shifts)
    return MovedPart(odds / (1.0 + odds), float(np.linalg.norm(shifts[best])))


def _shifts() -> Floats:
    """Return shifts (H, 2) on a grid, metres."""
    axis = np.arange(-_MOST, _MOST + 0.5)
    every = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    length = np.linalg.norm(every, axis=1)
    return np.asarray(every[(length >= _LEAST) & (length <= _MOST)])
