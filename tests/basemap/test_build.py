"""Building: tiles equal one file, storeys are apart, absurd input is refused in one line, parameters survive."""

import sys

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.ground import cloth_available
from coview_stream.basemap.map_arrays import cells_of, surveyed_around
from coview_stream.clouds.files import write_cloud
from coview_stream.config import map_preset
from coview_stream.errors import CloudError, ConfigError, MapError

SMALL = {"radius": 15.0, "rings": 6, "sectors": 12}
UTM = np.array([512_345.6, 5_403_210.9, 287.4])


@pytest.fixture(scope="module")
def whole(cut, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "site.npy"
    np.save(path, cut + UTM)
    return BaseMap.build(path, **SMALL)


def test_built_map_holds_points_stations_and_descriptors(whole, cut):
    assert 80 <= len(whole) <= 121
    assert whole.points.dtype == np.float32
    assert np.abs(whole.points[:, :2]).max() < 100
    # the origin is float64 and puts everything back where it was
    assert whole.origin.dtype == np.float64
    there = whole.points + whole.origin
    np.testing.assert_allclose(there.min(axis=0), cut.min(axis=0) + UTM, atol=0.3)
    np.testing.assert_allclose(there.max(axis=0), cut.max(axis=0) + UTM, atol=0.3)
    stations = whole.stations + whole.origin
    # a wall's foot may lift a station or two
    assert (np.abs(stations[:, 2] - UTM[2]) < 0.1).mean() > 0.95
    assert np.abs(stations[:, 2] - UTM[2]).max() < 0.6
    for name in whole.descriptor_config.channels:
        assert whole.descriptors(name).shape == (len(whole), 6, 12)
        assert whole.descriptors(name).any()
    assert set(whole.sources) == {"site.npy"}


def test_map_points_lie_within_half_a_voxel_of_the_cloud(whole, cut):
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(cut).query(whole.points + whole.origin - UTM)
    # a voxel's mean lies between its points, not farther than half its diagonal from one of them
    assert np.quantile(distance, 0.99) < 0.22


def test_map_records_its_ground_filter(whole, cut, tmp_path, monkeypatch):
    assert whole.parameters["ground_filter"] == ("cloth" if cloth_available() else "morphological")
    monkeypatch.setitem(sys.modules, "CSF", None)
    built = BaseMap.build(cut + UTM, **SMALL)
    built.save(tmp_path / "site.coview")
    assert BaseMap.load(tmp_path / "site.coview").parameters["ground_filter"] == "morphological"


def test_map_from_several_files_equals_map_from_one(whole, cut, tmp_path):
    west = cut[:, 0] < -5.0
    for name, part in (("west.las", cut[west]), ("east.ply", cut[~west])):
        write_cloud(tmp_path / name, part, UTM)
    tiled = BaseMap.build([tmp_path / "west.las", str(tmp_path / "east.ply")], **SMALL)
    assert set(tiled.sources) == {"west.las", "east.ply"}
    shift = tiled.origin - whole.origin
    assert len(tiled.points) == pytest.approx(len(whole.points), rel=0.02)
    one = {tuple(np.round((s + whole.origin)[:2]).astype(int)) for s in whole.stations}
    two = {tuple(np.round((s + tiled.origin)[:2]).astype(int)) for s in tiled.stations}
    assert np.allclose(shift % 2, 0)  # the same grid of stations
    assert len(one ^ two) <= 0.05 * len(one)


def test_built_map_round_trips_through_its_file(whole, tmp_path):
    path = tmp_path / "site.coview"
    digest = whole.save(path)
    loaded = BaseMap.load(path)
    assert loaded.sha256 == digest == whole.sha256
    assert loaded.config == whole.config == map_preset("slam", **SMALL)
    assert loaded.sources == whole.sources
    assert loaded.parameters["source_points"] == whole.parameters["source_points"]
    assert loaded.crs is None
    np.testing.assert_array_equal(loaded.origin, whole.origin)
    np.testing.assert_array_equal(loaded.stations, whole.stations)
    np.testing.assert_array_equal(loaded.points, whole.points)
    assert isinstance(loaded.points, np.memmap)


def test_same_source_gives_same_hash(cut, tmp_path):
    np.save(tmp_path / "site.npy", cut[::4])
    digests = {BaseMap.build(tmp_path / "site.npy", **SMALL).save(tmp_path / f"{k}.coview") for k in range(2)}
    assert len(digests) == 1


def test_crop_and_surveyed_cells(whole):
    centre = whole.stations[len(whole) // 2].astype(float)
    points, normals = whole.crop(centre, 4.0)
    assert len(points) == len(normals) > 100
    assert np.hypot(*(points[:, :2] - centre[:2]).T).max() < 4.0
    ground = np.abs(points[:, 2] - centre[2]) < 0.1
    assert np.abs(normals[ground][:, 2]).mean() > 0.9
    assert whole.surveyed(whole.points[:, :2]).all()
    assert not whole.surveyed(np.array([[1000.0, 0.0], [0.0, -1000.0], [-15.0, 60.0]])).any()


def test_surveyed_cells_reach_one_cell_beyond_the_points():
    grid, corner = surveyed_around(cells_of(np.array([[1.0, 1.0, 0], [1.0, 9.0, 5]], np.float32), 2.0), 2.0)
    np.testing.assert_array_equal(corner, [-2.0, -2.0])
    # row along y: cells of y = 1 and y = 9 with a neighbour on each side; between them nothing
    assert grid.shape == (7, 3)
    assert grid[:, 1].tolist() == [1, 1, 1, 0, 1, 1, 1]
    assert grid[:, 0].tolist() == grid[:, 2].tolist() == grid[:, 1].tolist()


def test_missing_source_is_refused(tmp_path):
    with pytest.raises(MapError, match="no source"):
        BaseMap.build([])
    with pytest.raises(CloudError, match=r"none\.laz"):
        BaseMap.build(tmp_path / "none.laz")
    with pytest.raises(ConfigError, match="unknown map option"):
        BaseMap.build(tmp_path / "none.laz", blok=3)


def test_configuration_replaces_preset_and_options(cut):
    config = map_preset("slam", block=4.0, channels=("coview",), **SMALL)
    built = BaseMap.build(cut[::3], config=config)
    assert built.config == config
    assert np.allclose((built.stations[:, :2] / 4.0) % 1.0, 0.5)


@pytest.mark.parametrize("name", ["origin", "stations", "points", "surveyed"])
def test_map_with_missing_array_is_refused(whole, name):
    arrays = {k: v for k, v in whole.arrays.items() if k != name}
    with pytest.raises(MapError, match=r"lacks.*build it again"):
        BaseMap(arrays, whole.parameters)


def with_option(whole, **option):
    config = whole.parameters["config"]
    return whole.parameters | {"config": config | {"descriptor": config["descriptor"] | option}}


def test_map_of_earlier_version_with_removed_options_loads(whole):
    earlier = BaseMap(whole.arrays, with_option(whole, visibility="paper", eye=1.5))
    assert earlier.config == whole.config
    assert earlier.parameters["config"]["descriptor"]["eye"] == 1.5  # the checksum is of what was written


@pytest.mark.parametrize(
    "option", [{"visibility": "eye"}, {"visibility": "off"}, {"eye": 2.0}, {"channels": ["density"]}]
)
def test_map_made_with_removed_option_is_refused(whole, option):
    with pytest.raises(MapError, match=f"{next(iter(option))} is .*build it again"):
        BaseMap(whole.arrays, with_option(whole, **option))
