"""Working files made out of earlier ones: the same tiles are taken, others are made; a bad file is as good as none."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap, station_descriptors
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS
from coview_stream.basemap.site.layers import encode
from coview_stream.basemap.site.manifest import LayerEntry, Manifest
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.site.working_file import earlier_file, working_file
from coview_stream.errors import MapError


@pytest.fixture
def taken(caplog):
    """Return a function that counts the tiles copied from an earlier file, each time that one was opened."""
    caplog.set_level("INFO", "coview_stream.maps")
    return lambda: [record.args[1] for record in caplog.records if "tiles are copied" in record.msg]


@pytest.fixture
def learned_from(monkeypatch):
    """Return a function that sets the least number of stations from which codes are learned."""
    return lambda count: monkeypatch.setattr("coview_kernels.StationCodes.LEARNED", count)


def keys_of(site):
    return [(tile.column, tile.row) for tile in Manifest.load(site).tiles]


@pytest.mark.slow
def test_tiles_that_are_the_same_are_taken_and_the_map_is_the_same(
    site, cache, taken, learned_from, monkeypatch, tmp_path
):
    learned_from(1)
    some = set(keys_of(site)[1:3])
    part = file_format.open_file(working_file(site, keys=some)).arrays
    whole = file_format.open_file(working_file(site)).arrays
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "another"))
    anew = file_format.open_file(working_file(site)).arrays
    assert taken() == [2]
    assert whole.keys() == anew.keys()
    for name in anew:
        if name.startswith("station_codes") and "sample" not in name:
            assert whole[name].shape == anew[name].shape  # in other terms
        else:
            np.testing.assert_array_equal(whole[name], anew[name], err_msg=name)
    for name in FIELD_ARRAYS:
        assert len(part[name]) < len(whole[name])
    own = (part["stations"][:, None] == whole["stations"][None]).all(axis=2).argmax(axis=1)
    np.testing.assert_array_equal(part["station_codes"], whole["station_codes"][own])


@pytest.mark.slow
def test_codes_learned_from_too_few_stations_are_made_anew(site, cache, taken, learned_from):
    learned_from(10**6)
    some = set(keys_of(site)[:2])
    part = file_format.open_file(working_file(site, keys=some)).arrays
    whole = file_format.open_file(working_file(site)).arrays
    assert taken() == [2]  # their field is taken
    assert not np.array_equal(part["station_codes.basis"], whole["station_codes.basis"])


@pytest.mark.slow
def test_codes_in_an_earlier_files_terms_find_the_same_stations(site, cache, taken, learned_from):
    learned_from(1)
    working_file(site, keys=set(keys_of(site)[:1]))
    base_map = BaseMap.load(site)
    assert taken() == [1]
    index = base_map.station_index
    wanted = np.arange(0, len(base_map.stations), 97)
    right = 0
    for station in wanted:
        described = station_descriptors(base_map, station)
        scores = index.best(index.query({name: values.astype(np.float32) for name, values in described.items()}))
        away = np.linalg.norm(base_map.stations[scores.argmin()] - base_map.stations[station])
        right += away < 3.0
    assert right >= 0.9 * len(wanted)


@pytest.mark.slow
def test_tile_whose_neighbour_was_not_there_is_made_again(site, cache, taken, tmp_path):
    manifest = Manifest.load(site)
    mirror, there = tmp_path / "mirror", manifest.tiles[0]
    store = TileStore(mirror)
    layers = [layer.sha256 for tile in manifest.tiles[:1] for layer in tile.layers.values()]
    for sha in layers:
        store.put(TileStore(site).path(sha).read_bytes())
    manifest.save(mirror)
    working_file(mirror, keys={(there.column, there.row)})
    for sha in manifest.hashes():
        store.put(TileStore(site).path(sha).read_bytes())
    working_file(mirror)
    assert taken() == [0]


@pytest.mark.slow
def test_damaged_or_foreign_file_is_as_good_as_none(site, cache, taken):
    first = working_file(site, keys=set(keys_of(site)[:2]))
    with first.open("r+b") as file:
        file.seek(-4000, 2)
        file.write(b"\xff" * 4000)
    working_file(site)
    assert taken() == []
    assert earlier_file(site) != first
    next((cache / "parts").glob("*.last")).write_text('"../../elsewhere.coview"')
    assert earlier_file(site) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "flaw"),
    [
        (lambda tile, put: replace(tile, column=1 << 20), r"tiles in a rectangle of \d+ km2, 540 at most"),
        (lambda tile, put: replace(tile, column=tile.column + 5), "its stations lie beside it"),
        (lambda tile, put: with_layer(tile, put, "stations", np.full((3, tile.stations), 999, "<i4")), "beside it"),
        (lambda tile, put: with_layer(tile, put, "stations", np.zeros((3, 10**6), "<i4")), "too large"),
    ],
)
def test_tiles_that_would_need_more_memory_than_their_site_are_refused(site, cache, tmp_path, change, flaw):
    place = shutil.copytree(site, tmp_path / "copy")
    manifest = Manifest.load(place)
    tile = change(manifest.tiles[0], TileStore(place).put)
    replace(manifest, tiles=(tile, *manifest.tiles[1:])).save(place)
    with pytest.raises(MapError, match=flaw):
        working_file(place)


def with_layer(tile, put, name, steps):
    content = encode({"steps": steps})
    return replace(tile, layers=tile.layers | {name: LayerEntry(put(content), len(content))})
