"""Several maps as a node serves them: opened by a file of their names, with a key, again where one has changed."""

from __future__ import annotations

import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.joined import ServedMaps, load_map, read_names, write_names
from coview_stream.basemap.map_parts import MapParts
from coview_stream.basemap.signature import SigningKey, make_keys, read_verify_key
from coview_stream.errors import MapError, TransportError

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Mirror:
    """Of a site elsewhere."""

    def __init__(self, *answers):
        self.source = self
        self.name = "zenoh://yard"
        self.offline = ""
        self.answers = list(answers)
        self.map_path = None
        self.closed = 0

    def refresh(self):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        self.offline = ""
        return answer

    def close(self):
        self.closed += 1


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


def test_change_of_any_is_a_change_and_an_outage_of_one_hides_no_change_of_another(world_file):
    gone = TransportError("nobody answers")
    one, other = Mirror(False, True, gone, gone), Mirror(False, False, True, False)
    served = ServedMaps([("a", world_file), ("b", world_file)], [one, other])
    assert not served.refresh()
    assert served.refresh()
    assert served.refresh()
    assert served.offline == "nobody answers"
    with pytest.raises(TransportError):
        served.refresh()
    assert not served.follow({"r1": (0.0, 0.0)})
    served.close()
    assert (one.closed, other.closed) == (1, 1)
