"""Long drives in forests: the second paper's tables. Odometry, GNSS and odometry, the map alone, graph off, and ours.

400 m through 900 stems per hectare, 2 km through 450, and 400 m under a closed canopy; a tenth of the trees is gone
since the survey. NAME picks one; ``--plots`` draws all errors as boxes, and the tracks in their colour. Errors of a
variant are of all its poses, of ours from the first fix on. GNSS is simulated (:mod:`bench.forest.variants`).
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.accuracy.scores import Errors, Track, errors, losses, rms
from bench.forest.variants import VARIANTS
from bench.forest.worlds import say, weights
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, informs, listed
from bench.tracking.drives import start
from bench.tracking.worlds import World, map_of, open_world
from coview_stream import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.report.plots import ACCENT, STATE_COLOURS, TRUTH, draw_base_map, figure

WORLDS = (
    World("dense-forest", "vlp16", 6003, 300.0, 400.0, 2.0, 0.01),
    World("long-forest", "os64", 6002, 520.0, 2000.0, 4.0, 0.01),
    World("closed-forest", "vlp16", 6001, 300.0, 400.0, 2.0, 0.01),
)
_MADE_BY = ("bench/forest/variants.py", "bench/tracking/drives.py", "bench/tracking/worlds.py")
_EVERY = 2  # of the frames: five a second
_QUICK = 30.0  # metres of the first

_POINTS, _BESIDE = 8_000, 25.0  # of a map behind a track, and metres of it that are shown beside
_FARTHEST = 98  # percentile of the errors at which the colours end
_LOWEST = 1e-3  # metres or degrees: the boxes' axis begins there

Stats = dict[str, float | None]

THEIRS: tuple[tuple[str, Stats, Stats], ...] = (
    ("GNSS and odometry", {"rmse": 2.96, "max": 8.15}, {"rmse": 5.44}),
    (
        "theirs",
        {"rmse": 0.23, "median": 0.14, "mean": 0.18, "std": 0.15, "max": 0.83},
        {"rmse": 1.16, "median": 0.65, "mean": 0.88, "max": 6.32},
    ),
)
"""Their Table I, Forest II, 2 km: metres and degrees. Another forest, another robot; real."""

_KEYS = ("rmse", "median", "mean", "std", "max")


def statistics(values: Floats) -> Stats:
    """Root mean square, median, mean, standard deviation and greatest of the finite values (N,); None of nothing."""
    known = values[np.isfinite(values)]
    if not len(known):
        return dict.fromkeys(_KEYS)
    numbers = (rms(known), np.median(known), known.mean(), known.std(), known.max())
    return {key: float(number or 0.0) for key, number in zip(_KEYS, numbers, strict=True)}


class Result(NamedTuple):
    """A variant's answers on a drive."""

    track: Track
    truth: Floats
    driven: Floats

    def figures(self) -> dict[str, Any]:
        """Return its line of the table."""
        error, known = errors(self.track, self.truth), self.track.tracking
        first = int(known.argmax()) if known.any() else None
        figures = {f"{key}_m": value for key, value in statistics(error.metres).items()}
        figures |= {f"{key}_deg": value for key, value in statistics(error.degrees).items()}
        return figures | {
            "posed": 100.0 * float(known.mean()),
            "first_m": None if first is None else float(self.driven[first]),
            "false": int((known & ~error.right).sum()),
            "lost": losses(self.track.states),
        }


def followed(world: World, name: str) -> Result:
    """Return a variant's answers in a world; kept until the code changes."""
    recorded, site = open_world(folder(), world), map_of(folder(), world)
    drive = start(recorded.truth, world.drift, world.seed)
    drive = replace(drive.picked(drive.frames[::_EVERY]), stamps=drive.stamps[::_EVERY])
    file = folder() / "forest-drives" / world.name / f"{name.replace(' ', '-')}.npz"
    spec = {"code": fingerprint(), "bench": fingerprint(*_MADE_BY), "world": repr(world), "weights": weights()}

    def work() -> None:
        begin = time.perf_counter()
        track = VARIANTS[name](site, recorded, drive, LocalizerConfig())
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, poses=track.poses, states=np.array(track.states))
        say(f"{world.name}, {name}: {time.perf_counter() - begin:.0f} s")

    remembered(file.with_suffix(".json"), spec, work)
    with np.load(file) as kept:
        track = replace(Track.of_poses(drive.stamps, kept["poses"]), states=kept["states"].tolist())
    return Result(track, drive.truth, drive.driven)


