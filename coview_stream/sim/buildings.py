"""Buildings: each function draws one at the origin, with its frontage along x and the street towards -y.

Walls reach ``_FOOTING`` below z = 0, as a building may stand on a slope. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coview_stream.sim.mesh import Mesh, box, cylinder, frustum, gable, join, placed, shed

_FOOTING = 2.0  # metres
_EAVES = 0.45  # metres

Draw = Callable[[np.random.Generator, float, float], Mesh]
"""(rng, frontage w, depth d) -> building."""


def _walls(w: float, d: float, h: float) -> Mesh:
    return placed(box(w, d, h + _FOOTING), 0.0, 0.0, -_FOOTING)


def _roof(rng: np.random.Generator, w: float, d: float, h: float) -> Mesh:
    """Draw a pitched roof with eaves on walls of height ``h``: gabled, hipped or mansard."""
    along_x = w >= d if rng.random() < 0.8 else w < d
    long, short = (w, d) if along_x else (d, w)
    rise = short * rng.uniform(0.25, 0.5)
    kind = rng.choice(["gable", "gable", "hip", "mansard"])
    if kind == "gable":
        roof = gable(long + 2 * _EAVES, short + 2 * _EAVES, rise)
    elif kind == "hip":
        roof = frustum(long + 2 * _EAVES, short + 2 * _EAVES, rise, max(long - short, 0.6), 0.3)
    else:
        roof = frustum(long + 2 * _EAVES, short + 2 * _EAVES, 0.5 * rise, 0.75 * long, 0.55 * short)
    return placed(roof, 0.0, 0.0, h, 0.0 if along_x else np.pi / 2)


def house(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw a dwelling with a pitched or flat roof, and perhaps a chimney, bay, porch, balcony or dormer."""
    h = rng.choice([3.0, 5.8, 5.8, 8.6]) + rng.uniform(-0.3, 0.6)
    parts = [_walls(w, d, h)]
    if rng.random() < 0.2:
        parts += [_flat_roof(rng, w, d, h)]
    else:
        parts += [_roof(rng, w, d, h)]
        chimney_x, chimney_y = rng.uniform(-0.3, 0.3, 2) * (w, d)
        parts.append(placed(box(0.7, 0.7, 0.3 * d + 1.2), chimney_x, chimney_y, h))
        if rng.random() < 0.4:
            parts.append(placed(box(1.8, 2.0, 1.6), rng.uniform(-0.25, 0.25) * w, -0.28 * d, h + 0.2))
    if rng.random() < 0.5:  # a bay window
        parts.append(placed(_walls(2.6, 1.0, rng.uniform(2.6, h)), rng.uniform(-0.3, 0.3) * w, -d / 2 - 0.4))
    if rng.random() < 0.4:  # a porch on two posts
        x, y = rng.uniform(-0.3, 0.3) * w, -d / 2 - 0.9
        parts.append(placed(box(2.4, 1.8, 0.2), x, y, 2.6))
        parts += [placed(cylinder(0.08, 4.6, 6), x + s * 1.1, y - 0.8, -_FOOTING) for s in (-1, 1)]
    if h > 5 and rng.random() < 0.4:  # a balcony
        parts.append(placed(box(3.0, 1.3, 1.1), rng.uniform(-0.3, 0.3) * w, d / 2 + 0.6, 2.9))
    if rng.random() < 0.35:  # a lean-to behind
        parts.append(placed(_walls(0.45 * w, 2.8, 2.7), rng.uniform(-0.25, 0.25) * w, d / 2 + 1.3))
    return join(parts)


