"""Airborne-like survey of a real place, made of a real survey that was taken on the ground.

Real robot scans are to be localized on a map without facades, and public data with both views of a place hardly exist.
This makes the second view of the first: what an aircraft's lidar could have met of the points that are there, strip by
strip. What it is not: a ground survey holds no roofs and little of the upper sides of crowns, so neither does this;
what remains is ground, crowns as far as they were seen from below, low roofs, cars, hedges and the tops of walls. And
the two views are one measurement: heights agree to the noise, and nothing has changed between them.

Three rules stand for the aircraft. A solid surface hides what lies behind it on the ray. A pulse that meets foliage
goes on with probability :attr:`Survey.porosity`, and gives a return for each layer. No pulse returns from a wall below
its top edge: above real walls is a roof that the ground survey has not seen, and a pulse through it would find walls
from the inside, which no aircraft does. What an aircraft does see of facades, at the edge of its swath, goes with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from coview_stream.clouds.filters import voxel_grid
from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.arrays import Bools, Floats, Indices, Reals
from coview_stream.sim.airborne import ALTITUDE, POROSITY, RANGE_NOISE, SWATH

_OVERLAP = 0.2  # share of a strip's width
_CROSSING = np.radians((75.0, 105.0))  # between the two flight directions
_RETURNS, _DEAD = 4, 1.0  # of a pulse, and metres between two of them
_FOOTPRINT = 0.3  # metres in depth that are one return
_GRID, _NEIGHBOURS = 0.3, 16  # metres; places of that grid that say how the surface at a point lies
_SCATTERED = 0.06  # least share of the spread across the surface where it is foliage, set by hand
_UPRIGHT = 0.35  # greatest |z| of the normal of a wall: from 70 degrees on
_TOP = 0.5  # metres: a wall's top edge
_COLUMN = 1.0  # metres: within this, what is above a wall point is its own wall
_OPAQUE = 3.0  # typical distances between neighbours: a surface hides what is behind so wide a cell


@dataclass(frozen=True)
class Survey:
    """Flight over a ground survey.

    Attributes:
        density: returns of first surfaces per square metre, where the ground survey has as many.
        swath: half of the opening angle across the flight direction, degrees.
        altitude: metres above the highest point.
        noise: of the range, metres, one sigma.
        porosity: probability that a pulse passes a layer of foliage.
        misaligned: shift of each strip, metres, one sigma per axis.
        seed: of flight directions, pulses and noise.

    Raises:
        ConfigError: a value out of its range.
    """

    density: float = 8.0
    swath: float = float(np.degrees(SWATH))
    altitude: float = ALTITUDE
    noise: float = RANGE_NOISE
    porosity: float = POROSITY
    misaligned: float = 0.0
    seed: int = 1

    def __post_init__(self) -> None:
        ranges = {
            "density": (0.5, 200.0), "swath": (1.0, 45.0), "altitude": (20.0, 5000.0), "noise": (0.0, 1.0),
            "porosity": (0.0, 1.0), "misaligned": (0.0, 1.0), "seed": (0, 2**31 - 1),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise ConfigError(f"{name}: {value!r} is out of range; use {low:g} to {high:g}")


_DEFAULT = Survey()


@dataclass(frozen=True)
class Surface:
    """How the surface lies at each point of a cloud.

    Attributes:
        foliage: (N,) whether the neighbours are scattered and lie on no surface.
        wall: (N,) whether it is a wall below its top edge.
        spacing: typical distance to the nearest neighbour, metres.
    """

    foliage: Bools
    wall: Bools
    spacing: float


def airborne_survey(points: Reals, survey: Survey = _DEFAULT) -> Floats:
    """Return what an aircraft's lidar would have met of a ground survey (N, 3): (M, 3) float64 metres, same frame.

    Coordinates near zero, z up. Raises InputError for fewer points than say how a surface lies.
    """
    places: Floats = points.astype(np.float64)
    rng, surface = np.random.default_rng(survey.seed), surface_of(places)
    low, high = places.min(axis=0), places.max(axis=0)
    strips = []
    for turn, line, share in _lines((high - low)[:2], survey, rng):
        across = (places[:, :2] - 0.5 * (low + high)[:2]) @ turn.T - [0.0, line]
        flown = np.column_stack([across, high[2] + survey.altitude - places[:, 2]])
        met = _met(flown, surface, survey.density * share, survey, rng)
        ray = flown[met] * [0.0, 1.0, -1.0] / np.linalg.norm(flown[met, 1:], axis=1)[:, None]
        ray[:, :2] = ray[:, :2] @ turn
        shift = rng.normal(0.0, survey.misaligned, 3)
        strips.append(places[met] + ray * rng.normal(0.0, survey.noise, len(met))[:, None] + shift)
    return np.concatenate(strips)


def surface_of(points: Floats) -> Surface:
    """Tell walls and foliage apart from other surfaces by the spread of each point's neighbours (N, 3)."""
    grid = np.asarray(voxel_grid(points.astype(np.float32), _GRID), dtype=np.float64)
    if len(grid) < _NEIGHBOURS:
        raise InputError(f"a survey of {len(grid)} places {_GRID} m apart; give one of {_NEIGHBOURS} or more")
    tree = cKDTree(grid)
    foliage, upright = np.zeros(len(grid), bool), np.zeros(len(grid), bool)
    for part in np.array_split(np.arange(len(grid)), len(grid) // 100_000 + 1):
        around = grid[tree.query(grid[part], k=_NEIGHBOURS)[1]]
        around -= around.mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(around.transpose(0, 2, 1) @ around)
        foliage[part] = spread[:, 0] > _SCATTERED * np.maximum(spread.sum(axis=1), 1e-12)
        upright[part] = np.abs(axes[:, 2, 0]) < _UPRIGHT
    at = tree.query(points)[1]
    some = points[:: max(1, len(points) // 20_000)]
    spacing = float(np.median(cKDTree(points).query(some, k=2)[0][:, 1]))
    return Surface(foliage[at], _below_edge(points, (upright & ~foliage)[at]), spacing)


def _below_edge(points: Floats, upright: Bools) -> Bools:
    """Tell of each point whether it is upright and has more of its kind above it than a top edge is high."""
    cell = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _COLUMN).astype(np.int64)
    column = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    top = np.full(int(column.max()) + 1, -np.inf)
    np.maximum.at(top, column[upright], points[upright, 2])
    return np.asarray(upright & (points[:, 2] < top[column] - _TOP))


def _lines(size: Floats, survey: Survey, rng: np.random.Generator) -> Iterator[tuple[Floats, float, float]]:
    """Yield flight lines: the turn (2, 2) flight <- survey, metres from the middle, and the share of the density."""
    first = rng.uniform(0.0, np.pi)
    width = 2 * survey.altitude * np.tan(np.radians(survey.swath)) * (1 - _OVERLAP)
    for heading in (first, first + rng.uniform(*_CROSSING)):
        c, s = np.cos(heading), np.sin(heading)
        count = int(np.ceil(np.abs([s, c]) @ size / width)) or 1
        for k in range(count):
            share = 0.5 * (1 - _OVERLAP) if count > 1 else 0.5
            yield np.array([[c, s], [-s, c]]), (k - (count - 1) / 2) * width, share


def _met(flown: Floats, surface: Surface, density: float, survey: Survey, rng: np.random.Generator) -> Indices:
    """Return which points (N, 3), metres along, across and below the aircraft's line, give a return in its strip."""
    swath, side = np.tan(np.radians(survey.swath)), 1.0 / np.sqrt(density)
    within = np.flatnonzero(np.abs(flown[:, 1]) <= swath * flown[:, 2])
    depth = np.linalg.norm(flown[within, 1:], axis=1)
    # where the ray meets a plane below; points on one ray have one place there
    place = np.column_stack([flown[within, 0], flown[within, 1] / flown[within, 2] * survey.altitude])
    opaque = max(_OPAQUE * surface.spacing, side)
    cell, count = _cells(place, opaque)
    solid, first = ~surface.foliage[within], np.full(count, np.inf)
    np.minimum.at(first, cell[solid], depth[solid])
    # a slope of 45 degrees is not hidden by its own upper end
    seen = np.flatnonzero(~surface.wall[within] & (depth <= first[cell] + opaque + _FOOTPRINT))
    pulse, _ = _cells(place[seen], side)
    answering = _returns(pulse, depth[seen], surface.foliage[within[seen]], survey.porosity, rng)
    return np.asarray(within[seen[answering]])


def _returns(pulse: Indices, depth: Floats, foliage: Bools, porosity: float, rng: np.random.Generator) -> Indices:
    """Return which of a strip's visible points (N,) answer their pulse (N,): one of each layer that it reaches."""
    reach = np.full(int(pulse.max(initial=0)) + 1, -np.inf)
    alive = np.ones(len(reach), bool)
    found: list[Indices] = []
    for _ in range(_RETURNS):
        left = alive[pulse] & (depth > reach[pulse] + _DEAD)
        nearest = np.full(len(reach), np.inf)
        np.minimum.at(nearest, pulse[left], depth[left])
        layer = rng.permutation(np.flatnonzero(left & (depth <= nearest[pulse] + _FOOTPRINT)))
        answering, which = np.unique(pulse[layer], return_index=True)
        answers = layer[which]
        found.append(answers)
        alive[:] = False
        alive[answering] = foliage[answers] & (rng.random(len(answers)) < porosity)
        reach[answering] = depth[answers]
    return np.concatenate(found)


def _cells(places: Floats, side: float) -> tuple[Indices, int]:
    """Return the cell (N,) of each place (N, 2), metres, and how many cells there are."""
    cell = np.floor((places - places.min(axis=0, initial=np.inf)) / side).astype(np.int64)
    columns = int(cell[:, 1].max(initial=0)) + 1
    return cell[:, 0] * columns + cell[:, 1], (int(cell[:, 0].max(initial=0)) + 1) * columns
