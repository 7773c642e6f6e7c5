"""Scans at chance places, drawn from shares and an effective number of observations that are known."""

from __future__ import annotations

import numpy as np

from coview_stream.localization.evidence.observed_scan import Share

CHANCE = np.array([0.2, 0.15, 0.1, 0.55])  # on, near, under an edge, unexplained
PASSED = 0.08
NUMBER = 24  # independent observations


def observation(structure, passed=PASSED, ground=0.5, covered=1.0, covered_ground=1.0):
    """Observations (P, 7) of outcomes (P, 4) of the covered structure, and shares (P,) or one for all."""
    structure = np.atleast_2d(structure) * np.reshape(covered, (-1, 1))
    row = np.empty((len(structure), len(Share)), dtype=np.float32)
    row[:, Share.ON] = structure[:, 0]
    row[:, Share.NEAR] = structure[:, 0] + structure[:, 1]
    row[:, Share.EDGE] = structure[:, 2]
    row[:, Share.COVERED] = covered
    row[:, Share.GROUND] = np.asarray(ground) * covered_ground
    row[:, Share.COVERED_GROUND] = covered_ground
    row[:, Share.PASSED] = passed
    return row


def chance_places(rng, count, structure=CHANCE, passed=PASSED, number=NUMBER, keyframes=1):
    """Observations (P, W, 7): groups of points share an outcome, as neighbouring points do, anew at each keyframe."""
    outcomes = rng.multinomial(number, structure, (count, keyframes)) / number
    free = rng.binomial(number, passed, (count, keyframes)) / number
    ground = np.repeat(rng.beta(1.2, 1.2, (count, 1)), keyframes, axis=1)  # a road is level at every keyframe
    rows = observation(outcomes.reshape(-1, 4), free.ravel(), ground.ravel())
    return rows.reshape(count, keyframes, len(Share))
