"""A base map made of arrays, what it tells of itself, its picture, and how it is pickled."""

import pickle
import shutil

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.sources import sources_of
from coview_stream.errors import CloudError, ConfigError, CoViewWarning, MapError
from tests.basemap.test_build import SMALL, UTM


@pytest.fixture(scope="module")
def cut(cut):
    """In UTM."""
    return cut + UTM


@pytest.fixture(scope="module")
def from_array(cut):
    return BaseMap.build(cut, crs="EPSG:32632", **SMALL)


def test_map_of_an_array_is_that_of_the_file(from_array, cut, tmp_path):
    np.save(tmp_path / "site.npy", cut)
    from_file = BaseMap.build(tmp_path / "site.npy", **SMALL)
    np.testing.assert_array_equal(from_array.points, from_file.points)
    np.testing.assert_array_equal(from_array.origin, from_file.origin)
    assert from_array.crs == "EPSG:32632"
    assert from_file.crs is None
    assert list(from_array.sources) == ["array"]
    assert len(from_array.sources["array"]) == 64


def test_arrays_and_files_can_be_mixed(cut, from_array, tmp_path):
    np.save(tmp_path / "a.npy", cut[::2])
    mixed = BaseMap.build([tmp_path / "a.npy", np.column_stack([cut[1::2], np.ones(len(cut) // 2)])], **SMALL)
    assert list(mixed.sources) == ["a.npy", "array"]
    np.testing.assert_allclose(mixed.bounds, from_array.bounds, atol=0.3)
    names = [str(source.path) for source in sources_of([cut, cut])]
    assert names == ["array 1", "array 2"]

    class Table:  # of pandas, or a tensor
        def __array__(self, dtype=None, copy=None):
            return cut[:9]

    np.testing.assert_array_equal(sources_of(Table())[0].rows, cut[:9])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (np.zeros(3), r"array has shape \(3,\); give a cloud file, or an array \(N, 3\)"),
        (np.zeros((9, 2)), r"array has shape \(9, 2\)"),
        ([[1.0, 2.0, 3.0]] * 2, r"array 1 is a list; give"),
        (None, "sources is a NoneType; give cloud files, or an array"),
        (b"site.laz", "sources is a bytes"),
        (np.full((9, 3), "a"), "array is not an array of numbers"),
        (np.full((9, 3), np.nan), "array: none of the 9 points is usable"),
    ],
)
def test_array_that_is_no_cloud_is_refused(given, says):
    with pytest.raises(CloudError, match=says):
        BaseMap.build(given)


def test_system_that_is_not_of_metres_is_refused(cut):
    with pytest.raises(ConfigError, match="is not a reference system; give EPSG:code, WKT, feet or us-feet"):
        BaseMap.build(cut, crs="nonsense")
    with pytest.raises(ConfigError, match="crs 'EPSG:4326' is in degrees"):
        BaseMap.build(cut, crs="EPSG:4326")
    with pytest.raises(ConfigError, match="crs is 32632; give text such as"):
        BaseMap.build(cut, crs=32632)
    with pytest.raises(ConfigError, match="config is a dict; give a MapConfig"):
        BaseMap.build(cut, config={"voxel": 0.5})


def test_coarse_float32_coordinates_are_told(cut):
    with pytest.warns(CoViewWarning, match="rounded to 6 cm"):
        sources_of(cut.astype(np.float32))[0].read()


def test_extent_is_that_of_the_points(from_array, cut):
    np.testing.assert_allclose(from_array.bounds, [cut.min(axis=0), cut.max(axis=0)], atol=0.3)
    assert from_array.bounds.dtype == np.float64
    there = from_array.world_points()
    np.testing.assert_array_equal(there - from_array.origin, from_array.points.astype(np.float64))


def test_map_says_what_it_is_in_one_line(from_array, world_file):
    said = repr(from_array)
    assert said.startswith(f"BaseMap({len(from_array):,} stations, {len(from_array.points):,} points, crs EPSG:32632")
    assert said.endswith("sha256 none yet)")
    loaded = BaseMap.load(world_file)
    assert repr(loaded).startswith(f"BaseMap({str(world_file)!r}: ")
    assert loaded.sha256[:8] in repr(loaded)


def test_picture_shows_the_points_where_they_are(from_array, cut):
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    assert from_array.plot(axes) is axes
    (picture,) = axes.get_images()
    left, right, bottom, top = picture.get_extent()
    low, high = cut.min(axis=0), cut.max(axis=0)
    np.testing.assert_allclose([left, right, bottom, top], [low[0], high[0], low[1], high[1]], atol=0.6)
    values = np.ma.filled(picture.get_array(), np.nan)
    assert values.shape[0] == pytest.approx((top - bottom) / 0.375, abs=1)
    # the highest point is drawn darkest, where it stands
    x, y, _ = from_array.world_points()[np.argmax(from_array.points[:, 2])]
    row, column = int((y - bottom) / 0.375), int((x - left) / 0.375)
    assert values[row, column] == np.nanmin(values)


def test_loaded_map_is_pickled_as_its_path(world_file, tmp_path):
    path = tmp_path / "site.coview"
    shutil.copy(world_file, path)
    loaded = BaseMap.load(path)
    data = pickle.dumps(loaded)
    assert len(data) < 1000
    again = pickle.loads(data)
    assert (again.sha256, again.path) == (loaded.sha256, path)
    np.testing.assert_array_equal(again.points, loaded.points)
    path.unlink()
    shutil.copy(world_file, path)  # another file of the same content
    assert pickle.loads(data).sha256 == loaded.sha256


def test_built_map_is_pickled_with_its_arrays(from_array):
    _ = from_array.station_grid, from_array.summary  # are not pickled
    again = pickle.loads(pickle.dumps(from_array))
    np.testing.assert_array_equal(again.points, from_array.points)
    assert again.config == from_array.config
    assert "station_grid" not in vars(again)


def test_pickled_map_whose_file_is_another_is_refused(world_file, from_array, tmp_path):
    path = tmp_path / "site.coview"
    shutil.copy(world_file, path)
    data = pickle.dumps(BaseMap.load(path))
    BaseMap(from_array.arrays, from_array.parameters).save(path)
    with pytest.raises(MapError, match="another map than the one that was pickled"):
        pickle.loads(data)
    path.unlink()
    with pytest.raises(MapError, match=r"site\.coview"):
        pickle.loads(data)
