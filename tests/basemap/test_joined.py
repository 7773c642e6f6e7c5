"""Several maps as one: placed side by side, searched together, and loaded under their names."""

import json

import numpy as np
import pytest
import small_world
from small_world import pose_error
from trackers import follow

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.file_format import check_arrays
from coview_stream.basemap.joined import join_maps, load_map, read_names, write_names
from coview_stream.basemap.map_parts import MapPart, MapParts
from coview_stream.basemap.signature import SigningKey, make_keys, read_verify_key
from coview_stream.basemap.summary import MapView
from coview_stream.clouds.files import write_cloud
from coview_stream.errors import InputError, MapError
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import State

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("cache")]

RADIUS = 30.0
FAR = np.array([512_003.0, 5_403_210.0, 287.0])


@pytest.fixture(scope="module")
def upper(tmp_path_factory):
    """The map of another small world, in UTM-like coordinates."""
    path = tmp_path_factory.mktemp("upper") / "upper.las"
    write_cloud(path, small_world.sample_map(small_world.boxes(seed=77)) + FAR)
    return BaseMap.build(path, radius=RADIUS)


@pytest.fixture(scope="module")
def both(world_map, upper):
    return join_maps({"ground": world_map, "upper": upper})


def test_robot_is_found_on_its_map_and_its_pose_is_in_that_maps_frame(both, world_drive):
    parts = MapParts.of(both.parameters)
    for name, drive, zero in (
        ("ground", world_drive, np.zeros(3)),
        ("upper", small_world.record(small_world.boxes(seed=77)), FAR),
    ):
        fixes = follow(Localizer(both), drive)
        posed = [k for k, fix in enumerate(fixes) if fix.T_map_body is not None]
        assert posed, name
        for k in posed:
            part = parts.at(fixes[k].T_map_body[:3, 3])
            assert part.name == name
            truth = drive.T_map_body[k].copy()
            truth[:3, 3] += zero
            assert pose_error(part.own(fixes[k].T_map_body), truth)[0] < 0.08
            np.testing.assert_allclose(part.joined(part.own(fixes[k].T_map_body)), fixes[k].T_map_body, atol=1e-8)


def test_robot_that_fits_two_maps_alike_is_on_neither(world_map, world_drive):
    fixes = follow(Localizer(join_maps({"first": world_map, "second": world_map})), world_drive)
    assert all(fix.T_map_body is None for fix in fixes)
    assert State.AMBIGUOUS in {fix.state for fix in fixes}


def test_joined_map_is_a_map(both, world_map, upper, tmp_path):
    check_arrays(both.arrays, both.config)
    assert len(both) == len(world_map) + len(upper)
    both.save(tmp_path / "both.coview")
    again = BaseMap.load(tmp_path / "both.coview")
    parts = MapParts.of(again.parameters)
    assert [part.name for part in parts] == ["ground", "upper"]
    assert [part.sha256 for part in parts] == [world_map.sha256, upper.sha256]
    for part, base_map in zip(parts, (world_map, upper), strict=True):
        centre = base_map.stations[len(base_map) // 2].astype(np.float64)
        points, normals = base_map.crop(centre, 12.0)
        move = np.array(part.shift) + base_map.origin
        moved, turned = again.crop(centre + move, 12.0)
        np.testing.assert_allclose(moved, points + move, atol=2e-3)
        np.testing.assert_allclose(turned, normals, atol=1e-6)
        assert part.begin < centre[0] + move[0] < part.end
    gap = parts[1].begin - parts[0].end
    assert gap == pytest.approx(0.0, abs=160.0)
    view = MapView.from_json(json.loads(json.dumps(MapView.of(again, 500).to_json())))
    assert list(view.parts) == list(parts)


def test_facts_of_one_map_are_not_the_joined_maps(world_map, upper):
    made = {"site": "0" * 64, "made_tiles": [], "ground_filter": "cloth"}
    joined = join_maps({"a": BaseMap(world_map.arrays, world_map.parameters | made), "b": upper})
    assert joined.parameters.keys() == {"config", "crs", "parts", "sources", "source_points", "learned"}


def test_maps_that_do_not_go_together_are_named(world_map):
    finer = BaseMap(
        world_map.arrays, world_map.parameters | {"config": world_map.parameters["config"] | {"voxel": 0.5}}
    )
    with pytest.raises(MapError, match=r"a and b differ in voxel \(0.25 and 0.5\)"):
        join_maps({"a": world_map, "b": finer})
    with pytest.raises(MapError, match="no maps"):
        join_maps({})


def test_parts_are_read_strictly():
    part = MapPart("a", "0" * 64, None, (1.0, 2.0, 3.0), -5.0, 5.0)
    rows = MapParts([part]).to_json()
    assert list(MapParts.of({"parts": rows})) == [part]
    assert MapParts.of({}) is None
    for broken in (
        [], [*rows, *rows], [{}], "x", [{**rows[0], "shift": [0.0, 0.0]}], [{**rows[0], "shift": [float("nan"), 0, 0]}],
        [{**rows[0], "name": ""}], [{**rows[0], "crs": 3}],
    ):  # fmt: skip
        with pytest.raises(MapError, match="parts cannot be read"):
            MapParts.of({"parts": broken})
    with pytest.raises(InputError, match="no map is called 'b': this node has a"):
        MapParts([part]).named("b")
    with pytest.raises(InputError, match="no map is named"):
        MapParts([part]).named(None)


def test_names_are_loaded_as_one_map(world_file):
    names = write_names([("ground", world_file), ("upper", world_file)])
    assert read_names(names) == [("ground", world_file), ("upper", world_file)]
    base_map = load_map(names)
    parts = MapParts.of(base_map.parameters)
    assert [part.name for part in parts] == ["ground", "upper"]
    assert BaseMap.load(base_map.path, check=False).sha256 == base_map.sha256
    made = base_map.path.stat().st_ino
    assert load_map(names).path == base_map.path
    assert base_map.path.stat().st_ino == made  # the joined file is made once


def test_with_a_key_all_maps_must_be_signed(world_file, tmp_path):
    keys = make_keys(tmp_path / "mine")
    signed = tmp_path / "signed.coview"
    BaseMap.load(world_file).save(signed, SigningKey(keys[0]))
    key = read_verify_key(keys[1])
    load_map(write_names([("a", signed), ("b", signed)]), key)
    with pytest.raises(MapError, match="not signed"):
        load_map(write_names([("a", signed), ("b", world_file)]), key)


def test_two_maps_of_one_name_and_other_files_are_refused(world_file, tmp_path):
    with pytest.raises(MapError, match="two maps are called a"):
        write_names([("a", world_file), ("a", world_file)])
    other = tmp_path / "other.joined"
    for content in ("", "[]", '{"format": "x"}', '{"format": "coview-joined", "maps": [1]}'):
        other.write_text(content)
        with pytest.raises(MapError, match="names no maps"):
            load_map(other)
