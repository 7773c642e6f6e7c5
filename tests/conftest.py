"""One small world for all tests of the engine: built once, never changed."""

import os
import signal
from contextlib import contextmanager

import numpy as np
import pytest
import small_world
from hypothesis import settings
from trackers import follow

from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.clouds.files import write_cloud
from coview_stream.localization.localizer import Localizer

RADIUS = 30.0

settings.register_profile("deterministic", derandomize=True, database=None, deadline=None, max_examples=60)
settings.load_profile("deterministic")

# where tests run in the background of a shell it is ignored, and the processes that they start would inherit that
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def state_home(tmp_path_factory):
    """Nodes of tests leave nothing in the user's state directory, nor in the cache of maps."""
    folder = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        patch.setenv("COVIEW_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield folder


@pytest.fixture
def no_pauses(monkeypatch):
    """No pause before a second try to fetch; slow answers end after 3 s, of zenoh 5 s; map servers look each 0.05 s."""
    for name, seconds in {
        "basemap.site.fetch._WAIT": 0.0,
        "basemap.site.fetch._PATIENCE": 3.0,
        "clouds.fetch._WAIT": 0.0,
        "stream.maps.map_server._LOOK": 0.05,
        "stream.maps.zenoh_source._TIMEOUT": 5.0,
    }.items():
        monkeypatch.setattr(f"coview_stream.{name}", seconds)


@pytest.fixture
def available_cores(monkeypatch):
    """Sets the number of cores that the system allows this process."""
    return lambda count: monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(count)), raising=False)


@pytest.fixture
def full_disk():
    """Context in which a file takes so many bytes and no more, as on a full disk."""
    resource = pytest.importorskip("resource", reason="limits of processes are of POSIX")

    @contextmanager
    def limited(size):
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


@pytest.fixture(scope="session")
def scene():
    return small_world.boxes(seed=3)


@pytest.fixture(scope="session")
def map_points(scene):
    """(N, 3) float64 base map points around zero."""
    return small_world.sample_map(scene)


@pytest.fixture(scope="session")
def map_cloud_file(map_points, tmp_path_factory):
    path = tmp_path_factory.mktemp("world") / "site.ply"
    write_cloud(path, map_points.astype(np.float32))
    return path


@pytest.fixture(scope="session")
def world_map(map_cloud_file):
    """The base map of the small world, source frame at zero."""
    return BaseMap.build(map_cloud_file, radius=RADIUS)


@pytest.fixture(scope="session")
def learned_map(world_map):
    """The same with features of the network in the package, untested for accuracy."""
    from coview_stream.descriptors.feature_map import feature_arrays

    arrays, parameters = feature_arrays(np.array(world_map.points))
    return BaseMap({**world_map.arrays, **arrays}, {**world_map.parameters, "learned": parameters})


@pytest.fixture(scope="session")
def world_file(world_map, tmp_path_factory):
    """The same, saved; read only."""
    path = tmp_path_factory.mktemp("maps") / "site.coview"
    # a map of its own, for saving sets the hash
    BaseMap(world_map.arrays, world_map.parameters).save(path)
    return path


@pytest.fixture(scope="session")
def world_drive(scene):
    return small_world.record(scene)


@pytest.fixture(scope="session")
def slow_drive(scene):
    """The first eight metres of the same way, a frame every 0.2 m."""
    return small_world.record_along(scene, small_world.drive(5), 0.2)


@pytest.fixture(scope="session")
def way(scene):
    """Nineteen metres with a bend, a frame every 0.4 m."""
    return small_world.record_along(scene, small_world.drive(10), 0.4)


@pytest.fixture(scope="session")
def elsewhere():
    """A run through another world."""
    return small_world.record(small_world.boxes(seed=77), frames=4)


@pytest.fixture(scope="session")
def world_fixes(world_map, world_drive):
    """Fixes of the drive, frame by frame."""
    return follow(Localizer(world_map), world_drive)


@pytest.fixture(scope="session")
def world_run(world_drive, tmp_path_factory):
    """The drive on disk; read only."""
    return small_world.write_run(tmp_path_factory.mktemp("run") / "run", world_drive, 7)


@pytest.fixture(scope="session")
def elsewhere_run(elsewhere, tmp_path_factory):
    """A run outside the map, on disk; read only."""
    return small_world.write_run(tmp_path_factory.mktemp("elsewhere") / "run", elsewhere, 3)


@pytest.fixture
def refused(capsys):
    """Run a command that must be refused: exit code 2, one line on stderr, which is returned, and nothing on stdout."""

    def run(*words):
        capsys.readouterr()
        assert main([*map(str, words)]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("coview-stream: error: ")
        assert captured.err.count("\n") == 1
        return captured.err

    return run
