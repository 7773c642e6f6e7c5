"""How a base map and its descriptors are made, and the paper's two settings for it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from coview_stream.config.checks import counts, positive, require
from coview_stream.errors import ConfigError

Channel = Literal["scan_context", "coview", "coview_strict"]
Preset = Literal["slam", "tls"]


@dataclass(frozen=True)
class DescriptorConfig:
    """How a virtual scan becomes a polar descriptor (paper, section 3.2, eqs 1-4).

    ``channels`` names the descriptors that vote together: ``scan_context`` is the maximum height of every bin,
    ``coview`` keeps what both views can see (eqs 1-3: horizontally visible, or dense), ``coview_strict`` only
    what is horizontally visible. Measured: unlike views (airborne map) favour co-visibility, like views favour Scan
    Context, the two together are right on both.
    """

    radius: float = 50.0
    rings: int = 20
    sectors: int = 60
    channels: tuple[Channel, ...] = ("scan_context", "coview")
    voxel: float = 0.5
    ground_zero: bool = True

    def __post_init__(self) -> None:
        positive(self, "radius", "voxel")
        require(self.radius <= 1000, self, "radius", "at most 1000 m")
        counts(self, "rings", "sectors", least=4)
        known = get_args(Channel)
        require(
            bool(self.channels) and set(self.channels) <= set(known), self, "channels", f"some of {known}"
        )
        require(len(set(self.channels)) == len(self.channels), self, "channels", "without repetition")


@dataclass(frozen=True)
class MapConfig:
    """How a base map is built (paper, section 3.1); ``learned`` maps also hold what learned re-localization needs."""

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
        positive(self, "block", "voxel", "tile", "outlier_std_ratio", "normal_radius")
        counts(self, "outlier_neighbours", least=0)
        counts(self, "normal_neighbours", least=3)
        halves = self.block / 0.5  # stations must stand at the centres of the raster's cells
        require(abs(halves - round(halves)) < 1e-6, self, "block", "a multiple of 0.5 m")
        require(self.voxel <= self.block, self, "voxel", f"no larger than block ({self.block} m)")
        require(
            self.block < self.descriptor.radius,
            self,
            "block",
            f"below the radius ({self.descriptor.radius} m)",
        )


def map_preset(name: Preset, **changes: Any) -> MapConfig:
    """Return one of the paper's two settings: ``slam`` (radius 50 m) and ``tls`` (terrestrial scans, radius 100 m).

    ``changes`` are fields of :class:`MapConfig` or :class:`DescriptorConfig` that replace the preset's. Raises
    :class:`ConfigError` for an unknown preset or field, or a value out of range.
    """
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
            raise ConfigError(
                f"unknown map option {key!r}; choose from {sorted(descriptor_names | map_names)}"
            )
    return MapConfig(descriptor=DescriptorConfig(**descriptor), **rest)
