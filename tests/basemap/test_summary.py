"""What a build says of its map: sizes that a person can check, and what will make robots fail."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.summary import summary
from coview_stream.errors import CoViewWarning, MapError

SMALL = {"radius": 15.0, "rings": 6, "sectors": 12}


def built(folder, points, **options):
    np.save(folder / "site.npy", points)
    return BaseMap.build(folder / "site.npy", **{**SMALL, **options})


@pytest.fixture(scope="module")
def town(map_points):
    near = (np.abs(map_points[:, :2]) < 20.0).all(axis=1)
    return np.repeat(map_points[near], 3, axis=0)  # as dense as a survey


def test_summary_has_the_size_that_the_cloud_has(town, tmp_path):
    base_map = built(tmp_path, np.add(town, (5e5, 5.4e6, 100.0)))
    found = summary(base_map)
    assert found.width == pytest.approx(np.ptp(town[:, 0]), abs=0.5)
    assert found.depth == pytest.approx(np.ptp(town[:, 1]), abs=0.5)
    assert found.lowest == pytest.approx(100.0 + town[:, 2].min(), abs=0.3)
    assert found.highest == pytest.approx(100.0 + town[:, 2].max(), abs=0.5)
    assert 0.5 * 1600 < found.area <= 42.0**2
    assert found.density == pytest.approx(len(town) / found.area)
    base_map.save(tmp_path / "site.coview")
    assert found.bytes == pytest.approx((tmp_path / "site.coview").stat().st_size, rel=0.05)
    assert found.warnings == ()
    assert "crs unknown" in str(found)
    assert f"{found.width:.0f} x {found.depth:.0f} m" in str(found)


def test_thin_survey_is_told(town, tmp_path):
    found = summary(built(tmp_path, town[:: max(1, len(town) // 8000)]))
    assert any("points/m2 are few" in warning for warning in found.warnings)


def test_survey_of_the_ground_alone_is_told(tmp_path):
    ground = np.random.default_rng(2).uniform((-30, -30, 0), (30, 30, 0.1), (60_000, 3))
    found = summary(built(tmp_path, ground))
    assert any("almost nothing stands above the ground" in warning for warning in found.warnings)


@pytest.mark.parametrize(("order", "name", "remedy"), [((0, 2, 1), "y", "(x, -z, y)"), ((2, 0, 1), "x", "(y, z, x)")])
def test_axis_that_points_up_other_than_z_is_told(town, tmp_path, order, name, remedy):
    turned = town[:, order] * (np.array([1, 1, -1]) if name == "y" else 1)
    found = summary(built(tmp_path, turned))
    assert any(f"{name} seems to point up" in warning and remedy in warning for warning in found.warnings), found


def test_remedy_of_the_warning_is_the_right_one(town):
    y_up, x_up = town[:, (0, 2, 1)] * (1, 1, -1), town[:, (2, 0, 1)]
    np.testing.assert_allclose(np.stack([y_up[:, 0], -y_up[:, 2], y_up[:, 1]], axis=1), town)
    np.testing.assert_allclose(np.stack([x_up[:, 1], x_up[:, 2], x_up[:, 0]], axis=1), town)


def test_tiles_far_apart_are_told_when_a_map_is_built(town, tmp_path):
    np.save(tmp_path / "a.npy", town)
    np.save(tmp_path / "b.npy", np.add(town, (1500.0, 0.0, 0.0)))
    with pytest.warns(CoViewWarning, match=r"1\.5 km from"):
        BaseMap.build([tmp_path / "a.npy", tmp_path / "b.npy"], **SMALL)


def test_too_few_points_are_told_with_file_and_extent(tmp_path):
    degrees = np.random.default_rng(2).uniform((8.0, 50.0, 100), (8.001, 50.001, 110), (60_000, 3))
    with pytest.raises(MapError, match=r"site\.npy: .* over 0\.00.* x .* metres\?"):
        built(tmp_path, degrees)
