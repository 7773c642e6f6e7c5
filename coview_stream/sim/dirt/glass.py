"""Glass: windows that mirror what is before them, or show what is behind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Floats32, Indices
from coview_stream.sim.dirt.ranges import within

# metres, set by hand
_STOREY, _SILL, _LINTEL = 3.2, 0.7, 2.7
_BAY, _FRAME = 3.0, 0.3
_UPRIGHT = 0.3  # vertical part of a wall's unit normal, at most
_STEP = 0.02  # beyond the pane, at which a ray goes on


@dataclass(frozen=True)
class Glass:
    """Windows in the walls of some buildings.

    Attributes:
        share: of the buildings, that have them.
        mirrors: probability that a window mirrors a beam.
        passes: probability that it lets it pass; what is left returns from the pane.
        strength: share of the light that comes back from what is seen in or behind the glass.

    Raises:
        ConfigError: a value out of its range.
    """

    share: float = 0.4
    mirrors: float = 0.4
    passes: float = 0.4
    strength: float = 0.5

    def __post_init__(self) -> None:
        within(self, share=(0.0, 1.0), mirrors=(0.0, 1.0), passes=(0.0, 1.0 - self.mirrors), strength=(0.0, 1.0))


class Panes(NamedTuple):
    """Beams that go on at a window.

    Attributes:
        which: (K,) their indices among all beams.
        origins: (K, 3) where they go on, scene frame, metres.
        rays: (K, 3) where to, unit vectors.
    """

    which: Indices
    origins: Floats32
    rays: Floats32


def windows(points: Floats, normals: Floats, height: Floats) -> Bools:
    """Tell which of (N, 3) points on walls are panes: every storey has a row of windows.

    ``normals`` (N, 3) are the walls' unit normals, ``height`` (N,) metres above the ground.
    """
    level = np.maximum(np.hypot(normals[:, 0], normals[:, 1]), 1e-6)
    along = (points[:, 1] * normals[:, 0] - points[:, 0] * normals[:, 1]) / level
    above, bay = np.mod(height, _STOREY), np.mod(along, _BAY)
    pane = (above > _SILL) & (above < _LINTEL) & (bay > _FRAME) & (height > 0.0)
    return np.asarray(pane & (np.abs(normals[:, 2]) < _UPRIGHT))


def panes(glass: Glass, points: Floats, rays: Floats, normals: Floats, rng: np.random.Generator) -> tuple[Bools, Panes]:
    """Return which of (N,) beams that meet a pane are not stopped by it, and how they go on.

    ``points`` (N, 3), where they meet it, ``rays`` (N, 3) and ``normals`` (N, 3) are in the scene frame.
    """
    fate = rng.random(len(rays))
    mirrored, passed = fate < glass.mirrors, (fate >= glass.mirrors) & (fate < glass.mirrors + glass.passes)
    into = np.einsum("ij,ij->i", rays, normals)[:, None]
    on = np.where(mirrored[:, None], rays - 2.0 * into * normals, rays)
    goes_on = mirrored | passed
    start = points + _STEP * on
    which = np.flatnonzero(goes_on)
    return goes_on, Panes(which, start[which].astype(np.float32), on[which].astype(np.float32))
