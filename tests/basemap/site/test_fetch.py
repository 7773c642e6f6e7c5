"""Mirrors of sites: fetched, checked, kept; what is damaged or swapped on the way is refused and named."""

import hashlib
import json
import shutil
import socketserver
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import SigningKey, read_verify_key
from coview_stream.basemap.site.fetch import Mirror, ObjectStoreSource, SiteSource, WebSource, is_site_address
from coview_stream.basemap.site.manifest import FILE, LayerEntry, Manifest
from coview_stream.basemap.site.site_grid import Around, part_file, read_part
from coview_stream.basemap.site.store import TileStore, layer_path
from coview_stream.cli import main
from coview_stream.errors import ConfigError, CoViewWarning, MapError, TransportError
from tests.clouds.test_cloud_fetch import served_folder

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("cache", "no_pauses")]


class Directory(SiteSource):
    """A site's directory as a source, which may answer wrongly, or not at all."""

    def __init__(self, directory, change=lambda sha256, raw: raw):
        self.name, self.directory = str(directory), directory
        self.change = change
        self.gone = False
        self.asked = []

    def manifest(self):
        if self.gone:
            raise TransportError("yard: nobody answers")
        return (self.directory / FILE).read_bytes()

    def layer(self, sha256, size):
        self.asked.append(sha256)
        if self.gone:
            raise TransportError("yard: nobody answers")
        return self.change(sha256, (self.directory / layer_path(sha256)).read_bytes())


def test_mirror_is_the_site_and_is_opened_without_the_source(site):
    source = Directory(site)
    mirror = Mirror(source)
    path = mirror.open()
    assert Manifest.load(path) == Manifest.load(site)
    assert sorted(source.asked) == sorted(Manifest.load(site).hashes())
    assert len(BaseMap.load(path)) == sum(tile.stations for tile in Manifest.load(site).tiles)
    source.gone = True
    again = Mirror(source)
    with pytest.warns(CoViewWarning, match="nobody answers; going on with the tiles fetched before"):
        assert again.open() == path
    assert "nobody answers" in again.offline
    source.gone, asked = False, len(source.asked)
    assert not mirror.refresh()
    assert len(source.asked) == asked


def test_site_that_was_never_fetched_needs_its_source(site):
    source = Directory(site)
    source.gone = True
    with pytest.raises(TransportError, match="nobody answers"):
        Mirror(source).open()


@pytest.mark.parametrize(
    "change", [lambda sha256, raw: raw[:-1] + b"x", lambda sha256, raw: raw[:9], lambda sha256, raw: raw * 2]
)
def test_damaged_layers_are_refused_and_named(site, change):
    mirror = Mirror(Directory(site, change))
    with pytest.raises(MapError, match=r"yard: a layer of tile -?\d+, -?\d+ \([0-9a-f]{12}\) is not what the manifest"):
        mirror.open()
    assert not (mirror.directory / FILE).exists()


def test_swapped_layers_are_refused_and_the_map_before_is_kept(site):
    mirror = Mirror(Directory(site))
    path = mirror.open()
    before = Manifest.load(path)
    store = TileStore(path)
    other = next(iter(before.tiles[-1].layers.values()))
    victim = before.tiles[0].layers["cloud"]
    store.path(victim.sha256).write_bytes(store.get(other.sha256, other.bytes))  # damaged in the cache
    mirror.source.change = lambda sha256, raw: store.get(other.sha256, other.bytes)
    with pytest.raises(MapError, match="damaged or swapped"):
        mirror.open()
    mirror.source.change = lambda sha256, raw: raw
    mirror.open()
    assert store.is_whole(victim.sha256, victim.bytes)
    assert Manifest.load(path) == before


def test_what_was_fetched_before_a_source_broke_off_is_not_fetched_again(site):
    source = Directory(site)
    count = len(Manifest.load(site).hashes())

    def break_off(sha256, raw):
        if len(source.asked) > count // 2:
            source.gone = True
        return raw

    source.change = break_off
    mirror = Mirror(source)
    with pytest.raises(TransportError):
        mirror.open()
    source.gone, source.change, source.asked = False, lambda sha256, raw: raw, []
    mirror.open()
    assert 0 < len(source.asked) <= count - count // 2


