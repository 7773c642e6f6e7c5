"""Sites that the robots of a soak drive on: a town to be tracked in, and ones in which most places look alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from bench.harness import worlds
from bench.harness.files import fingerprint, remembered
from bench.integrity.kinds import built, draw, size_of, surveyed
from bench.integrity.run import through
from bench.integrity.work import SITE_CODE
from coview_stream.clouds import write_cloud, write_tum
from coview_stream.sim import SimulationConfig

_LENGTH = 60.0  # metres of a deceptive drive
_SENSOR = "vlp16"


class Site(NamedTuple):
    """A world on disk (``run/``, ``truth.tum``) and its map; on a deceptive one, no pose is right."""

    name: str
    world: Path
    map: Path
    deceptive: bool


KINDS = ("town", "boxes", "yard")
"""In which the robots are, in turns; ``yard``: all its containers were moved since the survey."""


def prepare(below: Path, kind: str, seed: int, quick: bool) -> Site:
    """Return a site; simulate it and build its map unless that is done."""
    if kind == "town":
        full = SimulationConfig(seed=seed, size=220.0, length=80.0)
        config = replace(full, size=140.0, length=30.0, density=10.0) if quick else full
        world = worlds.prepare(below, config)
        return Site(kind, world, worlds.map_of(below, config), deceptive=False)
    world = below / f"soak-{kind}-{seed}"
    spec = {
        "site": [kind, seed, _LENGTH, _SENSOR],
        "code": fingerprint(*SITE_CODE, "bench/integrity", "bench/soak/sites.py"),
    }
    remembered(world / "made.json", spec, lambda: _make(world, kind, seed))
    return Site(kind, world, world / "site.coview", deceptive=True)


def _make(world: Path, kind: str, seed: int) -> None:
    size = size_of(kind)
    (world / "run" / "frames").mkdir(parents=True, exist_ok=True)
    built(surveyed(draw(kind, seed, size, 0.0), seed)).save(world / "site.coview")
    drive = through(draw(kind, seed, size, 1.0 if kind == "yard" else 0.0), _SENSOR, seed, _LENGTH)
    for k in range(len(drive)):
        write_cloud(world / "run" / "frames" / f"{k:06d}.pcd", drive.frame(k))
    write_tum(world / "run" / "odometry.tum", drive.stamps, drive.odometry)
    write_tum(world / "truth.tum", drive.stamps, drive.poses)
