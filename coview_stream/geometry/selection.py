"""Selection of the smallest of many numbers."""

from __future__ import annotations

import numpy as np

from coview_stream.geometry.arrays import Floats32, Ints

_SAMPLE = 100_000  # distances that a median is taken of; set by hand


def argsmallest(values: Floats32, count: int) -> Ints:
    """Return the indices of the ``count`` smallest of (N,) values, smallest first; equal ones by index."""
    if count >= len(values):
        return np.asarray(np.argsort(values, kind="stable"))
    # a bound from a sample rules most out; where it leaves fewer than ``count``, all are sorted
    every = max(1, len(values) // _SAMPLE)
    sample = values[::every]
    rank = min(2 * count // every, len(sample) - 1)
    found = np.flatnonzero(values <= np.partition(sample, rank)[rank])
    if len(found) < count:
        found = np.arange(len(values))
    near = values[found]
    bound = np.partition(near, count - 1)[count - 1]
    found = found[near <= bound]
    return np.asarray(found[np.argsort(values[found], kind="stable")[:count]])
