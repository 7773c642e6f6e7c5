"""Sites that follow robots: tiles are fetched as they come to them, kept without a net, and begun with again."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from coview_stream.basemap.site.fetch import DirectorySource, Mirror
from coview_stream.basemap.site.manifest import Around, Manifest, kept_places, read_part
from coview_stream.basemap.site.route import Whereabouts
from coview_stream.basemap.site.served_site import ServedSite
from coview_stream.errors import MapError, TransportError

pytestmark = pytest.mark.slow

CORNER = (512_000.0, 5_120_000.0)
"""Where the four tiles of the site meet."""
WEST, EAST = (CORNER[0] - 50.0, CORNER[1] + 50.0), (CORNER[0] + 50.0, CORNER[1] + 50.0)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("coview_stream.basemap.site.fetch._WAIT", 0.0)


class Source(DirectorySource):
    gone = False

    def manifest(self):
        if self.gone:
            raise TransportError("yard: nobody answers")
        return super().manifest()


def at(place):
    return Whereabouts(place, True)


def around(place, radius=30.0):
    return Around(*place, radius)


def tiles(served):
    return read_part(served.map_path)[1]


def test_tiles_follow_the_robots(site):
    served = ServedSite(site, None, around(WEST))
    corner = min(tiles(served))
    assert len(tiles(served)) == 1
    assert not served.follow({"a": None, "b": None})
    assert not served.follow({"a": at((WEST[0] + 15.0, WEST[1])), "b": None})  # its circle moves on the same tile
    assert served.follow({"a": at(EAST), "b": None})
    assert tiles(served) == {corner, (corner[0] + 1, corner[1])}  # the other robot may be at the start
    assert served.follow({"a": at(EAST), "b": at(EAST)})
    assert tiles(served) == {(corner[0] + 1, corner[1])}
    assert not served.refresh()  # of a directory nothing is asked
    with pytest.raises(MapError, match="no tile of the site is there"):
        served.follow({"a": at((0.0, 0.0)), "b": at((0.0, 0.0))})
    assert len(tiles(served)) == 1
    served.close()
    assert not served.map_path.exists()


def test_only_tiles_of_the_route_are_fetched_and_they_are_there_without_the_net(site):
    source = Source(site)
    mirror = Mirror(source, None, around(WEST))
    mirror.open()
    served = ServedSite(mirror.directory, mirror, around(WEST))
    assert len(mirror.fetched(Manifest.load(site))) == 1
    source.gone = True
    with pytest.raises(TransportError, match="nobody answers"):
        served.follow({"a": at(EAST)})
    assert len(tiles(served)) == 1
    with pytest.raises(TransportError):
        served.refresh()
    source.gone = False
    assert served.refresh()  # what could not be fetched then
    assert tiles(served) == mirror.fetched(Manifest.load(site)) - {min(mirror.fetched(Manifest.load(site)))}
    source.gone = True
    assert served.follow({"a": at(WEST)})  # back, where everything is there
    assert "nobody answers" in served.offline
    assert len(tiles(served)) == 1


def test_change_of_the_site_that_following_fetches_is_told(site, tmp_path):
    copy = shutil.copytree(site, tmp_path / "copy")
    mirror = Mirror(Source(copy), None, around(WEST))
    mirror.open()
    served = ServedSite(mirror.directory, mirror, around(WEST))
    whole = Manifest.load(copy)
    replace(whole, tiles=whole.tiles[:-1], crs="EPSG:25833").save(copy)
    assert served.follow({"a": at((WEST[0] + 15.0, WEST[1]))})  # the same tile, of another state
    assert not served.refresh()


def test_what_failed_is_tried_again(site, monkeypatch):
    served = ServedSite(site, None, around(WEST))
    with monkeypatch.context() as patch:
        patch.setattr("coview_stream.basemap.site.served_site.part_file", full)
        with pytest.raises(MapError):
            served.follow({"a": at(EAST)})
    assert not served.follow({"a": at(EAST)})  # it has not moved since
    assert served.refresh()
    assert len(tiles(served)) == 1
    assert not served.refresh()


def full(*args):
    raise MapError("no room")


def test_next_start_is_where_the_robots_were_and_at_the_start(site):
    served = ServedSite(site, None, around(WEST))
    served.follow({"a": at(EAST)})
    served.close()
    assert kept_places(site, str(around(WEST))) == {"a": EAST}
    assert len(tiles(ServedSite(site, None, around(WEST)))) == 2


def test_whole_site_is_not_followed(site):
    served = ServedSite(site)
    assert served.map_path == site
    assert not served.follow({"a": at(EAST)})
    served.close()
    assert site.is_dir()
