"""What a peer has to do: prepare for a map, then answer where a submap lies, or that it does not know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from bench.harness.places import Place
from coview_stream import BaseMap
from coview_stream.geometry import Pose


@dataclass(frozen=True)
class Answer:
    """A pose (4, 4) map <- submap, or None; whether the method itself vouches for it, and its own score."""

    T_map_submap: Pose | None
    vouched: bool
    score: float = 0.0


class Method(Protocol):
    """One way to localize; made for one map, asked many times."""

    def answer(self, place: Place) -> Answer:
        """Say where the submap lies."""


@dataclass(frozen=True)
class Peer:
    """A method with its name, what it needs, and how it is made.

    Attributes:
        name: in tables and rows.
        make: prepares a method for a map.
        package: what has to be installed, as pip names it; empty for what comes with coview_stream.
        module: that it imports as.
        tracking: it starts from a pose nearby (0.5 m and 3 degrees off) instead of nowhere.
    """

    name: str
    make: Callable[[BaseMap], Method]
    package: str = ""
    module: str = ""
    tracking: bool = False