def draw_errors(drives: Mapping[str, Mapping[str, Errors]], path: Path) -> None:
    """Draw a row of two panels for each drive, metres and degrees: a box per variant, whiskers at 1 and 99 %."""
    options = {"figsize": (9.0, 0.6 + 2.4 * len(drives)), "nrows": len(drives), "ncols": 2}
    options["axes"] = {"squeeze": False, "sharey": "row", "sharex": "col"}
    with figure(path, **options) as (_, panels):
        for line, (drive, variants) in zip(panels, drives.items(), strict=True):
            colours = [STATE_COLOURS["TRACKING"], ACCENT]
            for axes, unit, part, colour in zip(line, ("m", "deg"), ("metres", "degrees"), colours, strict=True):
                every = [getattr(error, part) for error in variants.values()]
                values = [np.maximum(each[np.isfinite(each)], _LOWEST) for each in every]
                boxes = axes.boxplot(values, orientation="horizontal", whis=(1, 99), showfliers=False, widths=0.6,
                                     tick_labels=list(variants), patch_artist=True)  # fmt: skip
                for box in boxes["boxes"]:
                    box.set(facecolor=colour, alpha=0.5)
                for median in boxes["medians"]:
                    median.set(color=TRUTH)
                for place, some in enumerate(values, start=1):
                    if not len(some):
                        axes.text(0.02, place, "no pose", transform=axes.get_yaxis_transform(), va="center")
                axes.set_xscale("log")
                axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
                axes.set_xlabel(f"error [{unit}]")
            line[0].invert_yaxis()
            line[0].set_title(drive)


def draw_tracks(drives: Mapping[str, tuple[BaseMap, Floats, Errors]], path: Path) -> None:
    """Draw the true track (N, 4, 4) of each drive over its map, in the colour of the error in metres."""
    options = {"figsize": (4.4 * len(drives), 3.7), "ncols": len(drives), "axes": {"squeeze": False}}
    with figure(path, **options) as (drawing, panels):
        for axes, (drive, (site, truth, error)) in zip(panels[0], drives.items(), strict=True):
            low, high = truth[:, :2, 3].min(axis=0) - _BESIDE, truth[:, :2, 3].max(axis=0) + _BESIDE
            points = site.sampled_points(10 * _POINTS) + site.origin
            points = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
            shift = draw_base_map(axes, points[:: len(points) // _POINTS + 1])
            at, known = truth[:, :3, 3] - shift, np.isfinite(error.metres)
            axes.plot(at[:, 0], at[:, 1], color=TRUTH, linewidth=0.7)
            most = float(np.percentile(error.metres[known], _FARTHEST))
            dots = axes.scatter(at[known, 0], at[known, 1], s=5, c=error.metres[known], cmap="plasma", vmin=0.0,
                                vmax=most, linewidths=0, zorder=3)  # fmt: skip
            drawing.colorbar(dots, ax=axes, shrink=0.8, label="error [m]", extend="max")
            axes.set_title(drive)


def options(parser: ArgumentParser) -> None:
    """Add the drives, the variants and the pictures."""
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(w.kind for w in WORLDS)} (all)")
    names = list(VARIANTS)
    parser.add_argument(
        "--variants", nargs="+", default=names, choices=names, metavar="V", help=f"some of {', '.join(names)}"
    )
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw forest_errors.png and forest_tracks.png there")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per drive and variant."""
    known = [world.kind for world in WORLDS]
    if unknown := set(asked.names) - set(known):
        raise InputError(f"no drive {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    chosen = set(asked.names or known)
    worlds = [world for world in WORLDS if world.kind in chosen]
    if asked.quick:
        worlds = [worlds[0]._replace(length=_QUICK, size=200.0, seed=6000)]
    results: dict[str, dict[str, Result]] = {}
    for world in worlds:
        found = results.setdefault(world.kind, {})
        for name in asked.variants:
            found[name] = followed(world, name)
            figures = {"drive": world.kind, "variant": name, **found[name].figures()}
            rmse = figures["rmse_m"]
            yield informs(f"forest_drives/{world.kind}, {name}: rmse", np.nan if rmse is None else rmse, "m", figures)
    if asked.plots and results:
        asked.plots.mkdir(parents=True, exist_ok=True)
        draw_errors({kind: {n: errors(r.track, r.truth) for n, r in some.items()} for kind, some in results.items()},
                    asked.plots / "forest_errors.png")  # fmt: skip
        tracks = {
            world.kind: (BaseMap.load(map_of(folder(), world)), found["ours"].truth, errors(*found["ours"][:2]))
            for world in worlds
            if "ours" in (found := results[world.kind]) and found["ours"].track.tracking.any()
        }
        if tracks:
            draw_tracks(tracks, asked.plots / "forest_tracks.png")


COLUMNS = (
    ("drive", "drive", None), ("variant", "variant", None), ("posed %", "posed", 1), ("first m", "first_m", 1),
    *((f"{key} m", f"{key}_m", 3) for key in _KEYS), *((f"{key} deg", f"{key}_deg", 2) for key in _KEYS),
    ("> 1 m or 5 deg", "false", 0), ("lost", "lost", 0),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Errors of all variants beside the paper's own."""
    drives = [row.details for row in rows]
    return {"": listed(COLUMNS, [*drives, *(_theirs(*each) for each in THEIRS)])}


def _theirs(name: str, metres: Stats, degrees: Stats) -> dict[str, Any]:
    figures = dict.fromkeys(key for _, key, _ in COLUMNS)
    figures |= {f"{key}_m": value for key, value in metres.items()}
    figures |= {f"{key}_deg": value for key, value in degrees.items()}
    return figures | {"drive": "their Forest II, real", "variant": name}
