"""A site built of clouds: the same bytes whatever the order and the workers, resumed, as good a map as one file."""

import json
import shutil
from contextlib import closing

import numpy as np
import pytest
from nightly import nightly
from trackers import follow

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import file_identity
from coview_stream.basemap.site import tile_build
from coview_stream.basemap.site.convert import join, split
from coview_stream.basemap.site.executors import Executor, ProcessExecutor
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.site_build import WORK, build_site
from coview_stream.basemap.site.store import TileStore
from coview_stream.clouds.files import write_cloud
from coview_stream.config import map_preset
from coview_stream.errors import CloudError, InputError, MapError
from coview_stream.localization.localizer import Localizer

CONFIG = map_preset("slam", learned=False)
FAR = np.array([512_003.0, 5_120_005.0, 100.0])
"""Where the small world is put: the corner of four tiles lies in it, 3 and 5 m from its middle."""


@pytest.fixture(scope="module")
def halves(map_points, tmp_path_factory):
    """Two files of the small world, which overlap."""
    folder = tmp_path_factory.mktemp("halves")
    for name, part in (("a.las", map_points[:, 0] < 8.0), ("b.las", map_points[:, 0] > -8.0)):
        write_cloud(folder / name, map_points[part] + FAR)
    return folder


@pytest.fixture(scope="module")
def site(halves, tmp_path_factory):
    directory = tmp_path_factory.mktemp("built") / "site"
    built = build_site(halves, directory, CONFIG)
    assert (len(built.manifest.tiles), built.reused, built.skipped) == (4, 0, ())
    return directory


class Interrupted(Executor):
    def __init__(self, after):
        self.after = after

    def run(self, function, items):
        for number, result in super().run(function, items):
            if function is tile_build.build_tile:
                self.after -= 1
                if self.after < 0:
                    raise KeyboardInterrupt
            yield number, result


@pytest.mark.slow
def test_order_of_the_files_changes_nothing(site, halves, tmp_path):
    built = build_site([halves / "b.las", halves / "a.las"], tmp_path / "other", CONFIG)
    assert built.manifest == Manifest.load(site)
    for sha in built.manifest.hashes():
        assert TileStore(tmp_path / "other").path(sha).read_bytes() == TileStore(site).path(sha).read_bytes()


@pytest.mark.slow
def test_number_of_workers_changes_nothing(site, halves, tmp_path):
    with closing(ProcessExecutor(2)) as executor:
        built = build_site(halves, tmp_path / "other", CONFIG, executor=executor)
    assert (tmp_path / "other" / "manifest.json").read_bytes() == (site / "manifest.json").read_bytes()
    assert built.manifest.hashes() == {
        path.name for path in (tmp_path / "other" / "layers").glob("*/*")
    }  # nothing else is left


