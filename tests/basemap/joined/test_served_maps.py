"""Several maps as a node serves them: opened by a file of their names, with a key, again where one has changed."""

from __future__ import annotations

import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.joined import load_map, read_names, write_names
from coview_stream.basemap.map_parts import MapParts
from coview_stream.basemap.signature import SigningKey, make_keys, read_verify_key
from coview_stream.errors import MapError

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_names_are_loaded_as_one_map(world_file):
    names = write_names([("ground", world_file), ("upper", world_file)])
    assert read_names(names) == [("ground", world_file), ("upper", world_file)]
    base_map = load_map(names)
    parts = MapParts.of(base_map.parameters)
    assert [part.name for part in parts] == ["ground", "upper"]
    assert BaseMap.load(base_map.path, check=False).sha256 == base_map.sha256
    assert load_map(names).path == base_map.path


def test_each_of_them_has_to_be_signed_where_a_key_is_asked_for(world_map, world_file, tmp_path):
    keys = make_keys(tmp_path / "mine")
    world_map_signed = BaseMap.load(world_file)
    world_map_signed.save(tmp_path / "signed.coview", SigningKey(keys[0]))
    signed = tmp_path / "signed.coview"
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
