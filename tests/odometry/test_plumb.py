"""Walls and ground around a frame, as directions for a filter."""

from __future__ import annotations

import numpy as np
from fake_lidar_odometry import frame

from coview_stream.geometry.transforms import rot_z
from coview_stream.odometry.gravity import Surfaces, ground_plane, level_rotation


def test_walls_and_ground_of_a_tilted_frame_point_up(scene):
    cloud, up = frame(scene, (0.05, -0.04))
    around = Surfaces.around(cloud, np.array([0.0, 0.0, 1.0]), None)
    seen = around.seen(rot_z(0.7) @ level_rotation(up))
    assert np.degrees(np.abs(seen.walls).max()) < 0.2
    assert np.degrees(np.abs(seen.ground).max()) < 0.3
    assert np.degrees(np.sqrt(np.diag(seen.covariance)).max()) < 2.0
    assert len(seen.rows()[1]) == 4


def test_nothing_around_is_nothing_seen():
    around = Surfaces.around(np.zeros((0, 3)), np.array([0.0, 0.0, 1.0]), None)
    seen = around.seen(np.eye(3))
    assert seen.walls is None
    assert seen.ground is None
    assert len(seen.rows()[1]) == 0
    assert np.isfinite(seen.covariance).all()


def test_ground_is_found_again_from_the_one_before(scene):
    cloud, _ = frame(scene, (0.02, 0.0))
    anew = ground_plane(cloud)
    again = ground_plane(cloud, ground_plane(frame(scene)[0]))
    assert np.degrees(np.arccos(np.clip(anew.up @ again.up, -1, 1))) < 0.3
    assert abs(anew.height - again.height) < 0.03


def test_ground_that_is_gone_is_searched_for_anew(scene):
    cloud, up = frame(scene)
    above = ground_plane(cloud + np.array([0.0, 0.0, -6.0]))  # a sensor that stood 6 m higher
    found = ground_plane(cloud, above)
    assert np.degrees(np.arccos(np.clip(found.up @ up, -1, 1))) < 0.3
