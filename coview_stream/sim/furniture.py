"""Street furniture: parked vehicles, lamp posts, signs and masts. Sizes in metres."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from coview_stream.geometry.arrays import Floats
from coview_stream.sim.layout import Layout, Site, directions
from coview_stream.sim.mesh import Mesh, box, cylinder, frustum, join, placed

_LORRIES = 0.95  # least ``kind`` of a lorry
_SIGNS = (0.6, 0.85)  # range of the ``kind`` of poles that carry a sign
_MIN_CLEARANCE = 2.2  # metres from the robot's route to the middle of a vehicle


def spots(rng: np.random.Generator, layout: Layout, spacing: float, offset: float) -> Floats:
    """Return places (N, 4) x, y, yaw, kind at ``offset`` metres from the streets' centre lines, in random order.

    Crossings have no places. ``kind`` is a random number in [0, 1).
    """
    tree = cKDTree(np.concatenate(layout.streets))
    rows = []
    for line in layout.streets:
        heading = directions(line)
        for side in (-1.0, 1.0):
            at = np.arange(rng.uniform(0, spacing), len(line) - 1, spacing) + rng.uniform(-0.1, 0.1) * spacing
            k = np.clip(at.astype(int), 0, len(line) - 1)
            normal = np.column_stack([-np.sin(heading[k]), np.cos(heading[k])])
            xy = line[k] + side * offset * normal
            yaw = heading[k] + (np.pi if side > 0 else 0.0) + rng.normal(0, 0.03, len(k))
            rows.append(np.column_stack([xy, yaw, rng.random(len(k))]))
    places = np.concatenate(rows)
    clear = tree.query(places[:, :2])[0] > 0.8 * offset
    # both ends of a parked vehicle leave the robot's lane free
    reach = np.where(places[:, 3] < _LORRIES, 2.7, 4.5)[:, None]
    along = reach * np.column_stack([np.cos(places[:, 2]), np.sin(places[:, 2])])
    ends = places[:, :2] + np.multiply.outer([-1.0, -0.5, 0.5, 1.0], along)
    clear &= (cKDTree(layout.route).query(ends)[0] > _MIN_CLEARANCE).all(axis=0)
    return np.asarray(rng.permutation(places[clear]))


def cars(rows: Floats, site: Site) -> Mesh:
    """Return parked cars, vans and, for the largest ``kind``, lorries."""
    return join(_stand(vehicle(kind), site, x, y, yaw) for x, y, yaw, kind in rows)


def poles(rows: Floats, site: Site) -> Mesh:
    """Return lamp posts with an arm over the road, traffic signs and masts."""
    return join(_stand(_pole(kind), site, x, y, yaw) for x, y, yaw, kind in rows)


def sign_plates(rows: Floats, site: Site) -> Mesh:
    """Return the plates of the traffic signs among ``rows``, slightly larger than in :func:`poles`."""
    signs = rows[(rows[:, 3] >= _SIGNS[0]) & (rows[:, 3] < _SIGNS[1])]
    return join(_stand(placed(box(0.1, 0.74, 0.74), 0, 0, 1.98), site, x, y, yaw) for x, y, yaw, _ in signs)


def _stand(mesh: Mesh, site: Site, x: float, y: float, yaw: float) -> Mesh:
    return placed(mesh, x, y, site.height(x, y), yaw)


def vehicle(kind: float) -> Mesh:
    """Return a car, van or lorry at the origin with its front towards +x; ``kind`` is in [0, 1)."""
    scale = 0.9 + 0.25 * ((kind * 7.0) % 1.0)
    if kind < 0.75:
        body = placed(box(4.3 * scale, 1.75, 0.65), 0, 0, 0.25)
        cabin = placed(frustum(2.5 * scale, 1.65, 0.6, 1.6 * scale, 1.4), -0.2, 0, 0.9)
        return join([body, cabin])
    if kind < _LORRIES:
        return join([placed(box(4.9, 1.9, 1.9), -0.3, 0, 0.25), placed(frustum(0.9, 1.8, 0.9, 0.5, 1.7), 2.5, 0, 0.3)])
    return join([placed(box(6.2, 2.4, 2.7), -0.9, 0, 0.9), placed(box(2.0, 2.3, 2.5), 3.3, 0, 0.4)])


def _pole(kind: float) -> Mesh:
    tall = 4.5 + 4.0 * ((kind * 11.0) % 1.0)
    if kind < _SIGNS[0]:
        # +y points to the road where spots() puts places
        arm = placed(box(0.12, 1.6, 0.12), 0, 0.8, tall - 0.2)
        return join([cylinder(0.1, tall, 6, top=0.06), arm])
    if kind < _SIGNS[1]:
        return join([cylinder(0.05, 2.6, 6), placed(box(0.08, 0.7, 0.7), 0, 0, 2.0)])
    return join([cylinder(0.18, tall + 2.0, 8, top=0.1), placed(box(1.2, 0.15, 0.15), 0, 0, tall + 1.2)])
