"""One small world for all tests of the engine: built once, never changed."""

from __future__ import annotations

import numpy as np
import pytest
import small_world

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.files import write_cloud
from coview_stream.localization.localizer import Localizer

RADIUS = 30.0


@pytest.fixture(scope="session", autouse=True)
def state_home(tmp_path_factory):
    """Nodes of tests leave nothing in the user's state directory."""
    folder = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        yield folder


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
def elsewhere():
    """A run through another world."""
    return small_world.record(small_world.boxes(seed=77), frames=4)


@pytest.fixture(scope="session")
def world_fixes(world_map, world_drive):
    """What a localizer says of the drive, frame by frame."""
    localizer = Localizer(world_map)
    pairs = zip(world_drive.clouds, world_drive.T_odom_body, strict=True)
    return [localizer.step(cloud, T, 0.5 * k) for k, (cloud, T) in enumerate(pairs)]


@pytest.fixture(scope="session")
def world_run(world_drive, tmp_path_factory):
    """The drive on disk; read only."""
    return small_world.write_run(tmp_path_factory.mktemp("run") / "run", world_drive, 7)


@pytest.fixture(scope="session")
def elsewhere_run(elsewhere, tmp_path_factory):
    """A run outside the map, on disk; read only."""
    return small_world.write_run(tmp_path_factory.mktemp("elsewhere") / "run", elsewhere, 3)
