"""Airborne scan for the base map: an aircraft sweeps the scene in strips, in two directions.

The numbers follow data sheets of airborne scanners.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from coview_stream.clouds.filters import voxel_grid
from coview_stream.config.checks import within
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats, Indices, Reals
from coview_stream.sim.sensors import MeshCaster

ALTITUDE = 250.0
"""Metres above the scene's zero."""

SWATH = float(np.radians(26.0))
"""Half the opening angle across the flight direction, radians."""

RANGE_NOISE = 0.025
"""Metres, one sigma."""

POROSITY = 0.5
"""Probability that a pulse passes one surface of foliage."""

_OVERLAP = 0.2  # share of a strip's width
_FOOTPRINT = 6e-4  # radians, one sigma of the pointing


@dataclass(frozen=True)
class Flight:
    """Flight over the scene."""

    altitude: float = ALTITUDE  # metres above the scene's zero
    swath: float = SWATH  # half the opening angle across the flight direction, radians
    noise: float = RANGE_NOISE  # range noise, metres, one sigma
    porosity: float = POROSITY  # probability that a pulse passes one surface of foliage
    margin: float = 15.0  # metres beyond the map within which pulses aimed at the scene's zero are cast


_DEFAULT_FLIGHT = Flight()


def airborne_scan(
    caster: MeshCaster, size: float, density: float, rng: np.random.Generator, flight: Flight = _DEFAULT_FLIGHT
) -> Iterator[tuple[float, Floats]]:
    """Scan the square of ``size`` metres with ``density`` pulses per square metre, strip by strip.

    Yields the completed share of the flight (0 to 1) and the strip's points (N, 3) in the scene frame, float64 metres.
    Two flight directions with half of the pulses each cross at 75 to 105 degrees, so that facades of all headings are
    grazed.
    """
    first = rng.uniform(0, np.pi)
    headings = (first, first + np.radians(rng.uniform(75, 105)))
    strips = [(heading, line) for heading in headings for line in _lines(size, flight)]
    for done, (heading, line) in enumerate(strips, start=1):
        yield done / len(strips), _strip(caster, heading, line, size, density / 2, rng, flight)


def _lines(size: float, flight: Flight) -> Floats:
    """Return offsets of the flight lines from the centre, metres; strips overlap and cover the corners."""
    reach, width = size / np.sqrt(2), 2 * flight.altitude * np.tan(flight.swath) * (1 - _OVERLAP)
    count = int(np.ceil(2 * reach / width))
    return np.asarray((np.arange(count) - (count - 1) / 2) * width)


