"""Where trees stand: at random, in clusters, apart from each other or in rows; gaps and a trail."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from coview_stream.learn.terrain import waves
from coview_stream.sim.mesh import Floats

PATTERNS = ("random", "clustered", "hard-core", "rows")

_APART = 0.8  # metres: no two stems stand nearer


def draw_stems(rng: np.random.Generator, pattern: str, per_hectare: float, half: float) -> Floats:
    """Draw positions (N, 2) of stems within +-``half`` metres, in one of ``PATTERNS``."""
    area = (2 * half) ** 2
    count = int(per_hectare * area / 1e4)
    spacing = np.sqrt(1e4 / per_hectare)
    if pattern == "rows":
        return _rows(rng, spacing, half)
    if pattern == "clustered":
        per = rng.uniform(3, 15)
        parents = rng.uniform(-half, half, (max(1, int(count / per)), 2))
        xy = parents[rng.integers(0, len(parents), count)] + rng.normal(0, rng.uniform(1.5, 5.0), (count, 2))
        return xy[_thinned(rng, xy, _APART) & (np.abs(xy) < half).all(axis=1)]
    dense = rng.uniform(-half, half, (int(1.6 * count) if pattern == "hard-core" else count, 2))
    apart = rng.uniform(0.45, 0.7) * spacing if pattern == "hard-core" else _APART
    return dense[_thinned(rng, dense, apart)][:count]


def _rows(rng: np.random.Generator, spacing: float, half: float) -> Floats:
    stretch = rng.uniform(1.0, 1.6)
    across, along = spacing * np.sqrt(stretch), spacing / np.sqrt(stretch)
    u, v = np.arange(-1.5 * half, 1.5 * half, across), np.arange(-1.5 * half, 1.5 * half, along)
    xy = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = xy + rng.normal(0, rng.uniform(0.05, 0.2) * along, xy.shape)
    yaw = rng.uniform(0, np.pi)
    xy = xy @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    kept = (np.abs(xy) < half).all(axis=1) & (rng.random(len(xy)) > rng.uniform(0, 0.25))
    return np.asarray(xy[kept])


def _thinned(rng: np.random.Generator, xy: Floats, apart: float) -> npt.NDArray[np.bool_]:
    """Keep (N,) such that of each pair nearer than ``apart`` the one of lower rank goes."""
    keep = np.ones(len(xy), dtype=bool)
    pairs = cKDTree(xy).query_pairs(apart, output_type="ndarray")
    rank = rng.random(len(xy))
    keep[np.where(rank[pairs[:, 0]] < rank[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = False
    return keep


def opened(rng: np.random.Generator, xy: Floats, half: float) -> npt.NDArray[np.bool_]:
    """Which stems (N,) remain where the stand has thin parts, gaps and perhaps a trail."""
    keep = np.ones(len(xy), dtype=bool)
    if rng.random() < 0.6:
        uneven = waves(rng, rng.uniform(40, 120))(xy[:, 0], xy[:, 1])
        keep &= rng.random(len(xy)) < 1 / (1 + np.exp(-2.0 - rng.uniform(0, 1.5) * uneven))
    for _ in range(rng.poisson(rng.choice([0.0, 2.0, 6.0]))):
        middle, radii = rng.uniform(-half, half, 2), rng.uniform(4, 16, 2)
        keep &= ((xy - middle) ** 2 / radii**2).sum(axis=1) > 1
    if rng.random() < 0.7:
        keep &= _aside(xy, _trail(rng, half)) > rng.uniform(1.0, 2.5)
    return keep


def _trail(rng: np.random.Generator, half: float) -> Floats:
    along = np.arange(-1.5 * half, 1.5 * half, 1.0)
    sideways = rng.uniform(-0.4, 0.4) * half + rng.uniform(0, 12) * waves(rng, rng.uniform(60, 140))(
        along, np.zeros_like(along)
    )
    yaw = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(np.column_stack([along, sideways]) @ np.array([[c, s], [-s, c]]))


def _aside(xy: Floats, line: Floats) -> Floats:
    return np.asarray(cKDTree(line).query(xy)[0])
