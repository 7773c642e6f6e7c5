"""Base map: stations with descriptors for the search, and a tiled cloud with normals for the registration."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels.mapped import release
from coview_stream.basemap import tiles
from coview_stream.basemap.file_format import Arrays, check_arrays, open_file, save
from coview_stream.basemap.likelihood_field import field_arrays, field_of, without_layers
from coview_stream.basemap.signature import FileIdentity, SigningKey, Trust, VerifyKey, read_verify_key
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.clouds.reference_system import short_name
from coview_stream.config import Channel, MapConfig, Preset, Reloc, config_of_map, map_preset
from coview_stream.errors import ConfigError, CoViewError, MapError, naming_missing_libraries
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Reals
from coview_stream.geometry.transforms import Points

if TYPE_CHECKING:
    from coview_stream.basemap.sources import Given
    from coview_stream.basemap.stations import Described
    from coview_stream.basemap.summary import MapSummary
    from coview_stream.descriptors.feature_map import FeatureMap

_REQUIRED = ("origin", "stations", "points", "normals", "tile_index", "surveyed", "surveyed_corner")


class BaseMap:
    """Base map, built from clouds or loaded from a ``.coview`` file.

    Points and stations are float32 metres relative to :attr:`origin`.

    Attributes:
        config: settings of the build.
        descriptor_config: settings of the descriptors; queries need the same.
        origin: (3,) float64 metres, the map's zero in the frame of the source.
        crs: coordinate reference system of the source as text, None if unknown.
        sources: sha256 of the source files by name.
        parameters: settings and facts of the build, as plain JSON data.
        arrays: arrays by name, as in the file; read-only.
        points: (N, 3) voxel cloud sorted by tile, relative to ``origin``; memory-mapped when loaded.
        stations: (M, 3) ground positions, relative to ``origin``.
        survey: raster relative to ``origin``, above zero in cells that hold points or touch one that does.
        nbytes: bytes of all arrays that :meth:`save` writes: the size of the file, except for a few kB.
        sha256: hash of parameters and content; empty until saved or loaded.
        path: file that the map was loaded from, else None.
        identity: state of that file.
        shared: whether other processes use the map too; the cache then holds the layers of its field for all of them.
    """

    path: Path | None = None
    identity: FileIdentity | None = None
    shared = False

    def __init__(self, arrays: Arrays, parameters: dict[str, Any], sha256: str = "") -> None:
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing:
            raise MapError(f"the map lacks {', '.join(missing)}; build it again")
        try:
            self.config = config_of_map(parameters["config"])
            self.crs: str | None = parameters["crs"]
            self.sources: dict[str, str] = dict(parameters["sources"])
            if not isinstance(self.crs, str | None):
                raise TypeError("crs is not text")
            json.dumps(parameters, ensure_ascii=False).encode()  # refuse lone surrogates: they cannot be printed
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise MapError(f"the map's parameters cannot be read ({error}); build it again") from error
        self.arrays, self.parameters, self.sha256 = arrays, parameters, sha256
        self.descriptor_config = self.config.descriptor
        self.origin = np.array(arrays["origin"], dtype=np.float64)
        self.points: Floats32 = arrays["points"]
        self.stations: Floats32 = np.array(arrays["stations"])
        self.survey = kernels.Raster(arrays["surveyed"].T, np.array(arrays["surveyed_corner"]), self.config.block)
        self.nbytes = sum(array.nbytes for array in without_layers(arrays).values())
        self._described: Described | None = None

    @classmethod
    def build(
        cls,
        sources: Given | Sequence[Given],
        preset: Preset = "slam",
        config: MapConfig | None = None,
        progress: bool = False,
        crs: str | None = None,
        **options: Any,
    ) -> BaseMap:
        """Build from one or several cloud files, or arrays of points.

        Args:
            sources: cloud files (formats: :func:`~coview_stream.clouds.files.read_cloud`), folders, patterns or arrays
                (N, 3), all in one frame, metres, z up; give large coordinates (UTM) as float64.
            preset: ``slam`` (radius 50 m) or ``tls`` (100 m).
            config: replaces preset and options.
            progress: show a bar on stderr, or one line per stage where stderr is not a terminal.
            crs: reference system of arrays, and of files that state none: ``EPSG:code`` or WKT; or "feet",
                "us-feet". Feet are converted to metres.
            options: fields of :class:`MapConfig` or :class:`DescriptorConfig`.

        Raises:
            CloudError: a source cannot be read, or its reference system allows no map (degrees, a map of the world).
            ConfigError: an option is unknown or out of range.
            MapError: there is no ground to stand on.
            InputError: ``learned=True`` without weights. DependencyError: a library of the extra ``build`` is missing.
        """
        with naming_missing_libraries("building a map", "build"):
            from coview_stream.basemap.build import build_arrays
            from coview_stream.basemap.sources import sources_of

        if not isinstance(config, MapConfig | None):
            raise ConfigError(f"config is a {type(config).__name__}; give a MapConfig, or its fields as options")
        settings = config or map_preset(preset, **options)
        with naming_missing_libraries("building a map", "build"):
            arrays, parameters = build_arrays(sources_of(sources, crs), settings, progress)
        parameters["config"] = asdict(settings)
        # the form that :meth:`load` will read: a tuple becomes a list
        return cls(arrays, json.loads(json.dumps(parameters)))

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        check: bool = True,
        verify_key: str | os.PathLike[str] | VerifyKey | Trust | None = None,
    ) -> BaseMap:
        """Memory-map a ``.coview`` file, or the working file of a site.

        Args:
            path: the file, the directory of a site, or a ``.tiles`` file that names a part of a site. Of a site the
                working file is loaded, and written first if it does not exist.
            check: read the whole file (a site's working file only the first time) and compare it with its checksum.
                False trusts the file's own :attr:`sha256`, for a file that was just checked.
            verify_key: public key, or its PEM file, that must have signed the map. The content is then compared with
                the signed hashes, unless :class:`~coview_stream.basemap.signature.Trust` says that this has been done.

        Raises:
            MapError: the map is missing, damaged, of another version or not signed with the key, or an array has a
                wrong type or shape. InputError: the key cannot be read. DependencyError: no ``cryptography``.
        """
        if isinstance(verify_key, str | os.PathLike):
            verify_key = read_verify_key(verify_key)
        trust = Trust(verify_key) if isinstance(verify_key, VerifyKey) else verify_key
        place = Path(path)
        made_here = place.is_dir() or place.suffix == ".tiles"
        if made_here:
            from coview_stream.basemap.site.working_file import open_site

            place, file = open_site(place, check, None if trust is None else trust.key)
        else:
            file = open_file(place, check, trust)
        try:
            loaded = cls(file.arrays, file.parameters, file.sha256)
            check_arrays(loaded.arrays, loaded.config, points=check and not made_here)
        except MapError as error:
            raise MapError(f"{place}: {error}") from error
        loaded.path, loaded.identity = place.absolute(), file.identity
        return loaded

    def save(self, path: str | os.PathLike[str], sign_key: SigningKey | None = None) -> str:
        """Write the map atomically, signed if there is a key, and return its sha256; MapError if that fails."""
        self.sha256 = save(Path(path), without_layers(self.arrays), self.parameters, sign_key)
        return self.sha256

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.stations)

    def __repr__(self) -> str:
        """Return file, content and reference system in one line, without reading the points."""
        name = "" if self.path is None else f"{str(self.path)!r}: "
        content = f"{len(self.stations):,} stations, {len(self.points):,} points"
        return f"BaseMap({name}{content}, crs {short_name(self.crs)}, sha256 {self.sha256[:8] or 'none yet'})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a loaded map as the path of its file, which must not change until unpickling; others as arrays."""
        if self.path is None:
            return type(self), (self.arrays, self.parameters, self.sha256)
        return _load_again, (type(self), str(self.path), self.sha256, self.identity)

    @cached_property
    def summary(self) -> MapSummary:
        """Extent, area, density, heights, and warnings of features on which robots will fail; printed as one line."""
        from coview_stream.basemap.summary import summary

        return summary(self)

    @cached_property
    def bounds(self) -> Floats:
        """Lowest and highest coordinates (2, 3) float64 of the points, in the frame of the sources, metres."""
        return np.array([self.points.min(axis=0), self.points.max(axis=0)], dtype=np.float64) + self.origin

    def world_points(self) -> Floats:
        """Return :attr:`points` (N, 3) in the frame of the sources, float64 metres; a copy."""
        return np.asarray(self.points, dtype=np.float64) + self.origin

    def plot(self, axes: Any = None) -> Any:
        """Draw the map from above, in the frame of the sources, metres, so that poses can be drawn over it.

        Draws into the matplotlib ``axes`` and returns them; None makes a figure (``matplotlib.pyplot.show()`` shows
        it). DependencyError if matplotlib is missing.
        """
        from coview_stream.basemap.summary import draw_plan

        return draw_plan(self.sampled_points, self.origin, self.config.voxel, axes)

    @cached_property
    def station_grid(self) -> StationGrid:
        """Grid that finds stations by position."""
        return StationGrid(self.stations, self.config.block)

    @cached_property
    def station_index(self) -> StationIndex:
        """Index of the descriptors, from the file, else built here (a second for 10,000 stations).

        MapError if the file's index has another number of stations.
        """
        channels = self.config.descriptor.channels
        index = StationIndex.from_arrays(self.arrays, channels)
        if index is not None and len(index) != len(self):
            raise MapError(f"the map's index is of {len(index)} stations, not {len(self)}; build it again")
        return index or StationIndex.of({name: self.descriptors(name) for name in channels})

    def sampled_points(self, count: int) -> Points:
        """Return a copy of at most ``count`` of :attr:`points`, evenly spaced by number."""
        return np.array(self.points[:: max(1, -(-len(self.points) // count))])

    def descriptors(self, name: Channel) -> npt.NDArray[np.float16]:
        """Return the descriptors (M, R, S) of one channel. The search does not need them.

        A map without descriptors computes all channels once from its cloud; two channels of 10,000 stations take 2 s
        on two cores, and 48 MB.
        """
        stored = self.arrays.get(f"descriptor.{name}")
        if stored is not None:
            return stored
        if self._described is None:
            from coview_stream.basemap.stations import describe_storeys

            config = self.config
            self._described = describe_storeys(np.asarray(self.points), self.stations, config.block, config.descriptor)
        return self._described[name]

    @cached_property
    def learned(self) -> FeatureMap | None:
        """Learned features, None if the map has none; MapError if they cannot be read."""
        parameters = self.parameters.get("learned")
        if parameters is None:
            return None
        from coview_stream.descriptors.feature_map import FeatureMap

        return FeatureMap(self.arrays, parameters)

    def crop(self, centre: Floats, radius: float) -> tuple[Points, Points]:
        """Return points and unit normals (K, 3), both map frame, in a circle of ``radius`` metres around ``centre``."""
        arrays = self.arrays
        return tiles.crop(self.points, arrays["normals"], arrays["tile_index"], self.config.tile, centre, radius)

    def points_near(self, centre: Floats, radius: float) -> Points:
        """Return the points of :meth:`crop` alone."""
        return tiles.points_near(self.points, self.arrays["tile_index"], self.config.tile, centre, radius)[0]

    @cached_property
    def field(self) -> kernels.FieldMap:
        """Likelihood field, relative to :attr:`origin`; built here if the file has none. MapError if it is invalid."""
        if self.shared:
            from coview_stream.basemap.site.working_file import with_shared_layers

            self.arrays = with_shared_layers(self.arrays, self.sha256)
        arrays = self.arrays
        if "field.tiles" not in arrays:
            normals = tiles.unit_normals(arrays["normals"])
            surveyed, corner = arrays["surveyed"] > 0, arrays["surveyed_corner"]
            arrays = field_arrays(np.asarray(self.points), normals, surveyed, corner, self.config.block)
        try:
            field = field_of(arrays)
            _ = field.layers
            for array in (field.tiles, field.occupied, field.ground, field.edge):  # scores read only the layers
                release(array)
            return field
        except (KeyError, ValueError) as error:
            raise MapError(f"the map's likelihood field cannot be used ({error}); build it again") from error

    def surveyed(self, xy: Reals) -> Bools:
        """Mask (K,) the positions (K, 2), relative to :attr:`origin`, around which the map has points."""
        grid = self.arrays["surveyed"]
        index = np.floor((xy - self.survey.corner) / self.config.block).astype(np.int64)
        inside = ((index >= 0) & (index < np.array(grid.shape)[::-1])).all(axis=1)
        index[~inside] = 0
        return np.asarray(inside & (grid[index[:, 1], index[:, 0]] > 0))

    def require_features(self, reloc: Reloc, load: bool = True) -> str | None:
        """Check that learned queries can be answered: the map's features and the weights.

        Args:
            reloc: mode of the search.
            load: also load the network, which only a search needs.

        Returns:
            Why ``auto`` does not use the map's features, and the remedy; None if it uses them or the map has none.

        Raises:
            MapError, InputError: with ``learned``, if features or weights are missing, do not fit together or cannot
                be loaded.
        """
        if reloc == "coview":
            return None
        try:
            if self.learned is not None:
                self.learned.check()
                if load:
                    from coview_stream.descriptors.network import network

                    network("ground", 1)
            elif reloc == "learned":
                raise MapError(
                    "the map has no learned features; build it again without --no-learned, or go without "
                    "them (--reloc coview)"
                )
        except CoViewError as error:
            if reloc == "learned":
                raise
            return f"going without learned features: {error}"
        return None


def station_descriptors(base_map: BaseMap, station: int) -> dict[Channel, npt.NDArray[np.float16]]:
    """Return a station's descriptors (R, S) by channel, computed from the cloud around it if the map has none."""
    config, block = base_map.config.descriptor, base_map.config.block
    if all(f"descriptor.{name}" in base_map.arrays for name in config.channels):
        return {name: base_map.descriptors(name)[station] for name in config.channels}
    from coview_stream.basemap.stations import describe_storeys

    here = base_map.stations[station]
    near = np.flatnonzero(np.abs(base_map.stations[:, 0] - here[0]) <= block)
    near = near[np.abs(base_map.stations[near, 1] - here[1]) <= block]
    points = base_map.points_near(here.astype(np.float64), config.radius + 3.0 * block)
    wanted = np.flatnonzero(near == station)
    described = describe_storeys(points, base_map.stations[near], block, config, None, wanted)
    return {name: values[0] for name, values in described.items()}


def _load_again(kind: type[BaseMap], path: str, sha256: str, identity: FileIdentity | None) -> BaseMap:
    """Load a map that was pickled as its path; MapError if its file is missing or has changed."""
    base_map = kind.load(path, check=False)
    if base_map.identity != identity:  # a copy, or another file
        base_map = kind.load(path)
        if base_map.sha256 != sha256:
            raise MapError(f"{path}: is another map than the one that was pickled; pickle it again")
    return base_map


def load_served(files: Mapping[str, Path], sha256: str) -> BaseMap:
    """Load the map with a hash from its file, which the node has checked; MapError if the file has changed since."""
    base_map = BaseMap.load(files[sha256], check=False)
    if base_map.sha256 != sha256:
        raise MapError(f"{files[sha256]}: the file is of another map than the one that is served")
    return base_map
