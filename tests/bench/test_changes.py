"""Scores of ``bench changes``: what a tag is held against."""

import numpy as np
import pytest

from bench.fusion.changes import _new, distance
from coview_stream.errors import DependencyError
from coview_stream.fusion.fuse import NEW, SAME, Fused
from coview_stream.sim.casting import open3d
from coview_stream.sim.mesh import EMPTY, prism, rectangle
from coview_stream.sim.scenes import SceneState

try:
    open3d()
except DependencyError as error:
    pytest.skip(str(error), allow_module_level=True)

BOX = prism(rectangle(2.0, 2.0, 0.0), rectangle(2.0, 2.0, 1.0))
NOTHING, THERE = SceneState(EMPTY, EMPTY), SceneState(BOX, EMPTY)


def test_distance_is_to_the_nearest_surface():
    points = np.array([[3.0, 0.0, 1.0], [0.0, 0.0, 1.5]])
    assert np.allclose(distance(THERE, points), [2.0, 0.5], atol=1e-5)
    assert np.isinf(distance(NOTHING, points)).all()


def test_a_new_box_counts_and_a_ghost_does_not():
    points = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [-1.0, 0.0, 1.0], [8.0, 0.0, 1.0]], dtype=np.float32)
    change = np.array([NEW, NEW, SAME, NEW], dtype=np.uint8)
    fused = Fused(None, change, points, change, change, change, (), 0.0, 0)
    assert _new(fused, NOTHING, THERE, np.zeros(3)) == (3, pytest.approx(2 / 3), pytest.approx(2 / 3))
    assert _new(fused, THERE, THERE, np.zeros(3))[1] == 0.0
