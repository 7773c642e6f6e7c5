"""Ways other than a scene's own route: along the border of its map, and in a lane."""

from __future__ import annotations

import numpy as np

from bench.integrity.sites import there_and_back
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.sim.scenes import Scene

NEAR, FAR = 10.0, 40.0  # metres from the border
_SHORTEST = 24.0  # metres, of a stretch that is worth driving to and fro


def beside_border(scene: Scene, seed: int, outside: bool | None = None) -> Floats | None:
    """Return a closed way (N, 2) on a street, 10 to 40 m from the map's border; None where there is no such street.

    ``outside`` asks for a way beyond the border or within it; None takes either.
    """
    stretches = []
    for line in (*scene.site.layout.streets, scene.route[::4]):
        depth = scene.size / 2 - np.abs(line).max(axis=1)  # positive inside
        for sign in (1.0, -1.0):
            if outside is not None and (sign < 0) != outside:
                continue
            fits = (sign * depth >= NEAR) & (sign * depth <= FAR) & (np.abs(line).max(axis=1) < scene.size / 2 + 42.0)
            stretches += [line[run] for run in _runs(fits) if _length(line[run]) >= _SHORTEST]
    if not stretches:
        return None
    weights = np.array([_length(each) for each in stretches])
    rng = np.random.default_rng([seed, 220])
    return there_and_back(stretches[int(rng.choice(len(stretches), p=weights / weights.sum()))])


def lane(scene: Scene, seed: int, across: bool) -> Floats:
    """Return a closed way (N, 2) to and fro in a street along the scene's first one, or in one ``across``."""
    streets = scene.site.layout.streets
    headings = [(line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0]) for line in streets]
    chosen = [k for k, heading in enumerate(headings) if (abs(heading @ headings[0]) < 0.5) == across]
    return there_and_back(streets[int(np.random.default_rng([seed, 221]).choice(chosen))], 0.6)


def _runs(inside: Bools) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 3]


def _length(line: Floats) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
