"""The view of a map: thinned, told apart as ground and structure, through JSON and back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from coview_stream.basemap.summary import MapView
from coview_stream.errors import MessageError


def test_thinned_points_are_the_maps_and_on_the_ground_where_it_is_level(world_map):
    view = MapView.of(world_map, 4000)
    assert 1500 < len(view.points) <= 4000
    z = view.points[:, 2] + view.origin[2]
    assert np.abs(z[view.is_ground]).max() < 1.0  # the world's ground is z = 0, with the feet of its walls
    assert z[~view.is_ground].max() > 2.0
    assert 0.2 < view.is_ground.mean() < 0.95
    assert view.sha256 == world_map.sha256


def test_few_points_are_all_kept(world_map):
    assert len(MapView.of(world_map, 10**6).points) == len(world_map.points)


def test_json_keeps_places_to_the_step(world_map):
    view = MapView.of(world_map, 2000)
    data = json.loads(json.dumps(view.to_json()))
    back = MapView.from_json(data)
    there = view.points[np.argsort(~view.is_ground, kind="stable")] + view.origin
    assert np.abs(back.points + back.origin - there).max() < data["step_m"]
    assert back.is_ground.sum() == view.is_ground.sum()
    assert (back.sha256, back.crs) == (view.sha256, view.crs)


def test_json_of_a_wide_map_keeps_its_corners():
    points = np.array([[-3000.0, 0.0, -5.0], [9000.0, 100.0, 80.0]], dtype=np.float32)
    view = MapView(np.array([5e5, 5.8e6, 40.0]), points, np.array([True, False]), "EPSG:25832", "ab")
    back = MapView.from_json(view.to_json())
    assert np.abs(back.points + back.origin - points - view.origin).max() < 0.25


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("count", -1), ("count", 10**9), ("count", True), ("ground", 99), ("step_m", 0), ("step_m", None),
        ("step_m", 1e300), ("origin", [1, 2]), ("origin", [1, 2, 1e300]), ("points", "!!"), ("points", "AAAA"),
        ("points", 7), ("crs", 5), ("map_sha256", None),
    ],
)  # fmt: skip
def test_what_is_no_view_is_refused(name, value):
    view = MapView(np.zeros(3), np.ones((2, 3), dtype=np.float32), np.array([True, False]), None, "ab")
    with pytest.raises(MessageError, match="map view"):
        MapView.from_json(view.to_json() | {name: value})
