"""Sightings: rays that end at points, and rays that go through them."""

import numpy as np
import pytest

from coview_stream.errors import InputError
from coview_stream.fusion import sightings
from coview_stream.fusion.localized_run import PosedFrame
from coview_stream.fusion.sightings import Sightings, VoxelTable, cells_of, keys_of, looks_at
from coview_stream.geometry.transforms import pose_from, rot_z

T = pose_from(rot_z(0.7), [30.0, -20.0, 2.0])
EYE = np.array([0.0, 0.0, 0.5])


def wall(x):
    y, z = np.meshgrid(np.arange(-4, 4, 0.03), np.arange(-1.5, 3, 0.03))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]).astype(np.float32)


def test_points_before_at_behind_and_beside_a_wall():
    frame = PosedFrame(0.0, wall(10.0), T, EYE)
    body = np.array([[5.0, 0.0, 0.6], [10.1, 1.0, 0.5], [15.0, 0.0, 0.6], [-5.0, 0.0, 0.6], [9.9, -1.0, 0.5]])
    points = (body @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    sightings = Sightings(points, 0.3)
    for _ in range(2):
        sightings.look(frame)
    assert sightings.given(sightings.through).tolist() == [2, 0, 0, 0, 0]
    assert sightings.given(sightings.seen).tolist() == [0, 2, 0, 0, 2]


def test_no_points_and_no_rays():
    sightings = Sightings(np.zeros((0, 3), np.float32), 0.3)
    sightings.look(PosedFrame(0.0, np.zeros((0, 3), np.float32), T, EYE))
    assert len(sightings.through) == 0


def test_looks_are_apart_in_space_or_time():
    positions = np.column_stack([np.r_[0.0, 0.2, 0.4, 0.6, 0.6, 0.6], np.zeros(6), np.zeros(6)])
    assert looks_at(np.r_[0.0, 0.1, 0.2, 0.3, 0.9, 1.4], positions).tolist() == [True, False, False, True, False, True]


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