def test_manifest_has_to_be_signed_where_a_key_is_asked_for(site, tmp_path):
    main(["keygen", str(tmp_path / "owner")])
    main(["keygen", str(tmp_path / "other")])
    site = shutil.copytree(site, tmp_path / "signed")
    Manifest.load(site).signed(SigningKey(tmp_path / "owner.key")).save(site)
    owner, other = (read_verify_key(tmp_path / f"{name}.pub") for name in ("owner", "other"))
    path = Mirror(Directory(site), owner).open()
    assert len(BaseMap.load(path, verify_key=owner)) > 0
    with pytest.raises(MapError, match="is not signed with"):
        Mirror(Directory(site), other).open()
    manifest = Manifest.load(site)
    replace(manifest, tiles=manifest.tiles[1:]).save(site)
    with pytest.warns(CoViewWarning, match="is not signed with .* going on with the tiles fetched before"):
        assert Mirror(Directory(site), owner).open() == path
    assert Manifest.load(path) == manifest
    source = Directory(site)
    source.gone = True
    with pytest.raises(MapError, match="is not signed with"):
        Mirror(source, other).open()


def test_changed_site_is_fetched_and_what_is_no_longer_named_goes_with_the_next_change(site, tmp_path):
    place = shutil.copytree(site, tmp_path / "changing")
    source = Directory(place)
    mirror = Mirror(source)
    path = mirror.open()
    whole = Manifest.load(place)
    source.asked = []
    replace(whole, tiles=whole.tiles[1:]).save(place)
    assert mirror.refresh()
    assert not source.asked
    gone = set(whole.hashes()) - Manifest.load(place).hashes()
    assert all(TileStore(path).path(sha256).exists() for sha256 in gone)  # somebody may still stand on it
    replace(whole, tiles=whole.tiles[2:]).save(place)
    assert mirror.refresh()
    assert not any(TileStore(path).path(sha256).exists() for sha256 in gone)


def test_state_that_no_map_can_be_made_of_does_not_replace_the_one_that_was_opened(site, tmp_path):
    place = shutil.copytree(site, tmp_path / "broken")
    mirror = Mirror(Directory(place))
    stations = len(BaseMap.load(mirror.open()))
    good = Manifest.load(place)
    store, tile = TileStore(place), good.tiles[0]
    for content in (b"no layer" * 999, b"nor this one" * 999, b"nor that one" * 999):  # older states are pruned
        layer = LayerEntry(store.put(content), len(content))
        bad = replace(good, tiles=(replace(tile, layers=tile.layers | {"cloud": layer}), *good.tiles[1:]))
        bad.save(place)
        assert mirror.refresh()
    for file in mirror.directory.parent.parent.glob("*.coview"):
        file.unlink()  # as if evicted
    with pytest.warns(CoViewWarning, match="is not a layer of a tile .* going on with the map that was opened before"):
        base_map = BaseMap.load(mirror.map_path)
    assert (len(base_map), base_map.parameters["site"]) == (stations, good.sha256)
    mirror.source.gone = True
    with pytest.warns(CoViewWarning, match="going on with"):
        assert len(BaseMap.load(Mirror(mirror.source).open())) == stations


def test_only_tiles_around_a_place_are_fetched(site):
    manifest = Manifest.load(site)
    tile = manifest.tiles[0]
    centre = [manifest.origin[k] + (index + 0.5) * manifest.tile for k, index in enumerate((tile.column, tile.row))]
    around = Around(*centre, 1.0)
    source = Directory(site)
    mirror = Mirror(source, around=around)
    path = mirror.open()
    assert len(source.asked) == len(tile.layers)
    assert read_part(path) == (mirror.directory.resolve(), {(tile.column, tile.row)})
    part = BaseMap.load(path)
    assert len(part) == tile.stations
    local = BaseMap.load(part_file(site, manifest.tiles_around(around), str(around)))
    assert local.sha256 == part.sha256
    with pytest.raises(MapError, match=r"no tile of the site is there, the nearest is \d+ m away"):
        Mirror(source, around=Around(1e6, 1e6, 10.0)).open()
    with pytest.raises(ConfigError, match="X,Y,RADIUS"):
        Around.parse("1,2")
    with pytest.raises(MapError, match="names no part"):
        read_part(site / FILE)


