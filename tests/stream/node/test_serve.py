"""The start of a node: an error leaves nothing running; a node that has a key takes only maps signed with that key."""

import os
import threading
import time

import pytest
from sockets import free_endpoint, until

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import SigningKey, Trust, make_keys, read_verify_key
from coview_stream.errors import ConfigError, CoViewError, MapError, TransportError
from coview_stream.stream.node import serve
from coview_stream.stream.node.engine_process import EngineProcess, start_children
from coview_stream.stream.transport.keys import robot_keys

KEYS = [robot_keys("native", "coview", "r1")]


@pytest.mark.parametrize(
    ("error", "cause", "options"),
    [
        (MapError, "site.coview", lambda path: {"map_path": path}),
        (TransportError, "site.coview", lambda path: {"network": serve.NetworkOptions(zenoh_config=path)}),
        pytest.param(ConfigError, "--metrics", lambda path: {"metrics": "192.0.2.7:9464"}, marks=pytest.mark.slow),
    ],
    ids=["map", "network", "services"],
)
def test_opening_that_fails_names_the_cause_and_leaves_nothing_running(world_file, tmp_path, error, cause, options):
    before, children = set(threading.enumerate()), start_children(False)
    (tmp_path / "site.coview").write_bytes(b"{")
    given = {"map_path": world_file, "keys": KEYS, "network": serve.NetworkOptions(listen=[free_endpoint()])}
    with pytest.raises(error, match=cause):
        serve.open_node(serve.ServeOptions(**given | options(tmp_path / "site.coview")), children=children)
    assert {child.process.poll() for child in children.values()} == {-9}
    until(lambda: not [t for t in set(threading.enumerate()) - before if t.name.startswith("coview")])


@pytest.fixture
def site(tmp_path, world_map):
    """A folder with keys and a signed map."""
    for name in ("ours", "theirs"):
        make_keys(tmp_path / name)
    save(world_map, tmp_path, "ours")
    return tmp_path


def save(world_map, folder, key, **more):
    signing = None if key is None else SigningKey(folder / f"{key}.key")
    return BaseMap(world_map.arrays, world_map.parameters | more).save(folder / "site.coview", signing)


@pytest.mark.parametrize(("key", "said"), [(None, "not signed"), ("theirs", "another key")])
def test_reload_obeys_the_key_of_the_start(site, world_map, key, said):
    path, verify_key = site / "site.coview", read_verify_key(site / "ours.pub")
    options, served = serve.ServeOptions(path, KEYS, verify_key=verify_key), BaseMap.load(path).sha256
    assert serve.open_map(options, served, lambda: False) is None
    (site / "theirs.pub").replace(site / "ours.pub")  # the key is that of the start, whatever its file holds now
    save(world_map, site, key, crs="another")
    with pytest.raises(MapError, match=said):
        serve.open_map(options, served, lambda: False)


@pytest.mark.slow
def test_engine_that_starts_again_refuses_the_map_that_was_changed_meanwhile(site):
    path, key = site / "site.coview", read_verify_key(site / "ours.pub")
    node = BaseMap.load(path, verify_key=key)

    def open_engine():
        process = EngineProcess("track", str(path), node.sha256, trust=Trust(key, node.identity))
        try:
            process.start()
            process.wait_ready()
        finally:
            process.close()

    open_engine()
    time.sleep(0.02)  # the clock of file systems has steps of some milliseconds
    with path.open("r+b") as file:
        file.seek(-100, os.SEEK_END)  # the hash in its header stays the one that the node has verified
        file.write(bytes(100))
    with pytest.raises(CoViewError, match="changed since it was signed"):
        open_engine()
