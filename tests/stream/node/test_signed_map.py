"""A node that has a key: engines that start again and a reload take signed maps only, of that key."""

from __future__ import annotations

import os
import time

import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import SigningKey, Trust, make_keys, read_verify_key
from coview_stream.errors import CoViewError, MapError
from coview_stream.stream.node import serve
from coview_stream.stream.node.engine_process import EngineProcess
from coview_stream.stream.transport.keys import robot_keys


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


def options_of(site):
    keys = [robot_keys("native", "coview", "r1")]
    verify = read_verify_key(site / "ours.pub")
    return serve.ServeOptions(site / "site.coview", keys, verify_key=verify)


@pytest.mark.parametrize(("key", "said"), [(None, "not signed"), ("theirs", "another key")])
def test_reload_obeys_the_key_of_the_start(site, world_map, key, said):
    options, served = options_of(site), BaseMap.load(site / "site.coview").sha256
    assert serve.open_map(options, served, lambda: False) is None
    (site / "theirs.pub").replace(site / "ours.pub")  # the key is that of the start, whatever its file holds now
    save(world_map, site, key, crs="another")
    with pytest.raises(MapError, match=said):
        serve.open_map(options, served, lambda: False)


@pytest.mark.slow
def test_engine_that_starts_again_refuses_the_map_that_was_changed_meanwhile(site):
    """By the hash in its header it is the one that the node has verified."""
    path, key = site / "site.coview", read_verify_key(site / "ours.pub")
    node = BaseMap.load(path, verify_key=key)
    process = EngineProcess("track", str(path), node.sha256, trust=Trust(key, node.identity))
    try:
        process.start()
        process.wait_ready()
        process.close()
    finally:
        process.close()
    time.sleep(0.02)  # the clock of file systems has steps of some milliseconds
    with path.open("r+b") as file:
        file.seek(-100, os.SEEK_END)
        file.write(bytes(100))
    again = EngineProcess("track", str(path), node.sha256, trust=Trust(key, node.identity))
    try:
        again.start()
        with pytest.raises(CoViewError, match="changed since it was signed"):
            again.wait_ready()
    finally:
        again.close()
