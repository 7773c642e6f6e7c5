"""A robot that drives out of the tiles that its node began with: the map follows it, and its poses go on."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import subprocess
import threading
import time

import numpy as np
from nightly import nightly
from sockets import free_endpoint

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.site.manifest import Around, Manifest, tiles_around
from coview_stream.clouds import read_tum
from coview_stream.clouds.python_child import python_command, python_environment

RADIUS = 90.0
RATE = 10.0


@nightly
def test_map_follows_a_robot_through_a_town(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    world = tmp_path / "world"
    run("simulate", world, "--scene", "town", "--seed", 77, "--size", 640, "--length", 260, "--speed", 2.5)
    run("build", world / "base.laz", "-o", f"{tmp_path}/site/", "--no-learned")
    stamps, truth = read_tum(world / "truth.tum")
    start = truth[0][:3, 3]
    around = Around(float(start[0]), float(start[1]), RADIUS)
    manifest = Manifest.load(tmp_path / "site")
    first = tiles_around(manifest, around)
    middle = [tiles_around(manifest, Around(*map(float, T[:2, 3]), 0.1)) for T in truth]
    assert set().union(*middle) - first, "the drive ends on a tile that the node did not begin with"
    assert len(first) < len(manifest.tiles)

    endpoint = free_endpoint()
    words = ("--robot", "r1", "--no-state", "--listen", endpoint, "--around", str(around))
    poses, maps = [], set()
    with started("serve", f"{tmp_path}/site", *words), started("watch", "--json", "--connect", endpoint) as watcher:
        lines = queue.SimpleQueue()
        threading.Thread(target=pass_on, args=(watcher.stdout, lines), daemon=True).start()
        json.loads(lines.get(timeout=240.0))  # the node is there: it has made the first part
        with started("replay", world / "run", "--robot", "r1", "--connect", endpoint) as robot:
            while robot.poll() is None:
                with contextlib.suppress(queue.Empty):
                    told = json.loads(lines.get(timeout=0.5))
                    if str(told.get("key", "")).endswith("/out/pose"):
                        poses.append((time.monotonic(), told))
                        maps.add(told["map_sha256"])
        assert robot.returncode == 0
    times = np.array([at for at, _ in poses])
    at = np.array([told["stamp_ns"] / 1e9 for _, told in poses])
    said = np.array([told["position"] for _, told in poses])
    true = np.array([truth[np.argmin(np.abs(stamps - each))][:3, 3] for each in at])
    off = np.linalg.norm(said - true, axis=1)
    assert len(maps) > 1, "no other map was taken over"
    assert off.max() < 0.5
    assert np.diff(times).max() < 0.5, "poses stopped while the map was changed"
    assert at[-1] > stamps[-1] - 1.0, "the robot was lost before its drive ended"
    assert len(BaseMap.load(tmp_path / "site")) == sum(tile.stations for tile in manifest.tiles)


def pass_on(file, lines):
    with contextlib.suppress(ValueError):  # closed
        for line in file:
            lines.put(line)


def run(*words):
    subprocess.run(command(*words), env=python_environment(), check=True, capture_output=True)


@contextlib.contextmanager
def started(*words):
    with subprocess.Popen(command(*words), env=python_environment(), stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)


def command(*words):
    return python_command("coview_stream", *map(str, words))
