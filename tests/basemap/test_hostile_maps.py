"""Map files made to fail later: one MapError when they are loaded, which names the field."""

import json

import numpy as np
import pytest

from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import MapError


@pytest.fixture(scope="module")
def small():
    """Arrays and parameters of a map of a plane with two boxes."""
    rng = np.random.default_rng(3)
    ground = np.c_[rng.uniform(-9, 9, (9000, 2)), rng.normal(0, 0.01, 9000)]
    wall = np.c_[rng.uniform(-4, 4, 3000), np.full(3000, 5.0), rng.uniform(0, 4, 3000)]
    built = BaseMap.build(np.concatenate([ground, wall]))
    # of a map as earlier versions made them, with descriptors
    return built.arrays | {"descriptor.coview": built.descriptors("coview")}, built.parameters


@pytest.fixture
def load(small, tmp_path):
    """Loads a map of other arrays, and of other parameters, from a file."""

    def loaded(arrays, parameters=small[1]):
        file_format.save(tmp_path / "a.coview", arrays, parameters)
        return BaseMap.load(tmp_path / "a.coview")

    return loaded


@pytest.fixture
def undescribed(small):
    """The arrays of a map whose stations are not described."""
    return {name: values for name, values in small[0].items() if not name.startswith(("station_codes", "descriptor"))}


NAMES = ["origin", "stations", "points", "normals", "tile_index", "surveyed", "surveyed_corner", "descriptor.coview",
         "field.tiles", "field.occupied", "field.ground", "field.edge", "station_codes", "station_codes.basis",
         "station_codes.rest.step", "station_codes.norm"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", ["shorter", "flat", "type", "deeper", "wider"])
def test_array_of_another_shape_or_type_is_refused_when_loading(small, load, name, change):
    array = small[0][name]
    if change == "shorter" and name in ("surveyed", "tile_index"):
        pytest.skip("any size will do")
    changed = {
        "shorter": lambda: array[:-1],
        "flat": lambda: array.reshape(-1)[: array.size - 1],
        "type": lambda: array.astype(np.int32 if array.dtype != np.int32 else np.int64),
        "deeper": lambda: array[None],
        "wider": lambda: np.repeat(array, 2, axis=-1) if name != "surveyed" else array.reshape(-1),
    }[change]()
    # the one it does not fit to may be named in its place
    with pytest.raises(MapError, match=r"the map's (\w|\.)+ (is|has)"):
        load(small[0] | {name: changed})


@pytest.mark.parametrize(
    ("name", "value"), [("origin", np.nan), ("stations", np.inf), ("surveyed_corner", np.nan), ("tile_index", 1 << 40),
                        ("tile_index", -1)]
)  # fmt: skip
def test_values_that_would_be_used_as_places_are_checked(small, load, name, value):
    changed = small[0][name].copy()
    changed[..., -1] = value
    with pytest.raises(MapError, match=f"the map's {name}"):
        load(small[0] | {name: changed})


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e30, 3e6, -5e3])
@pytest.mark.parametrize("name", ["points", "stations"])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_points_and_stations_are_finite_and_on_the_surveyed_cells(small, load, value, name, column):
    changed = small[0][name].copy()
    changed[-1, column] = value
    if column == 2 and abs(value) < 1e7:
        load(small[0] | {name: changed})  # a height alone makes no raster larger
        return
    with pytest.raises(MapError, match=f"the map's {name} (is not finite|lies beside)"):
        load(small[0] | {name: changed})


def test_tile_of_the_field_far_away_and_a_raster_larger_than_any_map_are_refused(small, load):
    tiles = small[0]["field.tiles"].copy()
    tiles[0, 1] += 1400
    with pytest.raises(MapError, match=r"field\.tiles lies beside"):
        load(small[0] | {"field.tiles": tiles})
    wide = np.zeros((1, 140_000_000), dtype=np.uint8)
    with pytest.raises(MapError, match="surveyed covers 560 km2"):
        file_format.check_arrays(small[0] | {"surveyed": wide}, BaseMap(*small).config)


@pytest.mark.parametrize("rows", [[[0, 5], [0, 5]], [[0, 5], [4, 9]], [[5, 9], [0, 6]], [[0, 12], [3, 4], [4, 5]]])
def test_points_are_named_once(small, load, rows):
    index = np.array([[0, k, *row] for k, row in enumerate(rows)])
    with pytest.raises(MapError, match="tile_index names points twice"):
        load(small[0] | {"tile_index": index})


def test_empty_stretches_are_none_twice(small, load):
    index = np.array([[0, 0, 3, 3], [0, 1, 0, 3], [0, 2, 3, 9], [0, 3, 0, 0], [0, 4, 3, 3]])
    assert len(load(small[0] | {"tile_index": index}).points) == len(small[0]["points"])


def test_stations_of_storeys_without_points_are_described_as_empty(undescribed, load):
    undescribed["stations"] = undescribed["stations"].copy()
    undescribed["stations"][1:, :2], undescribed["stations"][:, 2] = undescribed["stations"][:1, :2], 900.0
    undescribed["stations"][0, 2] = -900.0
    assert np.isfinite(load(undescribed).descriptors("coview")).all()


def test_stations_on_a_thousand_storeys_are_refused(undescribed, load):
    places = np.repeat(undescribed["stations"][:20], 100, axis=0)
    places[:, 2] = 3.0 * np.arange(len(places))
    with pytest.raises(MapError, match="storeys, 1024 at most"):
        load(undescribed | {"stations": places}).descriptors("coview")


