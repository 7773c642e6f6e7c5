"""Ground, its raster and its levels on scenes whose truth is known."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.ground import GroundRaster, cloth_available, ground_filter, ground_mask
from coview_stream.basemap.stations import find_stations
from coview_stream.errors import ConfigError, DependencyError
from coview_stream.geometry.rasters import filled

METHODS = [
    pytest.param("cloth", marks=pytest.mark.skipif(not cloth_available(), reason="no cloth wheel here")),
    "morphological",
]
DATA = Path(os.environ.get("COVIEW_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))


def _slab(x, y, z, seed):
    rng = np.random.default_rng(seed)
    count = int((x[1] - x[0]) * (y[1] - y[0]) * 16)
    return np.column_stack([rng.uniform(*x, count), rng.uniform(*y, count), rng.normal(z, 0.02, count)])


def _hills(xy):
    return 3.0 * np.sin(xy[:, 0] / 20.0) + 0.05 * xy[:, 1]


@pytest.fixture(scope="module")
def scene():
    """Rolling ground without returns below two houses; trees over ground; a few echoes from below."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(-50, 50, (60_000, 2))
    ground = np.column_stack([xy, _hills(xy) + rng.normal(0, 0.02, len(xy))])
    parts = [ground]
    for x, y in ((-20, 10), (15, -25)):
        inside = (np.abs(ground[:, 0] - x) < 8) & (np.abs(ground[:, 1] - y) < 6)
        ground[inside, 2] = _hills(np.array([[x, y]])) + 7.0
    tree = np.column_stack([rng.uniform(20, 45, 15_000), rng.uniform(5, 40, 15_000)])
    parts.append(np.column_stack([tree, _hills(tree) + rng.uniform(2.5, 9, len(tree))]))
    deep = rng.uniform(-45, 45, (8, 2))
    parts.append(np.column_stack([deep, _hills(deep) - rng.uniform(4, 9, 8)]))
    points = np.concatenate(parts)
    truth = np.abs(points[:, 2] - _hills(points[:, :2])) < 0.2
    return points.astype(np.float32), truth


@pytest.mark.parametrize("method", METHODS)
def test_ground_mask_of_hills_houses_and_trees(scene, method):
    points, truth = scene
    mask = ground_mask(points, method)
    assert mask.shape == (len(points),)
    assert (truth & ~mask).sum() / truth.sum() < 0.02
    assert (~truth & mask).sum() / (~truth).sum() < 0.005


