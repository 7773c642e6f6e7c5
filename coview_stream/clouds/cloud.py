"""Point clouds in float32 near their own float64 origins, joined without loss of precision."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.reference_system import same_system, short_name
from coview_stream.errors import CloudError, CoViewWarning
from coview_stream.geometry.arrays import Floats, Reals
from coview_stream.geometry.transforms import Points
from coview_stream.geometry.validation import MAX_COORDINATE

LOCAL_LIMIT = 10_000.0
"""Metres: smaller coordinates keep a zero origin, because float32 still resolves 1 mm."""
_ORIGIN_STEP = 100.0  # metres: origins are multiples of this, so that offsets between tiles are exact

_COARSE_FLOAT32 = 1e6  # metres: beyond, float32 is coarser than 6 cm


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points relative to a float64 origin.

    Attributes:
        points: (N, 3) float32 metres, ``raw - origin``, subtracted in float64.
        origin: (3,) float64 metres. Zero if its first points lie within ``LOCAL_LIMIT`` of its frame's zero, otherwise
            their median, rounded to 100 m.
        crs: coordinate reference system as stated in the file (WKT or ``EPSG:code``), else None.
        classification: (N,) uint8 LAS classes, if the format has them.
        dropped: number of rows left out: not finite, beyond ``MAX_COORDINATE``, withheld or labelled as noise.
    """

    points: Points
    origin: Floats
    crs: str | None = None
    classification: npt.NDArray[np.uint8] | None = None
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        """Return size, origin and reference system in one line."""
        return f"Cloud({len(self):,} points, origin {self.origin.tolist()}, crs {short_name(self.crs)})"

    def map_points(self) -> Floats:
        """Return (N, 3) float64 coordinates in the file's own frame, metres."""
        return self.points.astype(np.float64) + self.origin


@dataclass
class CloudBuilder:
    """Builder of a :class:`Cloud` from chunks of raw coordinates; the first usable chunk decides the origin."""

    crs: str | None = None
    origin: Floats | None = None
    dropped: int = 0
    _points: list[Points] = field(default_factory=list)
    _classes: list[npt.NDArray[np.uint8]] = field(default_factory=list)

    def add(self, raw: Reals, classification: npt.NDArray[np.uint8] | None = None, dropped: int = 0) -> None:
        """Append (N, 3) raw coordinates in metres; ``dropped`` counts rows that the reader left out."""
        with np.errstate(invalid="ignore"):
            usable = (np.abs(raw) < MAX_COORDINATE).all(axis=1)  # false for NaN as well
        self.dropped += dropped + int(len(raw) - usable.sum())
        if not usable.all():
            raw = raw[usable]
            classification = None if classification is None else classification[usable]
        if not len(raw):
            return
        if self.origin is None:
            self.origin = np.zeros(3)
            if np.abs(raw).max() >= LOCAL_LIMIT:
                # the median, not the bounding box: one stray point must not move the origin
                middle = np.median(raw[:: max(1, len(raw) // 10_000)].astype(np.float64), axis=0)
                self.origin = np.round(middle / _ORIGIN_STEP) * _ORIGIN_STEP + 0.0  # + 0.0 turns -0.0 into 0.0
            if raw.dtype == np.float32 and np.abs(self.origin).max() > _COARSE_FLOAT32:
                warnings.warn(
                    f"float32 coordinates near {self.origin.tolist()} are rounded to 6 cm or worse in the "
                    "file itself; export them as float64 or LAS",
                    CoViewWarning,
                    stacklevel=2,
                )
        if self.origin.any():
            raw = raw.astype(np.float64) - self.origin
        self._points.append(np.ascontiguousarray(raw, dtype=np.float32))
        if classification is not None:
            self._classes.append(classification)

    def finish(self, name: str) -> Cloud:
        """Return the cloud of all chunks; CloudError, with the file's ``name``, if no usable point was added."""
        if self.origin is None:
            if self.dropped:
                raise CloudError(
                    f"{name}: none of the {self.dropped} points is usable (NaN, infinite, farther than "
                    f"{MAX_COORDINATE / 1000:.0f} km from zero, withheld or noise); export the cloud again, in metres"
                )
            raise CloudError(f"{name}: holds zero points; export the cloud again")
        points = self._points[0] if len(self._points) == 1 else np.concatenate(self._points)
        classes = np.concatenate(self._classes) if self._classes else None
        return Cloud(points, self.origin, self.crs, classes, self.dropped)


def merge(clouds: Sequence[Cloud]) -> Cloud:
    """Join several clouds of the same frame, shifted in float64 to the origin of the first.

    Classes are kept only if every cloud has them; dropped rows are added up.

    Raises:
        CloudError: no cloud was given, or the clouds name different reference systems.
    """
    if not clouds:
        raise CloudError("no cloud to merge: give at least one file")
    systems = [cloud.crs for cloud in clouds if cloud.crs is not None]
    for system in systems[1:]:
        if not same_system(systems[0], system):
            names = " and ".join(sorted(map(short_name, (systems[0], system))))
            raise CloudError(f"clouds are in different reference systems ({names}); reproject them to one")
    if len(clouds) == 1:
        return clouds[0]
    origin = clouds[0].origin
    shifts = [cloud.origin - origin for cloud in clouds]
    points = [
        (cloud.points + shift).astype(np.float32) if shift.any() else cloud.points
        for cloud, shift in zip(clouds, shifts, strict=True)
    ]
    classes = [cloud.classification for cloud in clouds if cloud.classification is not None]
    return Cloud(
        np.concatenate(points),
        origin,
        max(systems, key=lambda text: "+" in text or "VERT" in text, default=None),  # prefer one that states heights
        np.concatenate(classes) if len(classes) == len(clouds) else None,
        sum(cloud.dropped for cloud in clouds),
    )
