"""Configurations refuse what makes no sense, by name; presets and their options."""

from dataclasses import FrozenInstanceError, asdict, fields, is_dataclass

import numpy as np
import pytest

from coview_stream.config import (
    AcceptanceConfig,
    ConsensusConfig,
    DescriptorConfig,
    KeyframeConfig,
    LearnedConfig,
    LocalizerConfig,
    MapConfig,
    RegistrationConfig,
    TrackingConfig,
    map_preset,
)
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import ConfigError

CONFIGS = [
    AcceptanceConfig, ConsensusConfig, DescriptorConfig, KeyframeConfig, LearnedConfig,
    LidarOdometryConfig, LocalizerConfig, MapConfig, NodeConfig, RegistrationConfig,
    TrackingConfig,
]  # fmt: skip

BAD = [
    (DescriptorConfig, "radius", float("inf")),
    (DescriptorConfig, "rings", 3),
    (DescriptorConfig, "sectors", 60.0),
    (DescriptorConfig, "channels", ()),
    (DescriptorConfig, "channels", ("coview", "coview")),
    (DescriptorConfig, "channels", ("colour",)),
    (MapConfig, "block", 50.0),
    (MapConfig, "voxel", 2.5),
    (MapConfig, "normal_neighbours", 2),
    (LearnedConfig, "reach", 33.0),
    (RegistrationConfig, "keep", 1.1),
    (RegistrationConfig, "search", ()),
    (RegistrationConfig, "search", (0.5, 1.0)),
    (RegistrationConfig, "track", (0.5, 0.0)),
    (AcceptanceConfig, "risk", 0.9e-9),
    (AcceptanceConfig, "risk", 0.5),
    (AcceptanceConfig, "max_blind_s", float("inf")),
    (LidarOdometryConfig, "max_range", 0.5),
    (NodeConfig, "pose_rate", 201.0),
    (NodeConfig, "max_gap", float("inf")),
]

NUMBERS = ("float", "int", "bool", "tuple[float, ...]")
MAY_BE_ZERO = ("range_min", "outlier_neighbours", "cloud_delay")
BAD += [
    (kind, item.name, value)
    for kind in CONFIGS
    for item in fields(kind)
    for value in ("a", None, [1.0, "b"], float("nan"), -2, 0)
    if item.type in NUMBERS and (value != 0 or item.name not in MAY_BE_ZERO)
]


@pytest.mark.parametrize(("kind", "name", "value"), BAD)
def test_value_out_of_range_or_of_another_type_is_refused_by_name(kind, name, value):
    """What is not a number must not end in a TypeError, nor a text in a flag count as true."""
    with pytest.raises(ConfigError, match=rf"^{name} is .*must be .*{kind.__name__}\.{name}"):
        kind(**{name: value})


def test_part_given_as_a_dictionary_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"must be a KeyframeConfig \(LocalizerConfig\.keyframe\)"):
        LocalizerConfig(keyframe={"distance": 2.0})
    with pytest.raises(ConfigError, match=r"MapConfig\.descriptor"):
        MapConfig(descriptor={"radius": 50.0})


def test_numbers_of_numpy_are_numbers():
    assert MapConfig(voxel=np.float32(0.5), levels=np.True_).voxel == 0.5


def test_field_in_the_wrong_place_is_named_with_the_right_one():
    with pytest.raises(ConfigError, match=r"write acceptance=AcceptanceConfig\(risk=1e-05\)"):
        LocalizerConfig(risk=1e-5)
    with pytest.raises(ConfigError, match=r"write descriptor=DescriptorConfig\(radius=3\)"):
        MapConfig(radius=3)
    with pytest.raises(ConfigError, match="no acceptence; did you mean 'acceptance'"):
        LocalizerConfig(acceptence=AcceptanceConfig())


def test_configurations_are_frozen_and_equal_by_value():
    assert LocalizerConfig() == LocalizerConfig()
    with pytest.raises(FrozenInstanceError):
        MapConfig().block = 3.0
    for item in fields(LocalizerConfig):
        inner = getattr(LocalizerConfig(), item.name)
        if is_dataclass(inner):
            assert type(inner)(**asdict(inner)) == inner


def test_map_presets():
    assert map_preset("slam") == MapConfig()
    assert map_preset("tls").descriptor.radius == 100.0
    assert map_preset("tls", radius=80.0).descriptor.radius == 80.0
    with pytest.raises(ConfigError, match="give it as config="):
        map_preset(MapConfig())


def test_preset_options_reach_the_right_configuration():
    changed = map_preset("slam", block=1.0, sectors=30, channels=("coview",), voxel=0.5)
    assert changed.block == 1.0
    assert changed.descriptor.sectors == 30
    assert changed.descriptor.channels == ("coview",)
    # voxel is the stored cloud's; the descriptor's own stays
    assert changed.voxel == 0.5
    assert map_preset("slam", voxel=0.2).descriptor.voxel == DescriptorConfig().voxel


def test_unknown_presets_and_options_are_named():
    with pytest.raises(ConfigError, match=r"'indoor'.*slam, tls"):
        map_preset("indoor")
    with pytest.raises(ConfigError, match=r"'blok'.*block"):
        map_preset("slam", blok=1.0)
    with pytest.raises(ConfigError, match="'descriptor'"):
        map_preset("slam", descriptor=DescriptorConfig())
    with pytest.raises(ConfigError, match=r"MapConfig\.block"):
        map_preset("slam", block=-2.0)