def barn(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw a long farm building under a low saddle roof, perhaps with a silo or an open shelter."""
    h = rng.uniform(4.0, 6.5)
    parts = [_walls(w, d, h), placed(gable(w + 1.2, d + 1.2, 0.3 * d), 0, 0, h)]
    if rng.random() < 0.4:
        parts.append(placed(cylinder(1.7, rng.uniform(7, 11) + _FOOTING, 12), w / 2 + 2.2, 0, -_FOOTING))
    if rng.random() < 0.5:
        parts.append(placed(box(0.8 * w, 3.0, 0.2), 0, -d / 2 - 1.5, 3.4))
        posts = np.linspace(-0.38, 0.38, 4) * w
        parts += [placed(box(0.25, 0.25, 3.4 + _FOOTING), x, -d / 2 - 2.8, -_FOOTING) for x in posts]
    return join(parts)


def _flat_roof(rng: np.random.Generator, w: float, d: float, h: float) -> Mesh:
    """Draw parapet and rooftop plant on walls of height ``h``."""
    parts = [placed(box(w, 0.3, 0.6), 0, s * (d / 2 - 0.15), h) for s in (-1, 1)]
    parts += [placed(box(0.3, d, 0.6), s * (w / 2 - 0.15), 0, h) for s in (-1, 1)]
    for _ in range(int(rng.integers(0, 2 + int(w * d / 150)))):
        x, y = rng.uniform(-0.35, 0.35, 2) * (w, d)
        plant_w, plant_d, plant_h = rng.uniform(1.0, 3.2, 3)
        parts.append(placed(box(plant_w, plant_d, plant_h), x, y, h))
    return join(parts)


def _wing(rng: np.random.Generator, w: float, d: float, h: float) -> Mesh:
    return join([_walls(w, d, h), _flat_roof(rng, w, d, h)])


def institute(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw a large flat-roofed building (slab, L, U or court) with a stair tower, canopy or arcade."""
    h = float(rng.integers(2, 7)) * 3.6
    wing = min(12.0, 0.4 * d)
    shape = rng.choice(["slab", "L", "U", "court"])
    low = h * rng.uniform(0.5, 1.0)
    sides = {"slab": (), "L": (1,), "U": (-1, 1), "court": (-1, 1)}[str(shape)]
    depth = wing if sides else d
    parts = [placed(_wing(rng, w, depth, h), 0, (d - depth) / 2)]
    parts += [placed(_wing(rng, wing, d - depth, low), s * (w - wing) / 2, -depth / 2) for s in sides]
    if shape == "court":
        parts.append(placed(_wing(rng, w - 2 * wing, 0.7 * wing, low), 0, -(d - 0.7 * wing) / 2))
    tower = rng.uniform(-0.3, 0.3) * w
    parts.append(placed(_walls(5.0, 4.0, h + 3.2), tower, d / 2 - 2.5))
    if rng.random() < 0.6:
        parts.append(placed(box(7.0, 3.5, 0.3), tower, d / 2 + 1.7, 3.4))
    if rng.random() < 0.5:  # columns before the facade
        row = np.arange(-0.45 * w, 0.45 * w, 4.5).tolist()
        parts += [placed(cylinder(0.3, 3.4 + _FOOTING, 8), x, d / 2 + 1.2, -_FOOTING) for x in row]
    return join(parts)


def hall(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw an industrial hall: saw-tooth, flat or low-pitched roof, loading docks, an office block in front."""
    h = rng.uniform(6.0, 12.0)
    parts = [_walls(w, d, h)]
    kind = rng.choice(["saw", "flat", "pitch"])
    if kind == "saw":
        teeth = max(2, int(d / 8))
        rows = (np.arange(teeth) + 0.5) / teeth * d - d / 2
        parts += [placed(shed(w, d / teeth, 2.4), 0, y, h) for y in rows]
    else:
        parts.append(_flat_roof(rng, w, d, h) if kind == "flat" else placed(gable(w, d, 0.12 * d), 0, 0, h))
    for x in np.arange(-0.4 * w, 0.1 * w, 6.0).tolist():
        parts.append(placed(_walls(3.4, 1.2, 4.2), x, -d / 2 - 0.6))
    if rng.random() < 0.6:
        parts.append(placed(_wing(rng, 0.3 * w, 8.0, rng.uniform(6, 15)), 0.3 * w, -d / 2 - 3.9))
    return join(parts)


def passage(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw a hall with a road through it along x, gates at both ends, and columns, racks and an office inside."""
    h, wall, gate, lintel = rng.uniform(5.5, 7.0), 0.3, 9.0, 4.6
    parts = [placed(box(w, wall, h + _FOOTING), 0, s * (d - wall) / 2, -_FOOTING) for s in (-1, 1)]
    jamb = (d - gate) / 2
    for x in (-(w - wall) / 2, (w - wall) / 2):
        parts += [placed(box(wall, jamb, h + _FOOTING), x, s * (gate + jamb) / 2, -_FOOTING) for s in (-1, 1)]
        parts.append(placed(box(wall, gate, h - lintel), x, 0, lintel))
    parts += [placed(box(w, d, 0.3), 0, 0, h), placed(_flat_roof(rng, w, d, h), 0, 0, 0.3)]
    parts += [placed(box(0.4, 0.4, h + _FOOTING), x, s * 5.2, -_FOOTING)
              for x in np.arange(-0.4 * w, 0.41 * w, 8.0).tolist() for s in (-1, 1)]  # fmt: skip
    side = float(rng.choice([-1.0, 1.0]))
    parts.append(placed(box(9.0, 4.0, 3.0 + _FOOTING), rng.uniform(-0.3, 0.3) * w, side * (d / 2 - 2.3), -_FOOTING))
    for away in (-side, side):
        for x in np.arange(-0.44 * w, 0.45 * w, 3.5).tolist():
            if rng.random() < 0.75:
                tall, deep = rng.uniform(0.8, 4.5), rng.uniform(0.8, 2.4)
                from_wall = rng.uniform(0.0, 1.5) + (4.0 if away == side else 0.0)  # the office is 4 m deep
                rack = box(rng.uniform(1.0, 3.2), deep, tall + _FOOTING)
                parts.append(
                    placed(rack, x + rng.uniform(-0.5, 0.5), away * (d / 2 - wall - deep / 2 - from_wall), -_FOOTING)
                )
    return join(parts)


def tanks(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw a row of tanks or silos with a pipe bridge."""
    radius = min(w, d) / rng.uniform(3.0, 5.0)
    count = max(1, int(w / (2.3 * radius)))
    rows = (np.arange(count) + 0.5) / count * w - w / 2
    height = rng.uniform(5.0, 16.0)
    parts = []
    for x in rows:
        body = cylinder(radius, height + _FOOTING, 16)
        dome = cylinder(radius, 0.3 * radius, 16, top=0.2 * radius)
        parts.append(placed(join([body, placed(dome, 0, 0, height + _FOOTING)]), x, 0, -_FOOTING))
    parts.append(placed(box(w, 0.8, 0.5), 0, -radius - 0.8, 4.5))
    parts += [placed(box(0.3, 0.3, 4.5 + _FOOTING), x, -radius - 0.8, -_FOOTING) for x in rows]
    return join(parts)


def containers(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw stacks of shipping containers."""
    parts = []
    for x in np.arange(-w / 2 + 3.1, w / 2 - 3.0, 6.6).tolist():
        for y in np.arange(-d / 2 + 1.3, d / 2 - 1.2, 2.7).tolist():
            stack = int(rng.integers(0, 4))
            if stack:
                parts.append(placed(box(6.06, 2.44, 2.6 * stack + _FOOTING), x, y, -_FOOTING))
    return join(parts)


def cabin(rng: np.random.Generator, w: float, d: float) -> Mesh:
    """Draw a forest hut with a wood pile."""
    h = rng.uniform(2.4, 3.2)
    pile = placed(frustum(w * 0.8, 1.2, 1.6 + _FOOTING, w * 0.7, 0.8), 0, d / 2 + 1.4, -_FOOTING)
    return join([_walls(w, d, h), placed(gable(w + 1, d + 1, 0.4 * d), 0, 0, h), pile])
