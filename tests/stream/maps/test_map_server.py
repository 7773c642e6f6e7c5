"""Sites over zenoh, on loopback: served, fetched, followed while they change; nothing else of a directory is given."""

import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import zenoh
from sockets import free_endpoint, until

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.site.fetch import Mirror
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.site_build import build_site
from coview_stream.basemap.site.site_grid import Around, part_file, read_part
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.site.working_file import working_path
from coview_stream.clouds.files import write_cloud
from coview_stream.config import map_preset
from coview_stream.errors import ConfigError, TransportError
from coview_stream.stream.maps import map_follower
from coview_stream.stream.maps.fetch_map import prepare_map, source_of
from coview_stream.stream.maps.map_follower import MapFollower
from coview_stream.stream.maps.map_server import MapServer
from coview_stream.stream.maps.zenoh_source import MapKeys, ZenohSource
from coview_stream.stream.transport.zenoh_config import compose
from tests.basemap.site.test_fetch import Directory

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def built(map_points, tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    write_cloud(folder / "yard.las", map_points + np.array([512_003.0, 5_120_005.0, 100.0]))
    build_site(folder / "yard.las", folder / "yard", map_preset("slam", learned=False))
    return folder / "yard"


@pytest.fixture
def site(built, tmp_path, monkeypatch, no_pauses):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    return shutil.copytree(built, tmp_path / "yard")


@pytest.fixture
def endpoint():
    return free_endpoint()


@contextmanager
def followed(mirrors, *more, take_over=lambda: None):
    """Open the mirrors and follow their sites; yields the follower, and a list that grows by one for each change."""
    for mirror in mirrors:
        mirror.open()
    changes, stopping = [], threading.Event()
    follower = MapFollower(mirrors, lambda: changes.append(1) or take_over(), *more, period=0.05)
    thread = threading.Thread(target=follower.run, args=(stopping,))
    thread.start()
    try:
        yield follower, changes
    finally:
        stopping.set()
        thread.join()


def change(site):
    """Take the first tile out of a site; return the others."""
    whole = Manifest.load(site)
    replace(whole, tiles=whole.tiles[1:]).save(site)
    return whole.tiles[1:]


@pytest.fixture
def server(site, endpoint):
    made = MapServer(site, MapKeys.of("yard"), listen=[endpoint])
    yield made
    made.close()


@pytest.fixture
def source(endpoint):
    made = source_of(f"zenoh://{endpoint.removeprefix('tcp/')}/yard")
    yield made
    made.close()


def test_site_is_fetched_and_its_server_may_go(server, source, site):
    mirror = Mirror(source)
    path = mirror.open()
    assert Manifest.load(path) == Manifest.load(site)
    assert server.answered == 1 + len(Manifest.load(site).hashes())
    stations = len(BaseMap.load(path))
    server.close()
    with pytest.warns(UserWarning, match="no map server answers"):
        assert Mirror(source).open() == path
    assert len(BaseMap.load(path)) == stations


def test_only_the_manifest_and_named_layers_are_given(server, source, site, endpoint):
    (site / "layers" / "secret").write_bytes(b"not for you")
    (site / "secret").write_bytes(b"not for you")
    with zenoh.open(compose([endpoint])) as session:
        for key in (
            "coview/maps/yard/secret", "coview/maps/yard/layers/secret", "coview/maps/yard/layers/" + "0" * 64,
            "coview/maps/yard/layers/*", "coview/maps/other/manifest",
        ):  # fmt: skip
            assert [reply for reply in session.get(key, timeout=2.0) if reply.ok] == [], key
        found = [reply.ok for reply in session.get("coview/maps/*/manifest", timeout=2.0)]
        assert [str(each.key_expr) for each in found] == ["coview/maps/yard/manifest"]
    with pytest.raises(TransportError, match="no map server answers"):
        source.layer("0" * 64, 10)


def test_damaged_layer_is_told_by_the_server_and_never_used(server, source, site):
    layer = Manifest.load(site).tiles[0].layers["cloud"]
    path = TileStore(site).path(layer.sha256)
    path.write_bytes(b"x" * layer.bytes)
    with pytest.raises(TransportError, match="damaged or swapped"):
        Mirror(source).open()


def test_answer_that_is_too_large_is_not_read(server, source, site):
    layer = Manifest.load(site).tiles[0].layers["cloud"]
    with pytest.raises(TransportError, match="bytes, 10 at most"):
        source.layer(layer.sha256, 10)


def test_change_of_the_site_is_followed_and_an_outage_is_reported(server, source, site):
    mirror = Mirror(source)
    with followed([mirror]) as (follower, changes):
        tiles = change(site)
        until(lambda: changes)
        assert Manifest.load(mirror.directory).tiles == tiles
        (site / "manifest.json").write_text("{}")  # the server goes on with the one before
        until(lambda: follower.last["result"] == "current")
        server.close()
        until(lambda: follower.last["result"] == "unreachable")
        assert "no map server answers" in follower.last["error"]
        assert len(changes) == 1


def test_change_that_is_not_taken_over_is_asked_for_again(site):
    outcomes = ["loading"]
    with followed([Mirror(Directory(site))], lambda: outcomes[-1]) as (_, changes):
        change(site)
        time.sleep(0.3)
        assert not changes  # the node is still loading one
        outcomes.append("refused")
        until(lambda: len(changes) > 2)
        outcomes.append("changed")
        time.sleep(0.3)
        count = len(changes)
        time.sleep(0.5)
        assert len(changes) == count


def test_outage_of_one_site_hides_no_change_of_another(site, tmp_path):
    other = shutil.copytree(site, tmp_path / "other")
    gone = Directory(site)
    mirrors = [Mirror(gone), Mirror(Directory(other))]
    with followed(mirrors) as (follower, changes):
        gone.gone = True
        until(lambda: follower.last["result"] == "unreachable")
        change(other)
        until(lambda: changes)
        assert mirrors[0].offline == "yard: nobody answers"


@pytest.mark.parametrize("error", [ValueError("x"), KeyError("x"), RecursionError(), UnicodeError("a..b")])
def test_follower_survives_any_error_of_a_source_and_of_the_node(site, error):
    def fail():
        raise error

    source = Directory(site)
    good = source.manifest
    with followed([Mirror(source)], lambda: "refused", take_over=fail) as (follower, changes):
        source.manifest = fail
        until(lambda: follower.last["error"])
        source.manifest = good
        until(lambda: follower.last["result"] == "current")
        change(site)
        until(lambda: len(changes) > 1)


def test_source_that_goes_to_and_fro_is_asked_more_seldom(monkeypatch):
    now, taken = [0.0], []
    monkeypatch.setattr(map_follower, "time", SimpleNamespace(monotonic=lambda: now[0]))
    source = SimpleNamespace(name="yard", close=lambda: None)
    mirror = SimpleNamespace(source=source, offline="", refresh=lambda: True, map_path=None)

    def wait(seconds):
        now[0] += seconds
        return now[0] > 3600.0

    MapFollower([mirror], lambda: taken.append(now[0]), period=10.0).run(SimpleNamespace(wait=wait))
    assert taken[:5] == [10.0, 30.0, 70.0, 150.0, 310.0]
    assert len(taken) < 20


def test_refusal_that_is_no_text_is_one_error(endpoint, source):
    with zenoh.open(compose((), [endpoint])) as session:
        queryable = session.declare_queryable("coview/maps/yard/**", lambda query: query.reply_err(b"\xff\xfe"))
        with pytest.raises(TransportError, match="yard"):
            source.manifest()
        queryable.undeclare()


def test_tiles_of_a_circle_are_chosen_again_when_the_site_changes(site):
    mirror = Mirror(Directory(site), None, Around(512_000.0, 5_120_000.0, 30.0))
    with followed([mirror]) as (_, changes):
        tiles = change(site)
        until(lambda: changes)
        assert read_part(mirror.map_path)[1] == {(tile.column, tile.row) for tile in tiles}


def test_working_file_of_a_part_is_made_by_another_process(site):
    part = part_file(site, [(0, 0)], "test")
    prepare_map(part, lambda: False)
    assert working_path(Manifest.load(site), [(0, 0)]).is_file()
    prepare_map(site, lambda: True)  # given up
    assert not working_path(Manifest.load(site)).exists()
    prepare_map(site / "manifest.json", lambda: False)  # one file: there is nothing to do


def test_another_name_and_no_server_are_said(server, site, endpoint):
    address = endpoint.removeprefix("tcp/")
    for name, words in (
        (f"{address}/yrd", "there has it; there are yard"),
        ("127.0.0.1:9/yard", "is serve-map running"),
    ):
        asked = source_of(f"zenoh://{name}")
        with pytest.raises(TransportError, match=words):
            asked.manifest()
        asked.close()


def test_addresses(endpoint):
    source = source_of("zenoh://yard", connect=[endpoint])
    assert isinstance(source, ZenohSource)
    assert source.name == f"zenoh://yard ({endpoint})"
    assert len({source_of("zenoh://yard", base, [endpoint]).name for base in ("coview", "a", "b")}) == 3
    for address in ("zenoh://host/yard", "zenoh://a*b", "ftp://x/y"):
        with pytest.raises(ConfigError):
            source_of(address)


def test_command_says_what_it_serves_and_ends_with_a_signal(site, endpoint):
    command = [sys.executable, "-m", "coview_stream", "serve-map", str(site), "--listen", endpoint, "--name", "north"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert line.startswith("coview/maps/north: ")
            assert "4 tiles" in line
            source = source_of(f"zenoh://{endpoint.removeprefix('tcp/')}/north")
            assert Manifest.from_bytes(source.manifest(), "") == Manifest.load(site)
            source.close()
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(10.0) == 0


STOPPED = """
import os, signal, sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
for _ in range(int(sys.argv[3])):
    session.get(sys.argv[2], lambda reply: None)  # more than the link holds
print("up", flush=True)
os.kill(os.getpid(), signal.SIGSTOP)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no SIGSTOP")
@pytest.mark.parametrize("queries", [5, 40])
def test_readers_that_stopped_hold_up_no_other(site, endpoint, queries):
    layer = max((x for tile in Manifest.load(site).tiles for x in tile.layers.values()), key=lambda x: x.bytes)
    keys = MapKeys.of("yard")
    server = MapServer(site, keys, listen=[f"{endpoint}#so_sndbuf=8192"])
    client = f'{{mode: "client", connect: {{endpoints: ["{endpoint}#so_rcvbuf=8192"]}}}}'
    readers = []
    try:
        for _ in range(3):
            command = [sys.executable, "-c", STOPPED, client, keys.layer(layer.sha256), str(queries)]
            readers.append(subprocess.Popen(command, stdout=subprocess.PIPE))
            assert readers[-1].stdout.readline() == b"up\n"
        begin = time.monotonic()
        source = ZenohSource("yard", connect=[endpoint])
        assert source.manifest() == server.manifest.to_bytes()
        assert len(source.layer(layer.sha256, layer.bytes)) == layer.bytes
        assert time.monotonic() - begin < 4.0  # zenoh waits five seconds for each of the others
        source.close()
    finally:
        for reader in readers:
            reader.kill()
            reader.wait()
        server.close()
