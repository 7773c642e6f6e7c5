"""The start of tracking: the truth, half a metre and three degrees off, in a direction of the place's own."""

from __future__ import annotations

import numpy as np

from bench.harness.places import Place
from coview_stream.geometry import Pose, pose_from, rot_z

OFF, TURNED = 0.5, float(np.radians(3.0))
"""Metres, radians."""


def started(place: Place) -> Pose:
    """Return ``T_map_submap`` (4, 4) to start from; equal for all methods."""
    seed = int(abs(place.T_map_submap[0, 3]) * 1e3)
    rng = np.random.default_rng(seed)
    heading, turn = rng.uniform(-np.pi, np.pi), TURNED * rng.choice([-1.0, 1.0])
    off = pose_from(rot_z(turn), [OFF * np.cos(heading), OFF * np.sin(heading), 0.0])
    return np.asarray(place.T_map_submap @ off)
