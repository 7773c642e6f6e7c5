"""Scans at chance places, drawn from shares and an effective number of observations that are known."""

import numpy as np

from coview_stream.localization.evidence.observation import Share

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


def two_kinds(rng, count, share, rich=(0.45, 0.2, 0.1, 0.25), poor=(0.05, 0.05, 0.05, 0.85), keyframes=1):
    """Observations (P, W, 7): a share of the places lies among buildings and explains much, the others hardly any."""
    among = rng.random(count) < share
    outcomes = _drawn(rng, np.where(among[:, None], rich, poor), keyframes)
    free = rng.binomial(NUMBER, np.where(among, 0.02, 0.1)[:, None], (count, keyframes)) / NUMBER
    return _rows(outcomes, free, np.where(among, rng.beta(5, 2, count), rng.beta(2, 2, count)))


def mostly_nothing(rng, count, share, keyframes=1):
    """Observations (P, W, 7): a share of the places explains nothing at all and contradicts nothing."""
    bare = rng.random((count, 2)) < share
    outcomes = _drawn(rng, np.where(bare[:, :1], [0.0, 0.0, 0.0, 1.0], CHANCE), keyframes)
    free = rng.binomial(NUMBER, PASSED, (count, keyframes)) / NUMBER * ~bare[:, 1:]
    return _rows(outcomes, free, rng.beta(1.2, 1.2, count))


def places_of_their_own(rng, count, alike=15.0, keyframes=1):
    """Observations (P, W, 7): each place has shares of its own, the same ones at all keyframes."""
    outcomes = _drawn(rng, rng.dirichlet(alike * CHANCE, count), keyframes)
    passed = rng.beta(alike * PASSED, alike * (1.0 - PASSED), count)
    return _rows(
        outcomes, rng.binomial(NUMBER, passed[:, None], (count, keyframes)) / NUMBER, rng.beta(1.2, 1.2, count)
    )


def what_was_seen_before(rng, count, stays=0.9, keyframes=1):
    """Observations (P, W, 7): at each keyframe 9 of 10 groups of points come to what they came to before."""
    group = rng.choice(4, (count, NUMBER), p=CHANCE)
    hit = rng.random((count, NUMBER)) < PASSED
    outcomes, free = np.empty((count, keyframes, 4)), np.empty((count, keyframes))
    for k in range(keyframes):
        anew = rng.random((count, NUMBER)) > (stays if k else 0.0)
        group = np.where(anew, rng.choice(4, (count, NUMBER), p=CHANCE), group)
        hit = np.where(anew, rng.random((count, NUMBER)) < PASSED, hit)
        outcomes[:, k] = (group[..., None] == np.arange(4)).mean(axis=1)
        free[:, k] = hit.mean(axis=1)
    return _rows(outcomes, free, rng.beta(1.2, 1.2, count))


def _drawn(rng, structure, keyframes):
    return np.stack([rng.multinomial(NUMBER, structure) for _ in range(keyframes)], axis=1) / NUMBER


def _rows(outcomes, free, ground):
    count, keyframes, _ = outcomes.shape
    rows = observation(outcomes.reshape(-1, 4), free.ravel(), np.repeat(ground, keyframes))
    return rows.reshape(count, keyframes, len(Share))
