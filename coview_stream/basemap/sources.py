"""Sources of a base map: cloud files, and arrays of points in memory."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.clouds.cloud_head import CloudHead, read_head
from coview_stream.clouds.files import expand_cloud_paths, read_cloud
from coview_stream.clouds.reference_system import (
    flaw_of_name,
    flaw_of_system,
    same_system,
    short_name,
    unchecked_system,
)
from coview_stream.clouds.survey_unit import SurveyUnit, unit_of_system
from coview_stream.errors import CloudError, ConfigError, MapError, warn
from coview_stream.geometry.arrays import Reals
from coview_stream.geometry.validation import to_array

Given = str | os.PathLike[str] | npt.NDArray[Any]
"""A source from a caller: a file, a folder, a pattern, or an array (N, 3 or more)."""


@dataclass(frozen=True, eq=False)
class Source:
    """One source.

    Attributes:
        path: the file, or an array's name for messages.
        rows: (N, 3) float32 or float64 coordinates of an array, in ``unit``; None for a file.
        crs: reference system, in metres, of an array or of a file that states none.
        unit: unit of the coordinates that ``crs`` is for; None is the metre.
    """

    path: Path
    rows: Reals | None = None
    crs: str | None = None
    unit: SurveyUnit | None = None

    def head(self) -> CloudHead:
        """Read the file's head without the points; CloudError if it cannot be used."""
        head = CloudHead(self.path) if self.rows is not None else read_head(self.path)
        if self.crs is None or head.crs is not None or head.unit is not None:
            return head
        if self.unit is None or head.low is None or head.high is None:
            return replace(head, crs=self.crs, unit=self.unit)
        low, high = self.unit.to_metres(head.low), self.unit.to_metres(head.high)
        return replace(head, crs=self.crs, unit=self.unit, low=low, high=high)

    def unit_to_convert(self) -> SurveyUnit | None:
        """Return the unit from which points have to be converted; readers convert a unit that the file states.

        CloudError for an E57 file, which is in metres by its standard.
        """
        if self.unit is None or self.head().unit is not self.unit:
            return None
        if self.path.suffix.lower() == ".e57":
            raise CloudError(f"{self.path}: E57 is in metres, not in {self.unit.name}; give a crs of metres")
        return self.unit

    def read(self) -> Cloud:
        """Return the points; CloudError if there are none, or if their reference system allows no map."""
        unit = self.unit_to_convert()
        if self.rows is None:
            cloud = read_cloud(self.path)
            if unit is not None:
                points = unit.to_metres(cloud.points).astype(np.float32)
                return replace(cloud, points=points, origin=unit.to_metres(cloud.origin), crs=self.crs)
        else:
            builder = CloudBuilder()
            builder.add(self.rows if unit is None else unit.to_metres(self.rows))
            cloud = builder.finish(str(self.path))
        if self.crs is None or cloud.crs is not None:
            return cloud
        if unchecked_system(self.crs):
            warn(f"{self.path}: the unit of {self.crs} is not known without pyproj: is it metres?")
        low, high = cloud.points.min(axis=0) + cloud.origin, cloud.points.max(axis=0) + cloud.origin
        if (flaw := flaw_of_system(self.crs, {}, low, high)) is not None:
            raise CloudError(f"{self.path}: {flaw}")
        return replace(cloud, crs=self.crs)

    def sha256(self) -> str:
        """Return the hash of the file, or of the array's numbers row by row."""
        if self.rows is not None:
            return hashlib.sha256(np.ascontiguousarray(self.rows).data).hexdigest()
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()


def sources_of(given: Given | Sequence[Given], crs: str | None = None) -> list[Source]:
    """Return the sources for files, folders, patterns and arrays (N, 3 or more); ``crs`` is for those without one.

    Raises:
        MapError: there is no source, or a file is named twice. CloudError: an array, folder or pattern has no cloud.
        ConfigError: ``crs`` is not text, or no system in metres.
    """
    if not isinstance(crs, str | None):
        raise ConfigError(f"crs is {crs!r}; give text such as 'EPSG:28992', or WKT")
    unit = unit_of_system(crs)
    crs = crs if unit is None else unit.crs
    if unit is None and crs is not None and (flaw := flaw_of_name(crs)) is not None:
        raise ConfigError(f"crs {crs[:60]!r} {flaw}")
    if given is None or isinstance(given, bytes | int | float):
        raise CloudError(f"sources is a {type(given).__name__}; give cloud files, or an array (N, 3) of metres")
    several = [given] if isinstance(given, str | os.PathLike) or hasattr(given, "__array__") else list(given)
    if not several:
        raise MapError("no source clouds given; name at least one las, laz, ply, pcd, npy or bin file")
    arrays = sum(not isinstance(item, str | os.PathLike) for item in several)
    sources: list[Source] = []
    for number, item in enumerate(several, 1):
        if isinstance(item, str | os.PathLike):
            sources += [Source(path, None, crs, unit) for path in expand_cloud_paths([item])]
        else:
            name = "array" if arrays == 1 else f"array {number}"
            array = np.asarray(item) if hasattr(item, "__array__") else None  # pandas frames and tensors have it too
            if array is None or array.ndim != 2 or array.shape[1] < 3:
                flaw = f"is a {type(item).__name__}" if array is None else f"has shape {array.shape}"
                raise CloudError(f"{name} {flaw}; give a cloud file, or an array (N, 3) of metres")
            kind: Any = np.float32 if array.dtype == np.float32 else np.float64
            sources.append(Source(Path(name), to_array(array[:, :3], kind, name), crs, unit))
    places = [source.path.resolve() for source in sources if source.rows is None]
    for place in places:
        if places.count(place) > 1:
            path = next(source.path for source in sources if source.path.resolve() == place)
            raise MapError(f"{path}: given twice; name every source once")
    return sources


def warn_of_other_systems(sources: Sequence[Source], heads: Sequence[CloudHead]) -> None:
    """Warn of converted coordinates, and of files whose own reference system overrides the given one."""
    converted = [(head.path, head.unit.name) for head in heads if head.unit is not None]
    if converted:
        more = f" and {len(converted) - 1} more" if len(converted) > 1 else ""
        warn(f"{converted[0][0]}{more}: in {converted[0][1]}; the map and its poses are in metres")
    others = [h for s, h in zip(sources, heads, strict=True) if s.crs is not None and not same_system(s.crs, h.crs)]
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        warn(
            f"{others[0].path}{more}: in {short_name(others[0].crs)}, as the file states; the given system "
            f"{short_name(sources[0].crs)} is for files that state none, and ignored"
        )


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return the file names of paths, but whole paths for files with the same name."""
    names = [path.name for path in paths]
    return [path.name if names.count(path.name) == 1 else str(path) for path in paths]
