"""Worlds and events of ``python -m bench tracking``.

Seeds 5001 to 5010 are for reporting only: nothing is tuned on them. Calibrate on others: ``worlds(5100)``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from bench.tracking import drives
from bench.tracking.drives import CLOTH, DUST, Drive, covered
from bench.tracking.worlds import World
from coview_stream.geometry.arrays import Floats

SEEDS = 5000  # what reported seeds follow; this one itself, of ``--quick``, is in no table
_WHOLE = partial(Drive.until, metres=float("inf"))
_FIRST_300 = partial(Drive.until, metres=300.0)


class Scenario(NamedTuple):
    """A drive through a world, on one of its maps; ``drift`` of its odometry before anything else befalls it."""

    name: str
    world: World
    change: Callable[[Drive], Drive]
    drift: float
    variant: str = "plain"

    @property
    def plain(self) -> bool:
        """Whether nothing happens."""
        return self.name.startswith("plain/")

    def drive(self, truth: Floats) -> Drive:
        """Make it of the recorded truth (N, 4, 4)."""
        return self.change(drives.start(truth, self.drift, self.world.seed))


_EVENTS: dict[str, tuple[Callable[[Drive], Drive], tuple[str, ...], float, str]] = {
    "kidnap": (drives.kidnapped, ("town", "campus", "forest"), 0.01, "plain"),
    "carried": (drives.carried, ("town",), 0.01, "plain"),
    "gap": (drives.over_the_gap, ("town", "campus"), 0.01, "gap"),
    "covered": (partial(covered, cover=CLOTH), ("campus", "forest"), 0.01, "plain"),
    "dust": (partial(covered, cover=DUST), ("town",), 0.01, "plain"),
    "changed": (_FIRST_300, ("town", "campus", "forest"), 0.01, "changed"),
    "jump": (drives.jumped, ("town", "forest"), 0.01, "plain"),
    "slip": (drives.slipped, ("town", "campus", "forest"), 0.01, "plain"),
    "slip, changed": (drives.slipped, ("town", "campus", "forest"), 0.01, "changed"),
    "reset": (drives.restarted, ("campus",), 0.01, "plain"),
    "scale": (drives.scaled, ("town", "forest"), 0.005, "plain"),
}
"""Event, places, drift of odometry, map."""


def worlds(seeds: int = SEEDS) -> tuple[World, ...]:
    """Ten worlds of the seeds that follow ``seeds``: kind, lidar, seed, metres wide, metres driven, m/s, drift."""
    return (
        World("town", "vlp16", seeds + 1, 240.0, 400.0, 2.0, 0.005),
        World("town", "os64", seeds + 2, 300.0, 600.0, 3.0, 0.02),
        World("town", "mid360", seeds + 3, 240.0, 300.0, 2.0, 0.03),
        World("town", "os64", seeds + 4, 240.0, 300.0, 1.5, 0.05),
        World("campus", "vlp16", seeds + 5, 300.0, 400.0, 2.0, 0.01),
        World("campus", "os64", seeds + 6, 300.0, 500.0, 2.5, 0.03),
        World("campus", "mid360", seeds + 7, 240.0, 300.0, 2.0, 0.05),
        World("sparse-forest", "os64", seeds + 8, 240.0, 400.0, 2.0, 0.01),
        World("sparse-forest", "vlp16", seeds + 9, 240.0, 300.0, 2.0, 0.02),
        World("sparse-forest", "os64", seeds + 10, 300.0, 300.0, 2.0, 0.05),
    )


def scenarios(seeds: int = SEEDS) -> tuple[Scenario, ...]:
    """Plain drives through all worlds of the seeds that follow ``seeds``, and all events."""
    every = worlds(seeds)
    where = {"town": every[0], "campus": every[5], "forest": every[7]}
    return (
        *(Scenario(f"plain/{w.kind}-{w.sensor}-{w.seed}", w, _WHOLE, w.drift) for w in every),
        *(
            Scenario(f"{event}/{place}", where[place], change, drift, variant)
            for event, (change, places, drift, variant) in _EVENTS.items()
            for place in places
        ),
    )


_EASY = World("town", "vlp16", SEEDS, 160.0, 120.0, 2.0, 0.02)

QUICK = (
    Scenario("plain/quick", _EASY, _WHOLE, _EASY.drift),
    Scenario("kidnap/quick", _EASY, partial(drives.kidnapped, to=115.0, until=120.0), 0.01),
)
"""A smoke test: one small town, two minutes of driving; says little about the targets."""
