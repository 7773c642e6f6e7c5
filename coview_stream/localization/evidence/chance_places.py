"""Chance places around a pose: what of a scan the map explains by chance in the neighbourhood of a tracked robot.

A search has hundreds of wrong places to compare with. While tracking there is one place, so the background is measured
in rings around it, where walls and ground are of the same kind, and by chance alone where the scan has them.
"""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.localization.evidence.background import Background, Most, estimate_background, scatter
from coview_stream.localization.evidence.observation import ObservedScan

# set by hand
_RINGS = (3.0, 5.0, 8.0, 12.0)  # metres from the pose
_SPOKES = 8  # of each ring
_TURNS = tuple(np.radians((-12.0, -4.0, 4.0, 12.0)))  # of the heading there, one after the other


def observe_with_background(
    field: kernels.FieldMap, seen: ObservedScan, T_map_odom: Floats
) -> tuple[Floats32, Background]:
    """Observe the map from poses (P, 4, 4) as they are, and measure the background around the first of them.

    Returns:
        Observations (P, 7), see :class:`~coview_stream.localization.evidence.observation.Share`, and the background.
    """
    poses = seen.poses(T_map_odom)
    observed = seen.few.look_up(field, np.concatenate([poses, chance_places(poses[0])]), kernels.Move.NONE).shares
    places, chance = observed[: len(poses)], observed[len(poses) :]
    return places, estimate_background(chance, scatter(chance), chance[:0], Most(*seen.patches))


def chance_places(pose: Floats) -> Floats:
    """Return poses (H, 4), x, y, z and heading, in rings around one (4,), turned a little."""
    ring, spoke = (index.ravel() for index in np.indices((len(_RINGS), _SPOKES)))
    angle = 2.0 * np.pi * (spoke + 0.5 * (ring % 2)) / _SPOKES
    radius, turn = np.take(_RINGS, ring), np.take(_TURNS, (ring + spoke) % len(_TURNS))
    zero = np.zeros_like(radius)
    return np.asarray(pose + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), zero, turn]))