@pytest.mark.parametrize("method", METHODS)
def test_ground_filter_prints_nothing_and_leaves_no_files(scene, method, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    sys.stdout.write("before\n")
    ground_mask(scene[0], method)
    sys.stdout.write("after\n")
    assert capfd.readouterr().out == "before\nafter\n"
    assert not list(tmp_path.iterdir())


def test_without_the_cloth_wheel_the_morphological_filter_takes_over(scene, monkeypatch):
    points = scene[0]
    expected = ground_mask(points, "morphological")
    monkeypatch.setitem(sys.modules, "CSF", None)
    assert ground_filter(points) == "morphological"
    np.testing.assert_array_equal(ground_mask(points), expected)
    with pytest.raises(DependencyError, match="method='morphological'"):
        ground_mask(points, "cloth")


@pytest.mark.skipif(not cloth_available(), reason="no cloth wheel here")
def test_cloth_filter_is_the_default_where_available(scene):
    points = scene[0]
    assert ground_filter(points) == "cloth"
    assert ground_filter(points[points[:, 0] ** 2 < 4.0]) == "morphological"
    np.testing.assert_array_equal(ground_mask(points), ground_mask(points, "cloth"))


@pytest.mark.slow
def test_cloth_tiles_have_no_seams():
    xy = np.random.default_rng(6).uniform(0, 300, (120_000, 2))
    points = np.column_stack([xy, 0.1 * xy[:, 0]]).astype(np.float32)
    assert ground_mask(points).mean() > 0.999


@pytest.mark.parametrize("count", [0, 1, 3, 49])
def test_few_points_are_all_ground(count):
    points = np.random.default_rng(7).uniform(0, 1, (count, 3)).astype(np.float32) * np.float32([20, 20, 0.05])
    assert ground_mask(points).shape == (count,)
    assert ground_mask(points).all()


def test_too_large_extent_is_refused():
    points = np.array([[0, 0, 0], [9e7, 9e7, 0]], np.float32)
    with pytest.raises(ConfigError, match="stray points"):
        ground_mask(points)


def test_ground_height_is_bilinear_and_ignores_unknown_neighbours():
    raster = GroundRaster(np.array([[0, 1], [np.nan, 3]], np.float32), x0=10.0, y0=20.0, cell=2.0)
    at = np.array([[11.0, 21.0], [12.0, 21.0], [13.0, 22.0], [11.0, 23.0], [11.9, 21.9]])
    expected = [0.0, 0.5, 2.0, np.nan, (0.45 * 0.55 * 1 + 0.45 * 0.45 * 3) / (1 - 0.45 * 0.55)]
    np.testing.assert_allclose(raster.height_at(at), expected, rtol=1e-5)


def test_push_pull_filling_keeps_known_cells_and_stays_within_their_range():
    z = np.full((37, 53), np.nan, np.float32)
    z[3, 4], z[30, 50] = 1.0, 5.0
    out = filled(z)
    assert out[3, 4] == 1.0
    assert out[30, 50] == 5.0
    assert ((out >= 1.0) & (out <= 5.0)).all()


@pytest.fixture(scope="module")
def storeys():
    """A two-storey house on a field, with a canopy, a bridge in the open and a table on the upper floor."""
    rng = np.random.default_rng(9)
    canopy = np.column_stack([rng.uniform(14, 26, 20_000), rng.uniform(-20, 20, 20_000), rng.uniform(2.5, 9, 20_000)])
    parts = [
        _slab((-30, 30), (-30, 30), 0.0, 1),
        *(_slab((-10, 10), (-8, 8), z, i) for i, z in enumerate((3.0, 3.3, 6.3))),
        _slab((-10.3, 10.3), (-8.3, 8.3), 6.8, 4),
        _slab((0, 1.4), (0, 0.8), 4.1, 5),
        _slab((-28, -20), (-30, 30), 5.0, 6),
        canopy,
    ]
    return np.concatenate(parts).astype(np.float32)


def test_floors_of_a_house(storeys):
    levels = find_stations(storeys, 2.0)
    ground, upper = levels[levels[:, 2] < 1], levels[levels[:, 2] >= 1]
    # the whole field, below the house, the bridge and the canopy too, once per square
    assert len(ground) == len(np.unique(ground[:, :2], axis=0)) == 30 * 30
    np.testing.assert_allclose(ground[:, 2], 0.0, atol=0.1)
    # one upper floor; neither roof nor bridge deck nor canopy nor table
    assert len(upper) == len(np.unique(upper[:, :2], axis=0)) == 10 * 8
    np.testing.assert_allclose(upper[:, 2], 3.3, atol=0.15)
    assert (np.abs(upper[:, :2]) < [10, 8]).all()
    np.testing.assert_array_equal(np.mod(levels[:, :2], 2.0), 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("levels", [True, False])
def test_map_has_stations_on_upper_floors_unless_it_is_to_have_none(storeys, levels):
    base_map = BaseMap.build(storeys, levels=levels, radius=15.0)
    heights = base_map.stations[:, 2] + base_map.origin[2]
    assert ((np.abs(heights - 3.3) < 0.2).sum() > 60) == (heights > 1.0).any() == levels
    assert (heights < 4.0).all()  # none on the roof


@pytest.mark.parametrize(("half", "ceiling", "count"), [(10.0, 2.5, 100), (2.0, 2.5, 0), (10.0, 1.5, 0)])
def test_floors_need_extent_and_headroom(half, ceiling, count):
    side = (-half, half)
    slabs = [_slab((-30, 30), (-30, 30), 0.0, 1), _slab(side, side, 3.0, 2), _slab(side, side, 3.0 + ceiling, 3)]
    stations = find_stations(np.concatenate(slabs).astype(np.float32), 2.0)
    assert (stations[:, 2] > 1.0).sum() == count


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("method", METHODS)
def test_ground_error_on_delft_data(method):
    path = DATA / "airborne" / "delft_ahn3_2.laz"
    if not path.exists():
        pytest.skip("airborne/delft_ahn3_2.laz is not there; set COVIEW_DATA to the folder of real scans")
    from coview_stream.clouds import read_cloud

    cloud = read_cloud(path)
    assert cloud.classification is not None
    label = cloud.classification == 2
    mask = ground_mask(cloud.points, method)
    assert (label & ~mask).sum() / label.sum() < 0.01
    assert (label != mask).mean() < 0.035


@pytest.mark.slow
def test_outermost_point_that_float32_rounds_up_has_a_cell():
    """A point just inside of 90 m is 180.0 m from one at -90 m in float32, which is the next cell."""
    rng = np.random.default_rng(7)
    points = rng.uniform(-20.0, 20.0, (500, 3)).astype(np.float32)
    points[:, 2] = 0.0
    points[0, :2], points[1, :2] = -90.0, np.nextafter(np.float32(90.0), np.float32(0.0))
    assert ground_mask(points).all()
