"""Configuration: frozen dataclasses with validated ranges, paper defaults and named presets.

Lengths in metres, angles in radians. Settings of the map's descriptors (:class:`DescriptorConfig`) are stored in the
map and read back from it, so that the two never drift apart; the rest belongs to the localizer.
"""

from __future__ import annotations

from coview_stream.config.localizer import (
    AcceptanceConfig,
    ConsensusConfig,
    KeyframeConfig,
    LearnedConfig,
    LocalizerConfig,
    RegistrationConfig,
    Reloc,
    TrackingConfig,
)
from coview_stream.config.map import Channel, DescriptorConfig, MapConfig, Preset, config_of_map, map_preset
from coview_stream.config.mount import Mount

__all__ = [
    "AcceptanceConfig",
    "Channel",
    "ConsensusConfig",
    "DescriptorConfig",
    "KeyframeConfig",
    "LearnedConfig",
    "LocalizerConfig",
    "MapConfig",
    "Mount",
    "Preset",
    "RegistrationConfig",
    "Reloc",
    "TrackingConfig",
    "config_of_map",
    "map_preset",
]
