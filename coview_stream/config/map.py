"""Settings of a base map and its descriptors, and the paper's two presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from coview_stream.config.checks import check_types, counts, names_parts, positive, require
from coview_stream.errors import ConfigError

Channel = Literal["scan_context", "coview", "paper"]
Preset = Literal["slam", "tls"]


_FINEST = 0.01  # metres: finer than any laser scanner, and int32 still counts 10,000 km of it


@dataclass(frozen=True)
class DescriptorConfig:
    """Polar descriptor of a virtual scan (paper, eqs 1-4); set by hand where the paper gives no value.

    It is stored in the map and read back from it, so that map and robot never drift apart. As a map may come from
    anyone, ranges limit the work per station to ten times that of the defaults.

    Attributes:
        radius: metres that a descriptor reaches, at most 200; the paper's.
        rings: bins along the radius, at most 80; ``rings`` times ``sectors`` is at most 4,800.
        sectors: bins around; a shift by one is a turn by 2 pi / ``sectors``.
        channels: descriptors that vote together: ``scan_context``, the greatest heights of all bins; ``coview``, those
            of co-visible bins; ``paper``, eqs 1-4 as printed. ``python -m bench ablation`` compares them.
        voxel: metres; one point is kept per cube of this size.
        ground_zero: measure a keyframe's heights from the ground below the robot, as the map's are, not from the
            sensor; ``python -m bench ablation`` compares both.
    """

    radius: float = 50.0
    rings: int = 20
    sectors: int = 60
    channels: tuple[Channel, ...] = ("scan_context", "coview")
    voxel: float = 0.5
    ground_zero: bool = True

    def __post_init__(self) -> None:
        check_types(self)
        positive(self, "radius", "voxel")
        require(self.radius <= 200, self, "radius", "at most 200 m")
        require(self.voxel >= _FINEST, self, "voxel", f"at least {_FINEST} m")
        counts(self, "rings", minimum=4, maximum=80)
        counts(self, "sectors", minimum=4)
        require(self.rings * self.sectors <= 4800, self, "sectors", "at most 4,800 bins in all rings")
        known = get_args(Channel)
        require(bool(self.channels) and set(self.channels) <= set(known), self, "channels", f"some of {known}")
        require(len(set(self.channels)) == len(self.channels), self, "channels", "without repetition")


@names_parts
@dataclass(frozen=True)
class MapConfig:
    """Building of a base map; set by hand where the paper gives no value.

    Attributes:
        descriptor: of the stations.
        block: metres between stations, a multiple of 0.5.
        voxel: metres; one point is stored per cube of this size.
        tile: metres, size of the tiles by which points are sorted.
        outlier_neighbours: of each point, for the statistical outlier filter; 0 switches it off.
        outlier_std_ratio: standard deviations by which a point's mean distance to its neighbours may exceed the mean.
        normal_radius: metres within which neighbours define a point's normal.
        normal_neighbours: limit on the number of these neighbours.
        levels: also put a station on every floor of a building above the ground.
        learned: also store the features for learned re-localization.
    """

    descriptor: DescriptorConfig = field(default_factory=DescriptorConfig)
    block: float = 2.0
    voxel: float = 0.25
    tile: float = 20.0
    outlier_neighbours: int = 12
    outlier_std_ratio: float = 4.0
    normal_radius: float = 1.0
    normal_neighbours: int = 20
    levels: bool = True
    learned: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        positive(self, "block", "voxel", "tile", "outlier_std_ratio", "normal_radius")
        counts(self, "outlier_neighbours", minimum=0, maximum=1000)
        counts(self, "normal_neighbours", minimum=3, maximum=1000)
        require(1.0 <= self.tile <= 1280.0, self, "tile", "of 1 to 1280 m")
        require(self.voxel >= _FINEST, self, "voxel", f"at least {_FINEST} m")
        halves = self.block / 0.5  # stations must be at the centres of the raster's cells
        require(abs(halves - round(halves)) < 1e-6, self, "block", "a multiple of 0.5 m")
        require(self.voxel <= self.block, self, "voxel", f"no larger than block ({self.block} m)")
        require(self.block < self.descriptor.radius, self, "block", f"below the radius ({self.descriptor.radius} m)")


def map_preset(name: Preset, **changes: Any) -> MapConfig:
    """Return one of the paper's two settings: ``slam`` (radius 50 m) or ``tls`` (terrestrial scans, radius 100 m).

    ``changes`` are fields of :class:`MapConfig` or :class:`DescriptorConfig` that replace the preset's. Raises
    :class:`ConfigError` for an unknown preset or field, or a value out of range.
    """
    if isinstance(name, MapConfig):
        raise ConfigError("preset is a MapConfig; give it as config=")
    if name not in get_args(Preset):
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(get_args(Preset))}")
    descriptor: dict[str, Any] = {"radius": 100.0 if name == "tls" else 50.0}
    rest: dict[str, Any] = {}
    descriptor_names = {f.name for f in fields(DescriptorConfig)}
    map_names = {f.name for f in fields(MapConfig)} - {"descriptor"}
    for key, value in changes.items():
        if key in descriptor_names - {"voxel"}:
            descriptor[key] = value
        elif key in map_names:
            rest[key] = value
        else:
            raise ConfigError(f"unknown map option {key!r}; choose from {sorted(descriptor_names | map_names)}")
    return MapConfig(descriptor=DescriptorConfig(**descriptor), **rest)


_BUILT_IN = {"visibility": "paper", "eye": 1.5}
"""Descriptor options of earlier versions only, named in their files, and the value that is now built in."""


def config_of_map(plain: Mapping[str, Any]) -> MapConfig:
    """Return the settings that a map's file stores as plain data.

    Raises:
        ConfigError: a value is out of range. KeyError, TypeError, ValueError: the data are something else.
    """
    fields_of_map = dict(plain)
    fields_of_map.setdefault("learned", False)  # for maps older than this field
    descriptor = dict(fields_of_map.pop("descriptor"))
    descriptor["channels"] = tuple(descriptor["channels"])
    for name, only in _BUILT_IN.items():
        if (value := descriptor.pop(name, only)) != only:
            raise ConfigError(f"{name} is {value!r}; only {only!r} is known now")
    return MapConfig(descriptor=DescriptorConfig(**descriptor), **fields_of_map)