def test_site_of_a_web_server(site, capsys):
    with served_folder(site) as address:
        assert Manifest.load(Mirror(WebSource(address + "/")).open()) == Manifest.load(site)
        assert main(["info", address, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["fetched from"] == address
    assert main(["info", address]) == 0
    said = capsys.readouterr()
    assert "cannot be reached" in said.err
    assert "not reached now" in said.out
    assert main(["info", address + "/elsewhere"]) == 2


@contextmanager
def answering(*pieces, pause=0.0):
    """A web server that sends these bytes to anybody, and hangs up."""

    class Handler(socketserver.BaseRequestHandler):
        def handle(self):
            self.request.recv(65536)
            try:
                for piece in pieces:
                    self.request.sendall(piece)
                    time.sleep(pause)
            except OSError:
                pass  # the client has had enough

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads, server.block_on_close = True, False
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


OK = b"HTTP/1.1 200 OK\r\n"
TO = b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nLocation: "
LIES = {
    "chunk that breaks off": OK + b"Transfer-Encoding: chunked\r\n\r\n400\r\n{",
    "chunk without a size": OK + b"Transfer-Encoding: chunked\r\n\r\nxyz\r\n{",
    "body that breaks off": OK + b"Content-Length: 5000\r\n\r\n{",
    "length that is none": OK + "Content-Length: ²\r\n\r\n{".encode("latin-1"),
    "no answer": b"",
    "no status": b"hello\r\n\r\n",
    "empty label": TO + b"http://a..b/\r\n\r\n",
    "long label": TO + b"http://" + b"a" * 70 + b"/\r\n\r\n",
    "bracket": TO + b"http://[1/\r\n\r\n",
    "port": TO + b"http://127.0.0.1:x/\r\n\r\n",
    "ftp": TO + b"ftp://127.0.0.1/x\r\n\r\n",
    "file": TO + b"file:///etc/passwd\r\n\r\n",
    "not changed": b"HTTP/1.1 304 Not Modified\r\n\r\n",
    "page of a proxy": OK + b"\r\n<html>maintenance</html>",
    "endless header": OK + b"X: " + b"x" * 100_000 + b"\r\n\r\n",
}


@pytest.fixture(scope="module")
def fetched(site, tmp_path_factory):
    """A source of the site, and a cache with its mirror."""
    cache = tmp_path_factory.mktemp("fetched") / "cache"
    source = Directory(site)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COVIEW_CACHE", str(cache))
        Mirror(source).open()
    return source, cache


@pytest.mark.parametrize("lie", LIES)
def test_server_that_lies_is_no_reason_not_to_start(fetched, monkeypatch, lie):
    source, cache = fetched
    monkeypatch.setenv("COVIEW_CACHE", str(cache))
    with answering(LIES[lie]) as address:
        web = WebSource(address)
        with pytest.raises((TransportError, MapError)):
            Manifest.from_bytes(web.manifest(), address)
        web.name = source.name  # of the mirror in the cache
        web.manifest = WebSource(address).manifest
        with pytest.warns(CoViewWarning, match="going on with the tiles fetched before"):
            path = Mirror(web).open()
    assert Manifest.load(path) == Manifest.load(source.directory)


def test_body_that_drips_has_one_deadline():
    with answering(OK + b"Content-Length: 5000\r\n\r\n", *[b"x"] * 100, pause=0.2) as address:
        begin = time.monotonic()
        with pytest.raises(TransportError, match="is too slow"):
            WebSource(address).manifest()
    assert time.monotonic() - begin < 15.0


def test_site_larger_than_the_cache_fetches_nothing(site, monkeypatch):
    source = Directory(site)
    monkeypatch.setenv("COVIEW_CACHE_GB", "1e-5")
    with pytest.raises(MapError, match="more than the cache may hold; open a part of it"):
        Mirror(source).open()
    assert source.asked == []


def test_any_failure_of_a_source_is_one_of_transport(site):
    mirror = Mirror(Directory(site))
    path = mirror.open()
    mirror.source.manifest = lambda: {}["x"]
    with pytest.warns(CoViewWarning, match="KeyError: 'x'; going on"):
        assert mirror.open() == path


def test_site_of_an_object_store(site):
    pytest.importorskip("obstore", reason="obstore is not here; pip install 'coview-stream[s3]'")
    source = ObjectStoreSource(site.resolve().as_uri())
    assert Manifest.load(Mirror(source).open()) == Manifest.load(site)
    with pytest.raises(TransportError):
        source.layer(hashlib.sha256(b"").hexdigest(), 10)
    with pytest.raises(TransportError, match="check the address"):
        ObjectStoreSource("s4://x")


def test_addresses_are_told_from_paths(tmp_path):
    assert all(map(is_site_address, ("zenoh://yard", "https://host/yard", "s3://bucket/yard")))
    assert not any(map(is_site_address, ("yard", "/maps/yard/", "C:\\maps\\yard", "file:///yard", tmp_path)))
