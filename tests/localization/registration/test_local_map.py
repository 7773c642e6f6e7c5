"""Edges of a map seen from above: where a robot may see a wall that the map does not show."""

from __future__ import annotations

import numpy as np

from coview_stream.localization.registration.local_map import roof_edges


def roof_and_ground(roof_height: float = 6.0):
    """A 10 x 10 m roof in the middle of a 40 x 40 m ground, as an aircraft sees both: no walls, none below."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-20, 20, 0.25), np.arange(-20, 20, 0.25)))
    under = (np.abs(x) < 5) & (np.abs(y) < 5)
    return np.column_stack([x, y, np.where(under, roof_height, 0.0)]).astype(np.float32)


def below(edges, points):
    return edges.at(points, -np.inf) > points[:, 2]


def test_a_wall_below_the_edge_of_a_roof_is_covered():
    edges = roof_edges(roof_and_ground())
    wall = np.array([[5.0, 0.0, 3.0], [-5.0, 1.0, 0.5], [0.0, 5.1, 5.9]])
    assert below(edges, wall).all()


def test_wall_above_roof_or_elsewhere_is_not_covered():
    edges = roof_edges(roof_and_ground())
    others = np.array([[5.0, 0.0, 7.0], [12.0, 0.0, 1.0], [0.0, 0.0, 3.0], [500.0, 0.0, 1.0]])
    # above the roof; in the open; in the middle of the house, where no wall is known; off the crop
    assert not below(edges, others).any()


def test_low_kerb_is_not_a_roof_edge():
    assert not below(roof_edges(roof_and_ground(1.5)), np.array([[5.0, 0.0, 0.5]])).any()
