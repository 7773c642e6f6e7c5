"""Parts of a joined map: which map a place is on, and poses from the joined frame to that map's own, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coview_stream.errors import InputError, MapError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose

_MAX_PARTS = 1000
_MAX_NAME = 64
_MAX_METRES = 1e8


@dataclass(frozen=True)
class MapPart:
    """One of the maps.

    Attributes:
        name: of it.
        sha256: of the map that it was.
        crs: reference system of its own frame, None if it is not known.
        shift: (3,) metres; what is added to coordinates in its own frame for those in the joined one.
        begin, end: it reaches over these x in the joined frame, half of the gaps to its neighbours included.
    """

    name: str
    sha256: str
    crs: str | None
    shift: tuple[float, float, float]
    begin: float
    end: float

    def own(self, T: Pose) -> Pose:
        """Return a pose (4, 4) in the joined frame in this map's own."""
        return _shifted(T, -np.array(self.shift))

    def joined(self, T: Pose) -> Pose:
        """Return a pose (4, 4) in this map's own frame in the joined one."""
        return _shifted(T, np.array(self.shift))


class MapParts(Sequence[MapPart]):
    """The parts of a joined map, in the order of x."""

    def __init__(self, parts: Sequence[MapPart]) -> None:
        self._parts = tuple(sorted(parts, key=lambda part: part.begin))
        self._begins = np.array([part.begin for part in self._parts])

    @classmethod
    def of(cls, parameters: Mapping[str, Any]) -> MapParts | None:
        """Return the parts that a map's parameters name; None of a map that was not joined.

        Raises:
            MapError: they cannot be read.
        """
        told = parameters.get("parts")
        if told is None:
            return None
        try:
            parts = [_part(each) for each in told]
            if not 0 < len(parts) <= _MAX_PARTS or len({part.name for part in parts}) < len(parts):
                raise ValueError("none, too many, or two of one name")
        except (TypeError, KeyError, ValueError) as error:
            raise MapError(f"the map's parts cannot be read ({str(error)[:80]}); join the maps again") from error
        return cls(parts)

    def __getitem__(self, index: Any) -> Any:
        """Return a part by its number."""
        return self._parts[index]

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._parts)

    def at(self, position: Floats) -> MapPart:
        """Return the part that a place (3,) in the joined frame is on."""
        found = int(np.searchsorted(self._begins, position[0], side="right")) - 1
        return self._parts[max(found, 0)]

    def named(self, name: str | None) -> MapPart:
        """Return a part by its name.

        Raises:
            InputError: there is none; those that there are, are named.
        """
        for part in self._parts:
            if part.name == name:
                return part
        known = ", ".join(part.name for part in self._parts)
        what = "no map is named" if name is None else f"no map is called {name[:_MAX_NAME]!r}"
        raise InputError(f"{what}: this node has {known}")

    def to_json(self) -> list[dict[str, Any]]:
        """Return them as a map's parameters hold them."""
        return [
            {"name": p.name, "sha256": p.sha256, "crs": p.crs, "shift": list(p.shift), "x": [p.begin, p.end]}
            for p in self._parts
        ]


def _part(told: Mapping[str, Any]) -> MapPart:
    numbers = [float(value) for value in (*told["shift"], *told["x"])]
    name, sha256, crs = told["name"], told["sha256"], told["crs"]
    if len(numbers) != 5 or not all(abs(value) <= _MAX_METRES for value in numbers):
        raise ValueError("shift or x are no lengths")
    if not (isinstance(name, str) and 0 < len(name) <= _MAX_NAME and name.isprintable()):
        raise ValueError("a name is none")
    if not isinstance(sha256, str) or not isinstance(crs, str | None):
        raise ValueError("sha256 or crs is no text")
    return MapPart(name, sha256, crs, (numbers[0], numbers[1], numbers[2]), numbers[3], numbers[4])


def _shifted(T: Pose, shift: Floats) -> Pose:
    out = np.array(T, dtype=np.float64)
    out[:3, 3] += shift
    return out
