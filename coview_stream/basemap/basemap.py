"""Base map: stations with descriptors to search in, and a tiled cloud with normals to register to."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels.mapped import release
from coview_stream.basemap import file_format, tiles
from coview_stream.basemap.file_format import check_arrays
from coview_stream.basemap.likelihood_field import LAYERS, field_arrays, field_of
from coview_stream.basemap.signature import FileIdentity, SigningKey, Trust, VerifyKey, read_verify_key
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.clouds.reference_system import short_name
from coview_stream.config import Channel, DescriptorConfig, MapConfig, Preset, Reloc, config_of_map, map_preset
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

    All coordinates inside are float32 metres relative to :attr:`origin`, (3,) float64 in the frame of the source.

    Attributes:
        config: how it was built.
        origin: (3,) float64, the source-frame position of the map's zero.
        crs: coordinate reference system text of the source, if it had one.
        sources: names and sha256 of the source files.
        sha256: hash of parameters and content; empty until saved or loaded.
        path: of the file it was loaded from, None if it was not.
        identity: of that file.
    """

    path: Path | None = None
    identity: FileIdentity | None = None

    def __init__(self, arrays: file_format.Arrays, parameters: dict[str, Any], sha256: str = "") -> None:
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing:
            raise MapError(f"the map lacks {', '.join(missing)}; build it again")
        try:
            self.config = config_of_map(parameters["config"])
            self.crs: str | None = parameters["crs"]
            self.sources: dict[str, str] = dict(parameters["sources"])
            if not isinstance(self.crs, str | None):
                raise TypeError("crs is no text")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise MapError(f"the map's parameters cannot be read ({error}); build it again") from error
        self._arrays = arrays
        self.parameters = parameters
        self.origin = np.array(arrays["origin"], dtype=np.float64)
        self.sha256 = sha256

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
        """Build from one or several cloud files (tiles), or arrays of points.

        Args:
            sources: las/laz, ply, pcd, npy or bin files in one frame, metres, or arrays (N, 3) of such coordinates;
                float64 where they are large (UTM).
            preset: ``slam`` (radius 50 m) or ``tls`` (100 m).
            config: takes the place of preset and options.
            progress: show a bar on stderr.
            crs: reference system of arrays, and of files that state none: ``EPSG:code`` or WKT; of metres.
            options: fields of :class:`MapConfig` or :class:`DescriptorConfig`.

        Raises:
            CloudError: a source cannot be read, or its system is not of metres.
            ConfigError: an option is unknown or out of range.
            MapError: there is no ground to stand on.
            DependencyError, InputError: ``learned=True`` without onnxruntime or weights.
        """
        with naming_missing_libraries("building a map", "build"):
            from coview_stream.basemap.build import build_arrays
            from coview_stream.basemap.sources import sources_of

        if not isinstance(config, MapConfig | None):
            raise ConfigError(f"config is a {type(config).__name__}; give a MapConfig, or its fields as options")
        settings = config or map_preset(preset, **options)
        arrays, parameters = build_arrays(sources_of(sources, crs), settings, progress)
        parameters["config"] = asdict(settings)
        # as :meth:`load` will read it: a tuple becomes a list
        return cls(arrays, json.loads(json.dumps(parameters)))

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        check: bool = True,
        verify_key: str | os.PathLike[str] | VerifyKey | Trust | None = None,
    ) -> BaseMap:
        """Memory-map a ``.coview`` file, or a site's.

        Args:
            path: the file; or the directory of a site, or a part of one, whose working file is made first where it is
                not there.
            check: compare its content with its checksum, for which the whole file is read, a site's working file only
                the first time; without, :attr:`sha256` is what the file says: for one that another process has just
                checked.
            verify_key: public key, or its PEM file, that the map has to be signed with; its content is compared with
                the signed hashes then, whatever ``check`` says. A
                :class:`~coview_stream.basemap.signature.Trust` names a file that has been compared already, and is not
                read again.

        Raises:
            MapError: it is missing, damaged or of another version, an array has another type or shape, or it is not
                signed with the key. InputError: the key cannot be read. DependencyError: no ``cryptography``.
        """
        if isinstance(verify_key, str | os.PathLike):
            verify_key = read_verify_key(verify_key)
        trust = Trust(verify_key) if isinstance(verify_key, VerifyKey) else verify_key
        place = Path(path)
        if place.is_dir() or place.suffix == ".tiles":
            from coview_stream.basemap.site.working_file import open_site

            place, file = open_site(place, check, None if trust is None else trust.key)
        else:
            file = file_format.open_file(place, check, trust)
        loaded = cls(file.arrays, file.parameters, file.sha256)
        loaded.path, loaded.identity = place.absolute(), file.identity
        check_arrays(loaded._arrays, loaded.config)
        return loaded

    def save(self, path: str | os.PathLike[str], sign_key: SigningKey | None = None) -> str:
        """Write the map atomically, signed if there is a key, and return its sha256.

        Raises:
            MapError: that fails.
        """
        self.sha256 = file_format.save(Path(path), self._saved(), self.parameters, sign_key)
        return self.sha256

    def _saved(self) -> file_format.Arrays:
        return {name: array for name, array in self._arrays.items() if not name.startswith(LAYERS)}

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.stations)

    def __repr__(self) -> str:
        """Return file, content and reference system in one line, without a look at the points."""
        name = "" if self.path is None else f"{str(self.path)!r}: "
        content = f"{len(self._arrays['stations']):,} stations, {len(self.points):,} points"
        return f"BaseMap({name}{content}, crs {short_name(self.crs)}, sha256 {self.sha256[:8] or 'none yet'})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a map that was loaded as the path of its file, which has to be there, and the same, when it is read.

        One that was built is pickled with all its arrays.
        """
        if self.path is None:
            return type(self), (self._arrays, self.parameters, self.sha256)
        return _load_again, (type(self), str(self.path), self.sha256, self.identity)

    @cached_property
    def summary(self) -> MapSummary:
        """Extent, area, density and heights, and what about the map will make robots fail; printed it is one line."""
        from coview_stream.basemap.summary import summary

        return summary(self)

    @cached_property
    def bounds(self) -> Floats:
        """(2, 3) float64 lowest and highest coordinates of the points, in the frame of the sources, metres."""
        return np.array([self.points.min(axis=0), self.points.max(axis=0)], dtype=np.float64) + self.origin

    @property
    def area(self) -> float:
        """Square metres that hold points, in squares of a metre."""
        return self.summary.area

    @property
    def density(self) -> float | None:
        """Points of the sources per square metre of :attr:`area`; None for a file that does not say."""
        return self.summary.density

    def world_points(self) -> Floats:
        """Return :attr:`points` (N, 3) in the frame of the sources, float64 metres; a copy."""
        return np.asarray(self.points, dtype=np.float64) + self.origin

    def plot(self, axes: Any = None) -> Any:
        """Draw the map from above with matplotlib, in the frame of the sources, metres: poses can be drawn over it.

        Args:
            axes: to draw into; None makes a figure of its own (``matplotlib.pyplot.show()`` shows it).

        Returns:
            The axes.

        Raises:
            DependencyError: matplotlib is missing.
        """
        from coview_stream.basemap.summary import draw_plan

        return draw_plan(self.sampled_points, self.origin, self.config.voxel, axes)

    @property
    def descriptor_config(self) -> DescriptorConfig:
        """Settings that the descriptors were made with; queries need the same."""
        return self.config.descriptor

    @cached_property
    def stations(self) -> Floats32:
        """(M, 3) ground positions, relative to :attr:`origin`."""
        return np.array(self._arrays["stations"])

    @cached_property
    def station_grid(self) -> StationGrid:
        """Look-up of stations by position."""
        return StationGrid(self.stations, self.config.block)

    @cached_property
    def station_index(self) -> StationIndex:
        """Index of the descriptors, from the file; a file without it costs a second for 10,000 stations here.

        Raises :class:`MapError` if the file's is not of these stations.
        """
        channels = self.config.descriptor.channels
        known = StationIndex.from_arrays(self._arrays, channels)
        if known is not None and len(known) != len(self):
            raise MapError(f"the map's index is of {len(known)} stations, not {len(self)}; build it again")
        return known or StationIndex.of({name: self.descriptors(name) for name in channels})

    @property
    def points(self) -> Floats32:
        """(N, 3) voxel cloud sorted by tile, relative to :attr:`origin`; memory-mapped when loaded."""
        return self._arrays["points"]

    def sampled_points(self, count: int) -> Points:
        """Return at most ``count`` of :attr:`points`, evenly spread over them; a copy."""
        return np.array(self.points[:: max(1, -(-len(self.points) // count))])

    def sampled_normals(self, count: int) -> Points:
        """Return the unit normals of :meth:`sampled_points`."""
        return tiles.unit_normals(np.array(self._arrays["normals"][:: max(1, -(-len(self.points) // count))]))

    @property
    def arrays(self) -> file_format.Arrays:
        """Arrays by name, as its file has them; not to be changed."""
        return self._arrays

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays that :meth:`save` writes: the size of the map in one file, but for a few kB."""
        return sum(array.nbytes for array in self._saved().values())

    @property
    def site_sha256(self) -> str:
        """Hash of the state of the site that the map is of, equal for all parts of it; the map's own without a site."""
        return str(self.parameters.get("site") or self.sha256)

    def release(self) -> None:
        """Let the memory go that the file's pages take; what is used again is read again."""
        for array in self._arrays.values():
            release(array)

    def descriptors(self, name: Channel) -> npt.NDArray[np.float16]:
        """Return the descriptors (M, R, S) of one channel.

        Searching needs none of them; maps that do not hold them make them of the cloud, once: 2 s for 10,000 stations
        on two cores, 2.4 kB of memory for each.
        """
        kept = self._arrays.get(f"descriptor.{name}")
        return self._described[name] if kept is None else kept

    def descriptors_of(self, station: int) -> dict[Channel, npt.NDArray[np.float16]]:
        """Return the descriptors (R, S) of one station by channel, made of the cloud if the map holds none."""
        channels = self.config.descriptor.channels
        if all(f"descriptor.{name}" in self._arrays for name in channels):
            return {name: self.descriptors(name)[station] for name in channels}
        from coview_stream.basemap.stations import describe_storeys

        config, block = self.config.descriptor, self.config.block
        here = self.stations[station]
        near = np.flatnonzero((np.abs(self.stations[:, :2] - here[:2]) <= block).all(axis=1))
        points, _ = self.crop(here.astype(np.float64), config.radius + 3.0 * block)
        wanted = np.flatnonzero(near == station)
        described = describe_storeys(points, self.stations[near], block, config, None, wanted)
        return {name: values[0] for name, values in described.items()}

    @cached_property
    def _described(self) -> Described:
        """Descriptors that the map does not hold."""
        from coview_stream.basemap.stations import describe_storeys

        return describe_storeys(np.asarray(self.points), self.stations, self.config.block, self.config.descriptor)

    @cached_property
    def learned(self) -> FeatureMap | None:
        """Learned features, if it was built with them; raises :class:`MapError` if they cannot be read."""
        parameters = self.parameters.get("learned")
        if parameters is None:
            return None
        from coview_stream.descriptors.feature_map import FeatureMap

        return FeatureMap(self._arrays, parameters)

    def crop(self, centre: Floats, radius: float) -> tuple[Points, Points]:
        """Return points and unit normals (K, 3) within ``radius`` metres of ``centre``, relative to :attr:`origin`."""
        return tiles.crop(
            self.points, self._arrays["normals"], self._arrays["tile_index"], self.config.tile, centre, radius
        )

    @cached_property
    def field(self) -> kernels.FieldMap:
        """Likelihood field; relative to :attr:`origin`. A map that was built before there was one has it made now.

        Raises :class:`MapError` if the file's cannot be used.
        """
        arrays = self._arrays
        if "field.tiles" not in arrays:
            normals = tiles.unit_normals(arrays["normals"])
            surveyed, corner = arrays["surveyed"] > 0, arrays["surveyed_corner"]
            arrays = field_arrays(np.asarray(self.points), normals, surveyed, corner, self.config.block)
        try:
            field = field_of(arrays)
            _ = field.layers
            for array in (field.tiles, field.occupied, field.ground, field.edge):  # only the layers are looked up
                release(array)
            return field
        except (KeyError, ValueError) as error:
            raise MapError(f"the map's likelihood field cannot be used ({error}); build it again") from error

    def cut(self, cut: kernels.Cut) -> kernels.Crop | None:
        """Cut out the points around a place, sorted for searching; None where there are none."""
        spans = tiles.spans(self._arrays["tile_index"], self.config.tile, np.array([cut.x, cut.y]), cut.radius)
        return kernels.crop_points(self.points, self._arrays["normals"], spans, cut)

    @cached_property
    def survey(self) -> kernels.Raster:
        """Cells that the map has points around, above zero; relative to :attr:`origin`."""
        return kernels.Raster(self._arrays["surveyed"].T, np.array(self._arrays["surveyed_corner"]), self.config.block)

    def surveyed(self, xy: Reals) -> Bools:
        """Tell of (K, 2) positions, relative to :attr:`origin`, whether the map has points around them."""
        grid, corner = self._arrays["surveyed"], self._arrays["surveyed_corner"]
        index = np.floor((xy - corner) / self.config.block).astype(np.int64)
        inside = ((index >= 0) & (index < np.array(grid.shape)[::-1])).all(axis=1)
        index[~inside] = 0
        return np.asarray(inside & (grid[index[:, 1], index[:, 0]] > 0))

    def require_features(self, reloc: Reloc, load: bool = True) -> str | None:
        """Check what the first learned query needs: the map's features, the weights and onnxruntime.

        Args:
            reloc: how the map is to be searched.
            load: also load the network, which takes 0.3 s and 60 MB; only searching needs it.

        Returns:
            Why ``auto`` goes without the features that the map has, with the remedy; None if it does not have to.

        Raises:
            MapError: ``learned`` is asked for, and the map has no features, damaged ones, or some of other weights.
            InputError: likewise, and there are no weights, or some that cannot be loaded.
            DependencyError: likewise, and there is no onnxruntime, or one that cannot be loaded.
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


def _load_again(kind: type[BaseMap], path: str, sha256: str, identity: FileIdentity | None) -> BaseMap:
    """Load a map that was pickled as its path; MapError where its file is gone or another."""
    base_map = kind.load(path, check=False)
    if base_map.identity != identity:  # a copy, or another file
        base_map = kind.load(path)
        if base_map.sha256 != sha256:
            raise MapError(f"{path}: is another map than the one that was pickled; pickle it again")
    return base_map
