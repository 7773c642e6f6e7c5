"""Reference of the consensus: the sum of all votes at every station and shift, in plain NumPy."""

from __future__ import annotations

import numpy as np

from coview_stream.localization.search.consensus import yaw_of_shift


def dense_scores(grid, votes):
    """Sum of z-scores (M, S) for the newest keyframe to stand at station m with shift n, per sqrt(keyframe).

    Args:
        grid: the stations' grid.
        votes: of each keyframe, oldest first, its centre (3,) and z-scores (M, S).
    """
    centre, newest = votes[-1]
    total = newest.astype(np.float64)
    for other, scores in votes[:-1]:
        step = other - centre
        for n, yaw in enumerate(yaw_of_shift(np.arange(total.shape[1]), total.shape[1])):
            turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            there = grid.at(grid.stations + turn @ step)
            total[:, n] += np.where(there < 0, 0.0, scores[there, n])
    return total / np.sqrt(len(votes))
