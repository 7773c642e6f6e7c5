"""Parts of a joined map, and poses between the joined frame and a part's own frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coview_stream.errors import InputError, MapError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose

_MAX_PARTS = 1000
_MAX_NAME = 64  # letters
_MAX_METRES = 1e8  # metres: no place on this planet


@dataclass(frozen=True)
class MapPart:
    """One map of a joined map.

    Attributes:
        name: name of the map.
        sha256: hash of the map.
        crs: reference system of its own frame, None if unknown.
        shift: (3,) metres; a position in the joined frame is the one in its own frame plus this.
        begin, end: its range of x in the joined frame, metres, including half of the gaps to its neighbours.
    """

    name: str
    sha256: str
    crs: str | None
    shift: tuple[float, float, float]
    begin: float
    end: float

    def own(self, T: Pose) -> Pose:
        """Transform a pose (4, 4) from the joined frame to this map's own."""
        out = np.array(T, dtype=np.float64)
        out[:3, 3] -= self.shift
        return out

    def joined(self, T: Pose) -> Pose:
        """Transform a pose (4, 4) from this map's own frame to the joined frame."""
        out = np.array(T, dtype=np.float64)
        out[:3, 3] += self.shift
        return out


class MapParts(Sequence[MapPart]):
    """The parts of a joined map, in the order of x."""

    def __init__(self, parts: Sequence[MapPart]) -> None:
        self._parts = tuple(sorted(parts, key=lambda part: part.begin))
        self._begins = np.array([part.begin for part in self._parts])

    @classmethod
    def of(cls, parameters: Mapping[str, Any]) -> MapParts | None:
        """Return the parts in a map's parameters, None for a map that was not joined; MapError if they are invalid."""
        rows = parameters.get("parts")
        if rows is None:
            return None
        try:
            parts = [_part(row) for row in rows]
            if not 0 < len(parts) <= _MAX_PARTS or len({part.name for part in parts}) < len(parts):
                raise ValueError("none, too many, or two of one name")
        except (TypeError, KeyError, ValueError) as error:
            raise MapError(f"the map's parts cannot be read ({str(error)[:80]}); join the maps again") from error
        return cls(parts)

    def __getitem__(self, index: Any) -> Any:
        """Return a part by its number."""
        return self._parts[index]

    def __len__(self) -> int:
        """Return the number of parts."""
        return len(self._parts)

    def at(self, position: Floats) -> MapPart:
        """Return the part at a position (3,) in the joined frame."""
        number = int(np.searchsorted(self._begins, position[0], side="right")) - 1
        return self._parts[max(number, 0)]

    def named(self, name: str | None) -> MapPart:
        """Return a part by its name; InputError, which lists the parts, if there is none."""
        for part in self._parts:
            if part.name == name:
                return part
        known = ", ".join(part.name for part in self._parts)
        missing = "no map is named" if name is None else f"no map is called {name[:_MAX_NAME]!r}"
        raise InputError(f"{missing}: this node has {known}")

    def to_json(self) -> list[dict[str, Any]]:
        """Return the parts as plain data for a map's parameters."""
        return [
            {"name": p.name, "sha256": p.sha256, "crs": p.crs, "shift": list(p.shift), "x": [p.begin, p.end]}
            for p in self._parts
        ]


def _part(row: Mapping[str, Any]) -> MapPart:
    numbers = [float(value) for value in (*row["shift"], *row["x"])]
    name, sha256, crs = row["name"], row["sha256"], row["crs"]
    if len(numbers) != 5 or not all(abs(value) <= _MAX_METRES for value in numbers):
        raise ValueError("shift or x are not lengths")
    if not (isinstance(name, str) and 0 < len(name) <= _MAX_NAME and name.isprintable()):
        raise ValueError("a name is empty, too long or not printable")
    if not isinstance(sha256, str) or not isinstance(crs, str | None):
        raise ValueError("sha256 or crs is not text")
    return MapPart(name, sha256, crs, (numbers[0], numbers[1], numbers[2]), numbers[3], numbers[4])