def test_many_stations_above_one_another_are_refused(undescribed, load):
    undescribed["stations"] = np.repeat(undescribed["stations"][:1], 200, axis=0)
    with pytest.raises(MapError, match="200 stations above one another"):
        _ = load(undescribed).station_grid


@pytest.mark.parametrize("name", ["stations", "points"])
def test_map_without_stations_or_points_is_refused(undescribed, load, name):
    with pytest.raises(MapError, match=f"the map's {name} are none; copy or build it again"):
        load(undescribed | {each: undescribed[each][:0] for each in {name, name.replace("points", "normals")}})


@pytest.mark.parametrize(
    "parameters",
    [
        None, [], "x", {}, {"config": None}, {"config": []}, {"config": {}}, {"sources": [1, 2]}, {"sources": "ab"},
        {"sources": None}, {"crs": 7}, {"crs": "\ud800"},
        {"config": {"descriptor": {"channels": ["coview"], "radius": -1.0}}},
        {"config": {"descriptor": {"channels": ["coview"], "colour": 1}}},
    ],
)  # fmt: skip
def test_parameters_of_another_kind_are_refused(small, load, parameters):
    whole = small[1] | parameters if isinstance(parameters, dict) and parameters else parameters
    with pytest.raises(MapError, match=r"a\.coview: the map.* (build it|copy or build it) again"):
        load(small[0], whole)


@pytest.mark.parametrize(
    ("name", "value", "flaw"),
    [
        ("rings", 40, r"station_codes\.basis has the shape"), ("sectors", 30, r"station_codes\.sample has the shape"),
        ("channels", ["coview"], "station_codes"), ("rings", 320, "rings is 320"), ("sectors", 600, "sectors is 600"),
        ("radius", 1000.0, "radius is 1000"), ("voxel", 1e-300, "voxel is 1e-300"),
    ],
)  # fmt: skip
def test_counts_of_the_settings_are_those_of_the_arrays_and_within_bounds(small, load, name, value, flaw):
    parameters = json.loads(json.dumps(small[1]))
    parameters["config"]["descriptor"][name] = value
    arrays = {name: values for name, values in small[0].items() if not name.startswith("descriptor")}
    with pytest.raises(MapError, match=flaw):
        load(arrays, parameters)


@pytest.mark.parametrize(("name", "value"), [("learned.tiles", 30_000), ("learned.place_at", np.nan)])
def test_features_lie_on_the_surveyed_cells(small, name, value):
    kind = file_format._EXPECTED[name][0]
    arrays = small[0] | {name: np.array([[0, 0], [value, 0]]).astype(kind)}
    with pytest.raises(MapError, match=f"{name} lies beside"):
        file_format.check_arrays(arrays, BaseMap(*small).config)


def test_map_with_a_channel_that_is_gone_is_named_with_the_remedy(small, load):
    parameters = json.loads(json.dumps(small[1]))
    parameters["config"]["descriptor"]["channels"].append("coview_strict")  # of maps from before November 2026
    with pytest.raises(MapError, match=r"a\.coview: the map's .*'coview_strict'.*; build it again") as error:
        load(small[0], parameters)
    assert "\n" not in str(error.value)


def _with_header(path, text, body=bytes(64)):
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)
    return path


@pytest.mark.parametrize("opening", ["[", '{"a":'])
def test_header_of_endless_brackets_is_refused(tmp_path, opening):
    path = _with_header(tmp_path / "a.coview", opening.encode() * 1_000_00)
    for use in (file_format.load, file_format.check_target):
        with pytest.raises(MapError):
            use(path)


@pytest.mark.parametrize(
    ("shape", "offsets"),
    [
        ([float("inf")], [0, 8]), ([-1, -8], [0, 8]), ([-1], [8, 7]), ([10**30], [0, 8]), ([0, 10**30], [0, 0]),
        ([True] * 3, [0, 1]), ([1], [-8, 0]), ([1.0], [0, 1]), ("1", [0, 1]), ([1] * 99, [0, 1]), (None, [0, 1]),
        ([2**62, 4], [0, 0]),
    ],
)  # fmt: skip
def test_shapes_that_are_none_are_refused(tmp_path, shape, offsets):
    metadata = {"format": file_format.FORMAT, "version": "1", "parameters": "{}", "sha256": ""}
    header = {"__metadata__": metadata, "a": {"dtype": "U8", "shape": shape, "data_offsets": offsets}}
    with pytest.raises(MapError):
        file_format.load(_with_header(tmp_path / "a.coview", json.dumps(header).encode()), False)


def test_null_parameters_and_arrays_that_share_bytes_are_refused(tmp_path):
    metadata = {"format": file_format.FORMAT, "version": "1", "parameters": None, "sha256": ""}
    header = {"__metadata__": metadata}
    with pytest.raises(MapError, match="damaged"):
        file_format.load(_with_header(tmp_path / "a.coview", json.dumps(header).encode()))
    metadata["parameters"] = "{}"
    same = {"dtype": "U8", "shape": [60], "data_offsets": [0, 60]}
    for count, reason in ((2, "overlap"), (1000, "arrays")):
        many = header | {f"a{k}": same for k in range(count)}
        with pytest.raises(MapError, match=reason):
            file_format.load(_with_header(tmp_path / "a.coview", json.dumps(many).encode()))
