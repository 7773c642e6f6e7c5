"""Airborne scan for the base map: an aircraft that sweeps the scene in strips, in two directions.

All figures are set by hand, after data sheets of airborne scanners.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.sim.caster import MeshCaster

ALTITUDE = 250.0
"""Metres above the scene's zero."""

SWATH = float(np.radians(26.0))
"""Half of the opening angle across the flight direction, radians."""

RANGE_NOISE = 0.025
"""Metres, one sigma."""

POROSITY = 0.5
"""Probability that a pulse passes one surface of foliage."""

_OVERLAP = 0.2  # share of a strip's width
_FOOTPRINT = 6e-4  # radians, one sigma of the pointing


@dataclass(frozen=True)
class Flight:
    """Flight over the scene.

    Attributes:
        altitude: metres above the scene's zero.
        swath: half of the opening angle across the flight direction, radians.
        noise: of the range, metres, one sigma.
        porosity: probability that a pulse passes one surface of foliage.
        margin: metres beyond the map in which pulses aimed at the scene's zero may still meet what is on it.
    """

    altitude: float = ALTITUDE
    swath: float = SWATH
    noise: float = RANGE_NOISE
    porosity: float = POROSITY
    margin: float = 15.0


_DEFAULT_FLIGHT = Flight()


def airborne_scan(
    caster: MeshCaster, size: float, density: float, rng: np.random.Generator, flight: Flight = _DEFAULT_FLIGHT
) -> Iterator[tuple[float, Floats]]:
    """Scan the square of ``size`` metres with ``density`` pulses per square metre, strip by strip.

    Yields the share of the flight that is done (0 to 1) and the strip's points (N, 3) in the scene frame,
    float64 metres. Two flight directions cross at 75 to 105 degrees; each brings half of the pulses, so that
    facades of every heading are grazed.
    """
    first = rng.uniform(0, np.pi)
    headings = (first, first + np.radians(rng.uniform(75, 105)))
    strips = [(heading, line) for heading in headings for line in _lines(size, flight)]
    for done, (heading, line) in enumerate(strips, start=1):
        yield done / len(strips), _strip(caster, heading, line, size, density / 2, rng, flight)


def _lines(size: float, flight: Flight) -> Floats:
    """Return offsets of the flight lines from the middle, metres: strips overlap and cover the corners."""
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
    # the overlap brings some squares twice; thin each strip so that the mean density is what was asked for
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
        # pulses whose target cannot be on the map are not worth casting
        target = origins[:, :2] + ray[:, :2] / -ray[:, 2:] * flight.altitude
        near = (np.abs(target) < half + flight.margin).all(axis=1)
        points.append(_returns(caster, origins[near], ray[near], half, rng, flight))
    return np.concatenate(points) if points else np.zeros((0, 3))


def _returns(
    caster: MeshCaster, origins: Floats, rays: Floats, half: float, rng: np.random.Generator, flight: Flight
) -> Floats:
    t = caster.trace(_single(origins), _single(rays), rng, flight.porosity).distance.astype(np.float64)
    hit = np.isfinite(t)
    t = t[hit] + rng.normal(0, flight.noise, int(hit.sum()))
    points = origins[hit] + rays[hit] * t[:, None]
    return np.asarray(points[(np.abs(points[:, :2]) < half).all(axis=1)])


def _single(values: Floats) -> Floats32:
    return values.astype(np.float32)
