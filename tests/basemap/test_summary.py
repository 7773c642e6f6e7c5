"""Facts about a map, its warnings, and its view on the wire."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.summary import MapView, summary
from coview_stream.errors import CoViewWarning, MapError, MessageError
from tests.basemap.test_build import SMALL


@pytest.fixture(scope="module")
def town(map_points):
    near = (np.abs(map_points[:, :2]) < 20.0).all(axis=1)
    return np.repeat(map_points[near], 3, axis=0)  # as dense as a survey


def test_summary_has_the_size_that_the_cloud_has(town, tmp_path):
    base_map = BaseMap.build(np.add(town, (5e5, 5.4e6, 100.0)), **SMALL)
    found = summary(base_map)
    assert found.width == pytest.approx(np.ptp(town[:, 0]), abs=0.5)
    assert found.depth == pytest.approx(np.ptp(town[:, 1]), abs=0.5)
    assert found.lowest == pytest.approx(100.0 + town[:, 2].min(), abs=0.3)
    assert found.highest == pytest.approx(100.0 + town[:, 2].max(), abs=0.5)
    assert 0.5 * 1600 < found.area <= 42.0**2
    assert found.density == pytest.approx(len(base_map.points) / found.area)
    base_map.save(tmp_path / "site.coview")
    assert found.bytes == pytest.approx((tmp_path / "site.coview").stat().st_size, rel=0.05)
    assert found.warnings == ()
    assert "crs unknown" in str(found)
    width, depth = found.width, found.depth
    feet = f"({width * 0.3048:.0f} x {depth * 0.3048:.0f} m if in feet: build --crs feet)"
    assert f"{width:.0f} x {depth:.0f} m {feet} with" in str(found)
    assert "feet" not in str(replace(found, crs="EPSG:25832"))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda town: town[:: max(1, len(town) // 8000)], "points/m2 are few"),
        (lambda town: town * (1.0, 1.0, 0.005), "almost nothing stands above the ground"),
        (lambda town: town[:, (0, 2, 1)] * (1, 1, -1), r"y seems to point up.*\(x, -z, y\)"),
        (lambda town: town[:, (2, 0, 1)], r"x seems to point up.*\(y, z, x\)"),
    ],
    ids=["thin", "flat", "y up", "x up"],
)
def test_survey_with_a_fault_has_a_warning(town, spoil, says):
    found = summary(BaseMap.build(spoil(town), **SMALL))
    assert any(re.search(says, warning) for warning in found.warnings), found


@pytest.mark.slow
def test_tiles_far_apart_are_told_when_a_map_is_built(town, tmp_path):
    np.save(tmp_path / "a.npy", town)
    np.save(tmp_path / "b.npy", np.add(town, (1500.0, 0.0, 0.0)))
    with pytest.warns(CoViewWarning, match=r"1\.5 km from"):
        BaseMap.build([tmp_path / "a.npy", tmp_path / "b.npy"], **SMALL)


def test_too_few_points_are_told_with_file_and_extent(tmp_path):
    degrees = np.random.default_rng(2).uniform((8.0, 50.0, 100), (8.001, 50.001, 110), (60_000, 3))
    np.save(tmp_path / "site.npy", degrees)
    with pytest.raises(MapError, match=r"site\.npy: .* over 0\.00.* x .* metres\?"):
        BaseMap.build(tmp_path / "site.npy")


def test_thinned_points_are_the_maps_and_on_the_ground_where_it_is_level(world_map):
    view = MapView.of(world_map, 4000)
    assert 1500 < len(view.points) <= 4000
    z = view.points[:, 2] + view.origin[2]
    assert np.abs(z[view.is_ground]).max() < 1.0  # the world's ground is z = 0, with the feet of its walls
    assert z[~view.is_ground].max() > 2.0
    assert 0.2 < view.is_ground.mean() < 0.95
    assert view.sha256 == world_map.sha256
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
