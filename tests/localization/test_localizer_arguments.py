"""What a localizer is made of, what it refuses with a remedy, and what it says of itself."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, ConfigError, InputError, MapError
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import State


def test_localizer_of_a_path_loads_the_map(world_file):
    assert Localizer(str(world_file)).base_map.sha256 == Localizer(world_file).base_map.sha256 != ""
    with pytest.raises(MapError, match=r"nowhere\.coview"):
        Localizer("nowhere.coview")


@pytest.mark.parametrize("config", [{}, {"reloc": "coview"}, "coview"])
def test_config_that_is_none_is_refused_with_what_to_give(world_map, config):
    with pytest.raises(ConfigError, match=r"give a LocalizerConfig, such as LocalizerConfig\(reloc='coview'\)"):
        Localizer(world_map, config)


def test_map_that_is_none_is_refused_with_what_to_give():
    with pytest.raises(InputError, match=r"base_map is a ndarray; give a BaseMap or the path of a \.coview file"):
        Localizer(np.zeros((9, 3)))


def test_intensities_do_not_change_a_fix(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    for k, known in enumerate(world_fixes[:3]):
        cloud = world_drive.clouds[k]
        rows = np.column_stack([cloud, np.arange(len(cloud))])
        fix = localizer.step(rows, world_drive.T_odom_body[k], known.stamp)
        assert fix.to_json() == known.to_json()
    with pytest.raises(CloudError, match=r"give cloud\[:, :3\]"):
        localizer.step(np.zeros((99, 6)), np.eye(4), 99.0)


def test_relocalize_searches_again_and_finds(world_map, world_drive, world_fixes):
    config = LocalizerConfig(reloc="coview")
    localizer = Localizer(world_map, config)
    frames = list(zip(world_drive.clouds, world_drive.T_odom_body, strict=True))
    states = [localizer.step(*frame, 0.5 * k).state for k, frame in enumerate(frames)]
    assert states[-1] is State.TRACKING
    localizer.relocalize()
    assert localizer.state is State.SEARCHING
    again = [localizer.step(*frame, 100.0 + 0.5 * k).state for k, frame in enumerate(frames)]
    assert State.TRACKING in again


def test_localizer_says_its_state_and_map(world_map, world_drive):
    localizer = Localizer(world_map)
    assert repr(localizer).startswith("Localizer(SEARCHING, no frame yet, on BaseMap(")
    localizer.step(world_drive.clouds[0], world_drive.T_odom_body[0], 12.0)
    assert "frame of 12.000 s" in repr(localizer)


@pytest.mark.parametrize("take", [pickle.dumps, copy.copy, copy.deepcopy])
def test_localizer_cannot_be_copied_and_says_what_to_do(world_map, take):
    with pytest.raises(TypeError, match=r"make one in each process, Localizer\(base_map\)"):
        take(Localizer(world_map))