@pytest.mark.slow
def test_build_that_was_broken_off_goes_on(site, halves, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build_site(halves, tmp_path / "other", CONFIG, executor=Interrupted(3))
    assert not (tmp_path / "other" / "manifest.json").exists()
    records = sorted((tmp_path / "other" / WORK / "records").iterdir())
    layer = next(path for path in (tmp_path / "other" / "layers").glob("*/*"))
    layer.write_bytes(b"cut off" * 3)  # is not what its name says: its tile is built again
    built = build_site(halves, tmp_path / "other", CONFIG)
    assert built.reused == len(records) - 1
    assert built.manifest == Manifest.load(site)
    assert not (tmp_path / "other" / WORK / "parts").exists()
    again = build_site(halves, tmp_path / "other", CONFIG)
    assert (again.reused, again.manifest) == (4, built.manifest)


@nightly
def test_new_survey_of_a_part_builds_only_what_is_near(halves, map_points, tmp_path):
    far = map_points + FAR + [400.0, 0.0, 0.0]  # two tiles on: farther than any halo
    write_cloud(tmp_path / "c.las", far)
    sources = [halves / "a.las", halves / "b.las", tmp_path / "c.las"]
    first = build_site(sources, tmp_path / "site", CONFIG)
    write_cloud(tmp_path / "c.las", far[: len(far) // 2])
    second = build_site(sources, tmp_path / "site", CONFIG)
    changed = len(first.manifest.tiles) - second.reused
    assert 0 < changed < len(first.manifest.tiles)
    assert len(first.manifest.hashes() & second.manifest.hashes()) >= 4  # of the first world's far side


@pytest.mark.slow
def test_source_that_cannot_be_read_is_named_and_left_out_if_that_is_wanted(halves, tmp_path):
    (tmp_path / "broken.laz").write_bytes((halves / "a.las").read_bytes()[:5000])
    sources = [halves / "a.las", halves / "b.las", tmp_path / "broken.laz"]
    with pytest.raises(CloudError, match=r"broken\.laz"):
        build_site(sources, tmp_path / "one", CONFIG)
    built = build_site(sources, tmp_path / "two", CONFIG, keep_going=True)
    assert len(built.skipped) == 1
    assert "broken.laz" in built.skipped[0]
    assert set(built.manifest.parameters["sources"]) == {"a.las", "b.las"}


class Failing(Executor):
    def run(self, function, items):
        for number, result in super().run(function, items):
            broken = function is tile_build.build_tile and items[number].key == (0, 0)
            yield number, MapError("broken") if broken else result


@pytest.mark.slow
def test_tile_that_fails_is_named_and_left_out_if_that_is_wanted(halves, tmp_path):
    with pytest.raises(MapError, match="tile 0, 0: broken"):
        build_site(halves, tmp_path / "site", CONFIG, executor=Failing())
    built = build_site(halves, tmp_path / "site", CONFIG, executor=Failing(), keep_going=True)
    assert built.skipped == ("tile 0, 0: broken",)
    assert len(built.manifest.tiles) == 3


def test_directories_and_sources_that_no_site_can_be_built_of(halves, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("x")
    with pytest.raises(MapError, match=r"full: is not a site, and not empty"):
        build_site(halves, tmp_path / "full", CONFIG)
    with pytest.raises(MapError, match="is not a site"):
        BaseMap.load(tmp_path / "full")
    with pytest.raises(MapError, match="is a file"):
        build_site(halves, halves / "a.las", CONFIG)
    with pytest.raises(InputError, match="built of files"):
        build_site(np.zeros((5, 3)), tmp_path / "x", CONFIG)
    write_cloud(tmp_path / "few.las", np.random.default_rng(1).uniform(0, 9, (50, 3)))
    with pytest.raises(MapError, match="50 points are left"):
        build_site(tmp_path / "few.las", tmp_path / "y", CONFIG)


@pytest.mark.slow
def test_site_is_as_good_a_map_as_one_file(site, world_map, world_drive, cache):
    base_map = BaseMap.load(site)
    assert base_map.crs == world_map.crs
    shift = base_map.origin - world_map.origin - FAR
    for name in ("points", "stations"):
        ours, theirs = getattr(base_map, name) + shift, getattr(world_map, name)
        assert abs(len(ours) - len(theirs)) <= 0.03 * len(theirs)
        step = {"points": 0.05, "stations": 2.0}[name]  # blocks begin elsewhere
        np.testing.assert_allclose(ours.min(axis=0)[:2], theirs.min(axis=0)[:2], atol=step)
        np.testing.assert_allclose(ours.max(axis=0)[:2], theirs.max(axis=0)[:2], atol=step)
    assert base_map.descriptors("coview").shape == (len(base_map), 20, 60)  # made when they are asked for
    fix = follow(Localizer(base_map), world_drive)[-1]
    assert fix.state.name == "TRACKING"
    error = fix.T_map_body[:3, 3] - FAR - world_drive.T_map_body[-1][:3, 3]
    assert np.linalg.norm(error) < 0.1


@pytest.mark.slow
def test_codes_are_those_of_the_descriptors(site, cache):
    """Made tile by tile, as if all had been described at once; stations beside a tile's edge see across it."""
    from coview_stream.basemap.station_index import StationIndex

    base_map = BaseMap.load(site)
    names = base_map.config.descriptor.channels
    whole = StationIndex.of({name: base_map.descriptors(name) for name in names})
    query = {name: base_map.descriptors(name)[17].astype(np.float32) for name in names}
    found = [each.best(each.query(query)) for each in (base_map.station_index, whole)]
    np.testing.assert_allclose(*found, atol=1e-3)


@pytest.mark.slow
def test_working_file_is_compared_with_its_checksum_once_and_made_again_where_it_is_damaged(site, cache):
    path = BaseMap.load(site).path
    assert [path.suffix for path in sorted(cache.iterdir()) if path.is_file()] == [".checked", ".coview", ".lock"]
    whole = path.read_bytes()
    damaged = whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:]
    path.write_bytes(damaged)
    with path.open("rb") as file:
        path.with_suffix(".checked").write_text(json.dumps(file_identity(file)))  # as if it had been compared
    BaseMap.load(site)
    assert path.read_bytes() == damaged
    path.with_suffix(".checked").write_text("[1]")
    BaseMap.load(site)
    assert path.read_bytes() == whole


@pytest.mark.slow
def test_working_file_holds_the_rasters_that_are_looked_up_and_one_file_does_not(site, cache, tmp_path):
    base_map = BaseMap.load(site)
    assert isinstance(base_map.field.layers.words, np.memmap)
    base_map.save(tmp_path / "one.coview")
    one = BaseMap.load(tmp_path / "one.coview")
    assert not isinstance(one.field.layers.words, np.memmap)
    assert one.nbytes == base_map.nbytes
    for stored, made in zip(base_map.field.layers, one.field.layers, strict=True):
        np.testing.assert_array_equal(stored, made)


@pytest.mark.slow
def test_rasters_of_a_shared_map_are_made_once_in_the_cache_if_there_is_one(world_map, world_file, cache, monkeypatch):
    def shared():
        base_map = BaseMap.load(world_file)
        base_map.shared = True
        return base_map

    first = shared()
    assert isinstance(first.field.layers.words, np.memmap)
    assert first.nbytes == world_map.nbytes
    (made,) = cache.glob("*.coview")
    made.write_bytes(made.read_bytes()[:-1])  # a damaged one is made again
    monkeypatch.setenv("COVIEW_CACHE", str(world_file))
    alone = shared()
    assert not isinstance(alone.field.layers.words, np.memmap)
    monkeypatch.setenv("COVIEW_CACHE", str(cache))
    again = shared()
    for base_map in (alone, again):
        for stored, wanted in zip(base_map.field.layers, world_map.field.layers, strict=True):
            np.testing.assert_array_equal(stored, wanted)
    assert isinstance(again.field.layers.words, np.memmap)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("station_codes.StationCodes.MAX_STATIONS", 100), ("field._MAX_TABLE", 2)])
def test_site_that_is_too_large_for_one_map_is_to_be_opened_in_parts(site, cache, monkeypatch, name, most):
    monkeypatch.setattr(f"coview_kernels.{name}", most)
    with pytest.raises(MapError, match="--around X,Y,RADIUS"):
        BaseMap.load(site)
    assert not list(cache.glob("*.coview"))


@pytest.mark.slow
def test_damaged_and_swapped_layers_are_named(site, cache, tmp_path):
    copy = shutil.copytree(site, tmp_path / "copy")
    one, other = (TileStore(copy).path(tile.layers["cloud"].sha256) for tile in Manifest.load(copy).tiles[:2])
    kept = one.read_bytes()
    one.write_bytes(other.read_bytes())
    with pytest.raises(MapError, match=one.name):
        BaseMap.load(copy)
    one.unlink()
    with pytest.raises(MapError, match=one.name):
        BaseMap.load(copy)
    one.write_bytes(kept)
    assert len(BaseMap.load(copy))


@pytest.mark.slow
def test_map_in_one_file_becomes_a_site_and_one_file_again(world_map, learned_map, tmp_path, cache):
    for number, base_map in enumerate((world_map, learned_map)):
        directory = tmp_path / f"site{number}"
        manifest = split(base_map.arrays, base_map.parameters, directory)
        assert manifest == Manifest.load(directory)
        join(directory, tmp_path / "back.coview")
        back = BaseMap.load(tmp_path / "back.coview")
        assert (len(back), len(back.points), back.crs) == (len(base_map), len(base_map.points), base_map.crs)
        np.testing.assert_array_equal(back.origin, base_map.origin)
        assert (back.learned is None) == (base_map.learned is None)
        if base_map.learned is not None:
            assert back.learned is not None
            assert back.learned.area == base_map.learned.area
