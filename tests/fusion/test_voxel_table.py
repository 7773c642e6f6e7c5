"""Voxel table: what frames bring is merged by voxel."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.errors import InputError
from coview_stream.fusion import sightings
from coview_stream.fusion.sightings import VoxelTable, cells_of, keys_of


def test_keys_go_there_and_back():
    cells = np.array([[0, 0, 0], [-5, 7, -1], [900_000, -900_000, 12]], dtype=np.float64)
    assert np.array_equal(cells_of(keys_of(cells)), cells)


@pytest.mark.parametrize("buffer", [1, 1000])
def test_points_of_a_voxel_are_averaged(monkeypatch, buffer):
    monkeypatch.setattr(sightings, "_BUFFER", buffer)
    table = VoxelTable(0.5)
    table.add(np.array([[-0.1, 0.1, 3.1], [10.0, 0.0, 0.0]], dtype=np.float32), 5.0, 2)
    table.add(np.array([[-0.3, 0.3, 3.3]], dtype=np.float32), 4.0, 1)
    assert len(table) == 2
    rows = table.rows()
    assert rows["hits"].tolist() == [2, 1]
    assert rows["stamp"].tolist() == [5.0, 5.0]
    assert rows["source"].tolist() == [1, 2]
    assert np.allclose(table.points(), [[-0.2, 0.2, 3.2], [10.0, 0.0, 0.0]], atol=1e-5)


def test_points_beyond_all_maps_are_refused():
    with pytest.raises(InputError, match="km from the map"):
        VoxelTable(0.02).add(np.array([[1e6, 0, 0]], dtype=np.float32), 0.0, 1)
