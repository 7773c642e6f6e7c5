"""Where the streets run, and the closed loop that the robot drives along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

_LOOP_STEP = 0.25
_STREET_STEP = 1.0


@dataclass(frozen=True)
class Layout:
    """Streets of a scene.

    Attributes:
        route: (N, 2) closed loop, metres, points ``_LOOP_STEP`` apart; it is one of the streets.
        streets: (K_i, 2) centre lines, metres, points a metre apart.
        half_width: metres from the centre line to the edge of the carriageway.
    """

    route: Floats
    streets: tuple[Floats, ...]
    half_width: float


def resample(points: Floats, step: float) -> Floats:
    """Polyline (N, 2) with points ``step`` metres apart."""
    arc = arc_lengths(points)
    count = max(2, round(arc[-1] / step) + 1)
    at = np.linspace(0.0, arc[-1], count)
    return np.column_stack([np.interp(at, arc, points[:, 0]), np.interp(at, arc, points[:, 1])])


def arc_lengths(points: Floats) -> Floats:
    """(N,) metres along a polyline (N, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def directions(points: Floats) -> Floats:
    """(N,) headings of a polyline (N, 2), radians."""
    tangent = np.gradient(points, axis=0)
    return np.asarray(np.arctan2(tangent[:, 1], tangent[:, 0]))


def grid_layout(
    rng: np.random.Generator,
    size: float,
    half: float,
    spacing: tuple[float, float],
    half_width: float,
    bend: float,
) -> Layout:
    """Blocks between crossing streets; the loop goes round some blocks. ``bend`` metres curve the streets."""
    yaw = rng.uniform(0, np.pi / 2)
    xs, x0, x1 = _loop_lines(_street_lines(rng, half, spacing), size)
    ys, y0, y1 = _loop_lines(_street_lines(rng, half, spacing), size)
    across = np.linspace(-1.5 * half, 1.5 * half, 200)
    straight = [np.column_stack([np.full(200, x), across]) for x in xs]
    straight += [np.column_stack([across, np.full(200, y)]) for y in ys]
    phase = rng.uniform(0, 2 * np.pi, 2)
    length = rng.uniform(110, 170)

    def warp(points: Floats) -> Floats:
        x, y = points.T
        bent = np.column_stack(
            [
                x + bend * np.sin(y * 2 * np.pi / length + phase[0]),
                y + bend * np.sin(x * 6.0 / length + phase[1]),
            ]
        )
        c, s = np.cos(yaw), np.sin(yaw)
        return np.asarray(bent @ np.array([[c, s], [-s, c]]))

    route = resample(warp(_rounded_rectangle(x0, x1, y0, y1, radius=7.0)), _LOOP_STEP)
    streets = [_inside(resample(warp(line), _STREET_STEP), half) for line in straight]
    return Layout(route, tuple(line for line in streets if len(line) > 10), half_width)


def loop_layout(
    rng: np.random.Generator, size: float, half: float, half_width: float, branches: int, waviness: float
) -> Layout:
    """Winding loop with side roads that leave it outwards, and one path across its middle."""
    angle = np.linspace(0, 2 * np.pi, 1500)
    radius = np.ones_like(angle)
    for k in (2, 3, 4):
        radius += waviness / k * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    scale = rng.uniform(0.22, 0.29, 2) * size / radius.max()
    turn, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.05, 0.05, 2) * size
    loop = np.column_stack([scale[0] * radius * np.cos(angle), scale[1] * radius * np.sin(angle)])
    loop = loop @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + shift
    route = resample(loop, _LOOP_STEP)
    streets = [resample(route, _STREET_STEP)]
    for start in rng.permutation(branches):
        at = int((start + rng.uniform(0.1, 0.9)) / branches * (len(route) - 1))
        outward = directions(route)[at] - np.pi / 2  # the loop runs counter-clockwise
        streets.append(_inside(_wander(rng, route[at], outward, 2 * half), half))
    a, b = rng.integers(0, len(route) // 3), rng.integers(len(route) // 2, 5 * len(route) // 6)
    streets.append(resample(route[[a, b]], _STREET_STEP))
    return Layout(route, tuple(line for line in streets if len(line) > 10), half_width)


def _wander(rng: np.random.Generator, start: Floats, heading: float, length: float) -> Floats:
    turns = np.cumsum(rng.normal(0, 0.02, int(length / _STREET_STEP)))
    step = _STREET_STEP * np.column_stack([np.cos(heading + turns), np.sin(heading + turns)])
    return np.asarray(start + np.cumsum(step, axis=0))


def _street_lines(rng: np.random.Generator, half: float, spacing: tuple[float, float]) -> Floats:
    gaps = rng.uniform(*spacing, size=int(3.2 * half / spacing[0]) + 2)
    lines = np.cumsum(gaps)
    return np.asarray(lines - lines[len(lines) // 2] + rng.uniform(-0.5, 0.5) * spacing[0])


def _loop_lines(lines: Floats, size: float) -> tuple[Floats, float, float]:
    """Pick the two street lines that bound the loop; return all lines and those two.

    They are the ones next to a quarter of the map's size on either side of its middle, moved where that would
    lead out of the map; streets that then run too close beside them are left out.
    """
    near, far = 0.14 * size, 0.28 * size
    low = np.clip(lines[np.argmin(np.abs(lines + 0.24 * size))], -far, -near)
    high = np.clip(lines[np.argmin(np.abs(lines - 0.24 * size))], near, far)
    apart = 0.5 * float(np.diff(lines).min())
    clear = (np.abs(lines - low) > apart) & (np.abs(lines - high) > apart)
    return np.concatenate([lines[clear], [low, high]]), float(low), float(high)


def _rounded_rectangle(x0: float, x1: float, y0: float, y1: float, radius: float) -> Floats:
    corners = [(x1, y0, -np.pi / 2), (x1, y1, 0.0), (x0, y1, np.pi / 2), (x0, y0, np.pi)]
    points = []
    for x, y, begin in corners:
        centre = np.array([x - radius if x == x1 else x + radius, y - radius if y == y1 else y + radius])
        arc = begin + np.linspace(0, np.pi / 2, 20)
        points.append(centre + radius * np.column_stack([np.cos(arc), np.sin(arc)]))
    loop = np.concatenate([*points, points[0][:1]])
    return resample(loop, 1.0)


def _inside(points: Floats, half: float) -> Floats:
    return points[(np.abs(points) < half).all(axis=1)]
