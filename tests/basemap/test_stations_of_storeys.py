"""Storeys: who stands below another floor is described up to it."""

from __future__ import annotations

import numpy as np

from coview_stream.basemap.stations import below_another, describe_storeys
from coview_stream.config import DescriptorConfig


def test_only_lower_station_of_a_cell_is_below_another():
    stations = np.array([[1, 1, 0], [3, 1, 0], [1, 1, 3.2], [1, 1, 6.4]], dtype=np.float32)
    assert below_another(stations, 2.0).tolist() == [True, False, True, False]
    assert below_another(stations[:0], 2.0).tolist() == []


def test_lower_storey_descriptor_excludes_tower_on_the_roof():
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-12, 12, 0.4), np.arange(-12, 12, 0.4)))
    floors = [np.column_stack([x, y, np.full(len(x), z)]) for z in (0.0, 3.0)]
    tower = np.column_stack([np.full(60, 7.0), np.full(60, 0.2), np.linspace(3.0, 20.0, 60)])
    points = np.concatenate([*floors, tower]).astype(np.float32)
    stations = np.array([[1, 1, 0], [1, 1, 3]], dtype=np.float32)
    config = DescriptorConfig(radius=10.0, channels=("scan_context",))
    described = describe_storeys(points, stations, 2.0, config)["scan_context"].astype(float)
    assert described[0].max() < 6.0  # up to the ceiling that counts as one
    assert described[1].max() > 15.0  # the upper storey stands beside the tower
