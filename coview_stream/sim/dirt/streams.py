"""Random streams of dirt: one per purpose, so that one kind leaves the numbers of the others as they are."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Purposes that draw random numbers."""

    COVER = 1
    GLASS = 2
    TRAFFIC = 3
    MOUNTING = 4
    BEAMS = 5
    WEATHER = 6
    ODOMETRY = 7
    SLIP = 8
    GRAVITY = 9
    STRIPS = 10
    DENSITY = 11
    YEARS = 12


_DIRT = 200  # apart from the streams of scene, flight and drive


def stream(world_seed: int, seed: int, purpose: Stream) -> np.random.Generator:
    """Return the random numbers of one purpose."""
    return np.random.default_rng([world_seed, _DIRT, seed, int(purpose)])
