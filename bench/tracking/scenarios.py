"""What ``python -m bench tracking`` measures: which worlds are driven through, and what befalls the robot there.

Seeds 5001 to 5010 are for reporting only: nobody tunes on them. Calibrate on others: ``worlds(5100)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from bench.tracking.drives import (
    CLOTH,
    DUST,
    PERIOD,
    Drive,
    carried,
    covered,
    jumped,
    kidnapped,
    over_the_gap,
    restarted,
    scaled,
    start,
)
from bench.tracking.worlds import World
from coview_stream.geometry.arrays import Floats

SEEDS = 5000  # what reported seeds follow; this one itself, of ``--quick``, is in nobody's table
_EVENT_AT = 90.0  # metres
_USUAL_DRIFT = 0.01
_COVERED_S = 30.0


@dataclass(frozen=True)
class Scenario:
    """A drive through a world, on one of its maps; ``drift`` of its odometry before anything else befalls it."""

    name: str
    world: World
    change: Callable[[Drive], Drive]
    drift: float = _USUAL_DRIFT
    variant: str = "plain"

    @property
    def plain(self) -> bool:
        """Whether nothing happens."""
        return self.name.startswith("plain/")

    def drive(self, truth: Floats) -> Drive:
        """Make it of the recorded truth (N, 4, 4)."""
        return self.change(start(truth, self.drift, self.world.seed))


def _whole(drive: Drive) -> Drive:
    return drive


def _some(drive: Drive, metres: float) -> Drive:
    return drive.until(metres)


def _kidnap(drive: Drive, to: float = 250.0, until: float = 370.0) -> Drive:
    drive = drive.until(until)
    return kidnapped(drive, drive.at(_EVENT_AT), drive.at(to))


def _carry(drive: Drive) -> Drive:
    drive = drive.until(_EVENT_AT + 160.0)
    return carried(drive, drive.at(_EVENT_AT), drive.at(_EVENT_AT + 40.0))


def _cover(drive: Drive, cover: int) -> Drive:
    begin = drive.at(_EVENT_AT)
    end = min(begin + round(_COVERED_S / PERIOD), len(drive) - 1)
    return covered(drive, begin, end, cover).until(float(drive.driven[end]) + 100.0)


def _jump(drive: Drive) -> Drive:
    drive = drive.until(_EVENT_AT + 120.0)
    return jumped(drive, drive.at(_EVENT_AT), (3.0, 1.0), 15.0)


def _restart(drive: Drive) -> Drive:
    drive = drive.until(_EVENT_AT + 120.0)
    return restarted(drive, drive.at(_EVENT_AT))


def _scale(drive: Drive) -> Drive:
    return scaled(drive.until(300.0), 1.05)


def _gap(drive: Drive) -> Drive:
    return over_the_gap(drive).until(340.0)


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
    """All that ``python -m bench tracking`` measures, in the worlds of the seeds that follow ``seeds``."""
    every = worlds(seeds)
    town, campus, forest = every[0], every[5], every[7]
    return (
        *(Scenario(f"plain/{w.kind}-{w.sensor}-{w.seed}", w, _whole, w.drift) for w in every),
        Scenario("kidnap/town", town, _kidnap),
        Scenario("kidnap/campus", campus, _kidnap),
        Scenario("kidnap/forest", forest, _kidnap),
        Scenario("carried/town", town, _carry),
        Scenario("gap/town", town, _gap, variant="gap"),
        Scenario("gap/campus", campus, _gap, variant="gap"),
        Scenario("covered/campus", campus, partial(_cover, cover=CLOTH)),
        Scenario("covered/forest", forest, partial(_cover, cover=CLOTH)),
        Scenario("dust/town", town, partial(_cover, cover=DUST)),
        Scenario("changed/town", town, partial(_some, metres=300.0), variant="changed"),
        Scenario("changed/campus", campus, partial(_some, metres=300.0), variant="changed"),
        Scenario("changed/forest", forest, partial(_some, metres=300.0), variant="changed"),
        Scenario("jump/town", town, _jump),
        Scenario("jump/forest", forest, _jump),
        Scenario("reset/campus", campus, _restart),
        Scenario("scale/town", town, _scale, drift=0.005),
        Scenario("scale/forest", forest, _scale, drift=0.005),
    )


_EASY = World("town", "vlp16", SEEDS, 160.0, 120.0, 2.0, 0.02)

QUICK = (
    Scenario("plain/quick", _EASY, _whole, _EASY.drift),
    Scenario("kidnap/quick", _EASY, partial(_kidnap, to=115.0, until=120.0)),
)
"""A smoke test: one small town, two minutes of driving; says little about the targets."""