def _strip(
    caster: MeshCaster,
    heading: float,
    line: float,
    size: float,
    density: float,
    rng: np.random.Generator,
    flight: Flight,
) -> Floats:
    half, reach = size / 2, size / np.sqrt(2)
    width = 2 * flight.altitude * np.tan(flight.swath)
    # strips overlap: thin each one to keep the mean density
    spacing = 1.0 / np.sqrt(density * (1 - _OVERLAP) if len(_lines(size, flight)) > 1 else density)
    sweeps, beams = int(2 * reach / spacing), int(width / spacing)
    turn = np.array([[np.cos(heading), np.sin(heading), 0], [-np.sin(heading), np.cos(heading), 0], [0, 0, 1]])
    points = []
    per_block = max(1, 400_000 // beams)
    for first in range(0, sweeps, per_block):
        k = np.arange(first, min(first + per_block, sweeps))
        along = (np.repeat(k, beams) + rng.uniform(0, 0.8, len(k) * beams)) * spacing - reach
        tangent = np.tile((np.arange(beams) + 0.5) / beams * 2 - 1, len(k)) * np.tan(flight.swath)
        tangent = tangent + rng.normal(0, 0.3 * spacing / flight.altitude, len(tangent))
        origins = np.column_stack([along, np.full(len(along), line), np.full(len(along), flight.altitude)])
        ray = np.column_stack([rng.normal(0, _FOOTPRINT, len(along)), tangent, np.full(len(along), -1.0)])
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        origins, ray = origins @ turn, ray @ turn
        # skip pulses whose target cannot be on the map
        target = origins[:, :2] + ray[:, :2] / -ray[:, 2:] * flight.altitude
        near = (np.abs(target) < half + flight.margin).all(axis=1)
        origins, ray = origins[near], ray[near]
        hits = caster.trace(origins.astype(np.float32), ray.astype(np.float32), rng, flight.porosity)
        hit = np.isfinite(hits.distance)
        t = hits.distance[hit].astype(np.float64) + rng.normal(0, flight.noise, int(hit.sum()))
        met = origins[hit] + ray[hit] * t[:, None]
        points.append(met[(np.abs(met[:, :2]) < half).all(axis=1)])
    return np.concatenate(points) if points else np.zeros((0, 3))


_CROSSING = np.radians((75.0, 105.0))  # between the two flight directions
_RETURNS, _DEAD = 4, 1.0  # most returns of a pulse, and metres between two of them
_RETURN_DEPTH = 0.3  # metres of depth that merge into one return
_GRID, _NEIGHBOURS = 0.3, 16  # metres; neighbours on that grid that determine the surface at a point
_SCATTERED = 0.06  # least share of the spread across the surface in foliage
_UPRIGHT = 0.35  # greatest |z| of a wall's normal: steeper than 70 degrees
_TOP = 0.5  # metres: a wall's top edge
_COLUMN = 1.0  # metres: points above a wall point within this distance belong to its wall
_OPAQUE = 3.0  # width of a cell that a surface fills, in typical distances between neighbours


@dataclass(frozen=True)
class Survey:
    """Flight over a ground survey.

    Raises:
        ConfigError: a value out of its range.
    """

    density: float = 8.0  # first returns per square metre, where the ground survey is dense enough
    swath: float = float(np.degrees(SWATH))  # half the opening angle across the flight direction, degrees
    altitude: float = ALTITUDE  # metres above the highest point
    noise: float = RANGE_NOISE  # range noise, metres, one sigma
    porosity: float = POROSITY  # probability that a pulse passes a layer of foliage
    misaligned: float = 0.0  # shift of each strip, metres, one sigma per axis
    seed: int = 1  # of flight directions, pulses and noise

    def __post_init__(self) -> None:
        within(
            self,
            density=(0.5, 200.0),
            swath=(1.0, 45.0),
            altitude=(20.0, 5000.0),
            noise=(0.0, 1.0),
            porosity=(0.0, 1.0),
            misaligned=(0.0, 1.0),
            seed=(0, 2**31 - 1),
        )


_DEFAULT = Survey()


@dataclass(frozen=True)
class Surface:
    """Kind of surface at each point of a cloud."""

    foliage: Bools  # (N,) whether the neighbours are scattered and lie on no surface
    wall: Bools  # (N,) whether the point is on a wall below its top edge
    spacing: float  # typical distance to the nearest neighbour, metres


def airborne_survey(points: Reals, survey: Survey = _DEFAULT) -> Floats:
    """Return the points (M, 3) of a ground survey (N, 3) that an aircraft's lidar would hit, float64 metres.

    Coordinates are near zero, z up. InputError for too few points to fit surfaces.
    """
    places: Floats = points.astype(np.float64)
    rng, surface = np.random.default_rng(survey.seed), surface_of(places)
    low, high = places.min(axis=0), places.max(axis=0)
    strips = []
    for turn, line, share in _survey_lines((high - low)[:2], survey, rng):
        across = (places[:, :2] - 0.5 * (low + high)[:2]) @ turn.T - [0.0, line]
        flown = np.column_stack([across, high[2] + survey.altitude - places[:, 2]])
        met = _met(flown, surface, survey.density * share, survey, rng)
        ray = flown[met] * [0.0, 1.0, -1.0] / np.linalg.norm(flown[met, 1:], axis=1)[:, None]
        ray[:, :2] = ray[:, :2] @ turn
        shift = rng.normal(0.0, survey.misaligned, 3)
        strips.append(places[met] + ray * rng.normal(0.0, survey.noise, len(met))[:, None] + shift)
    return np.concatenate(strips)


def surface_of(points: Floats) -> Surface:
    """Find walls and foliage by the spread of the neighbours of each point (N, 3); InputError for too few points."""
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
    sample = points[:: max(1, len(points) // 20_000)]
    spacing = float(np.median(cKDTree(points).query(sample, k=2)[0][:, 1]))
    wall = (upright & ~foliage)[at]
    column, count = _cells(points[:, :2], _COLUMN)
    top = np.full(count, -np.inf)
    np.maximum.at(top, column[wall], points[wall, 2])
    return Surface(foliage[at], wall & (points[:, 2] < top[column] - _TOP), spacing)


def _survey_lines(size: Floats, survey: Survey, rng: np.random.Generator) -> Iterator[tuple[Floats, float, float]]:
    """Yield flight lines: rotation (2, 2) flight <- survey, metres from the centre, and share of the density."""
    first = rng.uniform(0.0, np.pi)
    width = 2 * survey.altitude * np.tan(np.radians(survey.swath)) * (1 - _OVERLAP)
    for heading in (first, first + rng.uniform(*_CROSSING)):
        c, s = np.cos(heading), np.sin(heading)
        count = int(np.ceil(np.abs([s, c]) @ size / width)) or 1
        for k in range(count):
            share = 0.5 * (1 - _OVERLAP) if count > 1 else 0.5
            yield np.array([[c, s], [-s, c]]), (k - (count - 1) / 2) * width, share


def _met(flown: Floats, surface: Surface, density: float, survey: Survey, rng: np.random.Generator) -> Indices:
    """Return which points (N, 3), metres along, across and below the flight line, give a return in its strip."""
    swath, side = np.tan(np.radians(survey.swath)), 1.0 / np.sqrt(density)
    swept = np.flatnonzero(np.abs(flown[:, 1]) <= swath * flown[:, 2])
    depth = np.linalg.norm(flown[swept, 1:], axis=1)
    # intersection of the ray with a plane below, the same for all points on one ray
    place = np.column_stack([flown[swept, 0], flown[swept, 1] / flown[swept, 2] * survey.altitude])
    opaque = max(_OPAQUE * surface.spacing, side)
    cell, count = _cells(place, opaque)
    solid, first = ~surface.foliage[swept], np.full(count, np.inf)
    np.minimum.at(first, cell[solid], depth[solid])
    # the upper end of a 45-degree slope does not hide the slope
    visible = np.flatnonzero(~surface.wall[swept] & (depth <= first[cell] + opaque + _RETURN_DEPTH))
    pulse, _ = _cells(place[visible], side)
    answering = _answers(pulse, depth[visible], surface.foliage[swept[visible]], survey.porosity, rng)
    return np.asarray(swept[visible[answering]])


def _answers(pulse: Indices, depth: Floats, foliage: Bools, porosity: float, rng: np.random.Generator) -> Indices:
    """Return which visible points (N,) of a strip return their pulse (N,): one in each layer that it reaches."""
    reach = np.full(int(pulse.max(initial=0)) + 1, -np.inf)
    alive = np.ones(len(reach), bool)
    returns: list[Indices] = []
    for _ in range(_RETURNS):
        left = alive[pulse] & (depth > reach[pulse] + _DEAD)
        nearest = np.full(len(reach), np.inf)
        np.minimum.at(nearest, pulse[left], depth[left])
        layer = rng.permutation(np.flatnonzero(left & (depth <= nearest[pulse] + _RETURN_DEPTH)))
        answering, which = np.unique(pulse[layer], return_index=True)
        answers = layer[which]
        returns.append(answers)
        alive[:] = False
        alive[answering] = foliage[answers] & (rng.random(len(answers)) < porosity)
        reach[answering] = depth[answers]
    return np.concatenate(returns)


def _cells(places: Floats, side: float) -> tuple[Indices, int]:
    """Return the cell (N,) of each place (N, 2), metres, and the number of cells."""
    cell = np.floor((places - places.min(axis=0, initial=np.inf)) / side).astype(np.int64)
    columns = int(cell[:, 1].max(initial=0)) + 1
    return cell[:, 0] * columns + cell[:, 1], (int(cell[:, 0].max(initial=0)) + 1) * columns
