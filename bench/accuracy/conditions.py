"""Real runs under the conditions of real robots, and on airborne-like maps of the same places.

Each set of ``--data`` (``base.laz``, ``run/``, ``truth.tum``; not part of the repository) is spoilt as the condition
says. ``coview-stream locate`` localizes it in a process of its own, on the map that ``coview-stream build`` makes of
``base.laz``. ``--densities`` adds maps as an aircraft might have seen the same place, without facades, made as
``coview-stream airborne`` does. ``--overlaps`` takes squares out of the map instead, until it holds no more than so
much of what the robot sees. A set that is not there is simulated: ``town-vlp16-4201`` is SCENE-SENSOR-SEED. ``--paper``
localizes the same runs by the first paper's method, too. Results stay in ``--work``.

A frame is false if its pose is more than 1 m or 5 degrees off; *share* is the share of frames with a pose, per cent of
the unspoilt run's. A condition is a name with its figures, ``pitch:2``; several joined by ``+`` follow one another;
``drift#2`` is another draw.

=============== ====================================================================================
base            the run as it is
pitch:DEG       clouds pitched, nose down, by DEG degrees, unknown to odometry (roll:DEG likewise)
odo:PCT:YAW     odometry made of the truth: PCT % too long, a yaw walk of YAW degrees per sqrt(m)
drift           odo:5:0.5 with either sign of the scale
beams16         16 of 64 rings of elevation
near30          only points within 30 m
sparse3         every third frame
back            the frames in reverse order
rev180          the body turned around its z axis by 180 degrees, in clouds, odometry and truth
=============== ====================================================================================
"""

from __future__ import annotations

import shutil
import time
import zlib
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bench.accuracy import paper
from bench.accuracy.scores import Track, errors, exposed, score
from bench.harness import worlds
from bench.harness.files import add_data, built, fingerprint, folder, remembered, trajectory
from bench.harness.rows import Row, informs, judged, listed, number
from coview_stream import BaseMap
from coview_stream.clouds import read_cloud, read_tum, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Indices
from coview_stream.geometry.transforms import Points, Poses, inverse, pose_from, transform
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import MAX_STAMP_GAP, driven
from coview_stream.sim import SENSORS, SimulationConfig
from coview_stream.sim.airborne import Survey, airborne_survey, surface_of

_RINGS, _KEPT = 64, 16  # of elevation


@dataclass(frozen=True)
class Variant:
    """A run under a condition."""

    frames: Indices  # (N,) of the original
    stamps: Floats  # (N,) seconds, increasing
    odometry: Poses  # (N, 4, 4) odometry <- body, metres
    truth: Poses  # (N, 4, 4) map <- body, of the same body
    changes: tuple[Callable[[Points], Points], ...] = ()  # of clouds (K, 3) in the body frame, metres, in this order

    def cloud(self, points: Points) -> Points:
        """Return a frame's cloud (K, 3), metres, after all changes."""
        for change in self.changes:
            points = change(points)
        return np.ascontiguousarray(points, dtype=np.float32)

    def changed(self, change: Callable[[Points], Points]) -> Variant:
        """Return the variant with one more change of the clouds."""
        return replace(self, changes=(*self.changes, change))

    def chosen(self, of: slice) -> Variant:
        """Return the variant with some of its frames, in that order."""
        odometry, truth = self.odometry[of], self.truth[of]
        return replace(self, frames=self.frames[of], stamps=self.stamps[of], odometry=odometry, truth=truth)


def spoilt(condition: str, run: Variant, seed: int) -> Variant:
    """Return the run under a condition; equal seeds give equal runs.

    Raises:
        InputError: no such condition, or wrong figures.
    """
    rng = np.random.default_rng(seed)
    for part in condition.split("#")[0].split("+"):
        name, *words = part.split(":")
        if name not in _CONDITIONS:
            raise InputError(f"no condition {part!r}; there are {', '.join(_CONDITIONS)}")
        wanted, make = _CONDITIONS[name]
        try:
            figures = [float(word) for word in words]
        except ValueError as error:
            raise InputError(f"condition {part!r}: {error}") from error
        if len(figures) != wanted:
            raise InputError(f"condition {part!r}: has {len(figures)} figures, {wanted} are needed")
        run = make(run, rng, *figures)
    return run


def _leant(run: Variant, axis: str, degrees: float) -> Variant:
    R = Rotation.from_euler(axis, degrees, degrees=True).as_matrix().astype(np.float32)
    return run.changed(lambda points: points @ R.T)


def _odometry(run: Variant, rng: np.random.Generator, percent: float, walk: float) -> Variant:
    poses = [run.odometry[0]]
    for before, after in zip(run.truth[:-1], run.truth[1:], strict=True):
        step = inverse(before) @ after
        metres = float(np.linalg.norm(step[:3, 3]))
        turn = Rotation.from_euler("z", rng.normal(0.0, walk * np.sqrt(metres)), degrees=True).as_matrix()
        poses.append(poses[-1] @ pose_from(step[:3, :3] @ turn, step[:3, 3] * (1.0 + percent / 100.0)))
    return replace(run, odometry=np.array(poses))


def rings(points: Points) -> Points:
    """Keep 16 of 64 rings of elevation, evenly spread over the elevations of the points (K, 3)."""
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    low, high = np.percentile(elevation, [0.5, 99.5])  # single points above and below are no ring
    ring = np.clip((elevation - low) / max(high - low, 1e-9) * _RINGS, 0, _RINGS - 1).astype(int)
    return points[np.isin(ring, np.round(np.linspace(0, _RINGS - 1, _KEPT)).astype(int))]


def _back(run: Variant, rng: np.random.Generator) -> Variant:
    return replace(run, stamps=run.stamps[0] + run.stamps[-1] - run.stamps).chosen(slice(None, None, -1))


def _turned(run: Variant, rng: np.random.Generator) -> Variant:
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    run = run.changed(lambda points: points @ turn[:3, :3].astype(np.float32))
    return replace(run, odometry=run.odometry @ turn, truth=run.truth @ turn)


_CONDITIONS: dict[str, tuple[int, Callable[..., Variant]]] = {
    "base": (0, lambda run, rng: run),
    "pitch": (1, lambda run, rng, degrees: _leant(run, "y", degrees)),
    "roll": (1, lambda run, rng, degrees: _leant(run, "x", degrees)),
    "odo": (2, _odometry),
    "drift": (0, lambda run, rng: _odometry(run, rng, float(rng.choice([-1.0, 1.0])) * 5.0, 0.5)),
    "beams16": (0, lambda run, rng: run.changed(rings)),
    "near30": (0, lambda run, rng: run.changed(lambda points: points[np.linalg.norm(points, axis=1) < 30.0])),
    "sparse3": (0, lambda run, rng: run.chosen(slice(None, None, 3))),
    "back": (0, _back),
    "rev180": (0, _turned),
}
"""Figures of a condition, and the function of the run, a generator and the figures."""


SETS = ("riverside_a", "kitti04", "handheld_livox")
CONDITIONS = (
    *("base", "pitch:1", "pitch:2", "pitch:3", "roll:3", "odo:5:0.5", "odo:-5:0.5", "drift", "drift#2"),
    *("pitch:2+odo:5:0.5", "pitch:-3+roll:2+drift"),
    *("beams16", "near30", "sparse3", "back", "rev180"),
)
LEAST_SHARE = 85.0  # per cent of the unspoilt run's poses
MOST_METRES, MOST_DEGREES = 0.3, 1.0  # of every first fix
_ASKED = ("pitch", "roll", "odo", "drift")  # conditions that LEAST_SHARE is asked of
_AIRBORNE = ("coview_stream/sim/airborne.py", "coview_stream/clouds")
_LESS = 5.0  # per cent
_SQUARE = 8.0  # metres, of the map that is left out as one
_NEAR = 0.5  # metres to a map point
_SCANS, _POINTS = 12, 10_000  # of a run, of which the overlap is measured


class RealSet:
    """One set on disk: ``base.laz``, ``run/``, ``truth.tum`` (map <- body, a pose for each frame)."""

    def __init__(self, folder: Path) -> None:
        """Raise InputError for a missing file."""
        self.folder, self.name, self.survey = folder, folder.name, folder / "base.laz"
        for path in (self.survey, folder / "run", folder / "truth.tum"):
            if not path.exists():
                raise InputError(f"{path}: not there; a set has base.laz, run/ and truth.tum (--data, --sets)")

    def airborne(self, density: float) -> tuple[Path, dict[str, Any]]:
        """Return the airborne-like cloud of so many pulses per m2, created if missing, and its share of walls."""
        file = folder() / "conditions" / "airborne" / f"{self.name}-{density:g}.laz"

        def make() -> dict[str, Any]:
            cloud = read_cloud(self.survey)
            flown = airborne_survey(cloud.points, Survey(density=density))
            file.parent.mkdir(parents=True, exist_ok=True)
            write_cloud(file, flown, origin=cloud.origin)
            return {"walls": 100.0 * float(surface_of(flown).wall.mean())}

        spec = {"set": self.name, "bytes": self.survey.stat().st_size, "density": density}
        return file, remembered(file.with_suffix(".json"), spec | {"code": fingerprint(*_AIRBORNE)}, make)

    def cut(self, percent: float) -> tuple[Path, float]:
        """Remove squares of the survey until the run's overlap is as asked; return the rest and the overlap, per cent.

        Squares of :data:`_SQUARE` are removed in random order over the whole site. The overlap is the share of the
        run's points that have a map point within half a metre at the true pose.
        """
        file = folder() / "conditions" / "cut" / f"{self.name}-{percent:g}.laz"

        def make() -> dict[str, Any]:
            cloud, run = read_cloud(self.survey), open_run(self.folder / "run")
            truth = read_tum(self.folder / "truth.tum")[1]
            truth[:, :3, 3] -= cloud.origin
            every = max(1, len(run) // _SCANS)
            scans = [transform(truth[k], run.read(k).points[::7].astype(np.float64)) for k in range(0, len(run), every)]
            seen = np.concatenate(scans)
            seen = seen[:: max(1, len(seen) // _POINTS)]
            squares, of = np.unique(np.floor(cloud.points[:, :2] / _SQUARE), axis=0, return_inverse=True)
            rank = np.random.default_rng(zlib.crc32(self.name.encode())).permutation(len(squares))[of.ravel()]
            partners = cKDTree(cloud.points).query_ball_point(seen, _NEAR)
            first = np.array([rank[rows].min() if rows else len(squares) for rows in partners])
            shares = 100.0 * np.searchsorted(np.sort(first), np.arange(len(squares)), side="right") / len(seen)
            last = int(np.abs(shares - percent).argmin())
            file.parent.mkdir(parents=True, exist_ok=True)
            write_cloud(file, cloud.points[rank <= last], origin=cloud.origin)
            return {"overlap": float(shares[last])}

        spec = {"set": self.name, "bytes": self.survey.stat().st_size, "percent": percent}
        code = fingerprint("bench/accuracy/conditions.py")
        return file, remembered(file.with_suffix(".json"), spec | {"code": code}, make)["overlap"]

    def spoil(self, condition: str, out: Path) -> None:
        """Write ``run/`` and ``truth.tum`` of a condition below ``out``."""
        seed, run = zlib.crc32(f"{self.name} {condition}".encode()), open_run(self.folder / "run")
        stamps, truth = read_tum(self.folder / "truth.tum")
        if len(stamps) != len(run):
            raise InputError(f"{self.folder}: {len(run)} frames and {len(stamps)} true poses; give one for each")
        variant = spoilt(condition, Variant(np.arange(len(run)), stamps, run.poses, truth), seed)
        shutil.rmtree(out, ignore_errors=True)
        frames = out / "run" / "frames"
        frames.mkdir(parents=True)
        write_tum(out / "truth.tum", variant.stamps, variant.truth)
        for row, k in enumerate(variant.frames):
            write_cloud(frames / f"{row:06d}.pcd", variant.cloud(run.read(int(k)).points))
        write_tum(out / "run" / "odometry.tum", variant.stamps, variant.odometry)


def set_of(name: str, data: Path) -> RealSet:
    """Return a set of ``data``, else the world SCENE-SENSOR-SEED, 120 m wide with a drive of 24 m."""
    scene, *words = name.split("-", 1)
    sensor, _, seed = "".join(words).rpartition("-")
    if (data / name).exists() or sensor not in SENSORS or not seed.isdecimal():
        return RealSet(data / name)
    config = SimulationConfig(scene, sensor, seed=int(seed), size=120.0, length=24.0, density=10.0)
    return RealSet(worlds.prepared_run(folder(), config))


def located(real: RealSet, condition: str, site: Path, below: Path) -> dict[str, Any]:
    """Localize a set under a condition on a map with the command, unless a result exists; return its scores."""
    place = condition.replace(":", "_")
    run, out = below / "runs" / real.name / place / "run", below / "located" / site.stem / place
    spec = _spec(real, condition)
    remembered(run.parent / "spoilt.json", spec, lambda: real.spoil(condition, run.parent))

    def make() -> dict[str, Any]:
        begin = time.perf_counter()
        scores = scored(read_tum(trajectory(site, run, out)), read_tum(run.parent / "truth.tum"))
        return {**scores, "locate_s": round(time.perf_counter() - begin, 1)}

    return remembered(out / "scores.json", spec | {"scoring": fingerprint("bench/accuracy/scores.py")}, make)


def _spec(real: RealSet, condition: str) -> dict[str, Any]:
    """Name the data and the code that a spoilt run is made of."""
    sizes = [file.stat().st_size for file in (real.survey, real.folder / "truth.tum")]
    code = fingerprint(), fingerprint("bench/accuracy/conditions.py")
    return {"set": real.name, "condition": condition, "code": code, "bytes": sizes}


def by_paper(real: RealSet, condition: str, site: Path, below: Path) -> dict[str, Any]:
    """Return the answers of the first paper's method to a run of :func:`located`, computed if missing."""
    place = condition.replace(":", "_")
    world = below / "runs" / real.name / place

    def make() -> dict[str, Any]:
        return paper.located(BaseMap.load(site), open_run(world / "run"), read_tum(world / "truth.tum")[1])

    spec = _spec(real, condition) | {"paper": fingerprint("bench/accuracy/paper.py")}
    return remembered(below / "located" / site.stem / place / "paper.json", spec, make)


def scored(estimate: tuple[Floats, Poses], truth: tuple[Floats, Poses]) -> dict[str, Any]:
    """Score a trajectory: frames, posed, first fix and its errors, root mean squares, greatest, false frames."""
    stamps, true = truth
    poses = np.full((len(stamps), 4, 4), np.nan)
    for stamp, T in zip(*estimate, strict=True):
        nearest = int(np.abs(stamps - stamp).argmin())
        if abs(stamps[nearest] - stamp) < MAX_STAMP_GAP:
            poses[nearest] = T
    track = Track.of_poses(stamps, poses)
    error, known = errors(track, true), track.tracking
    first = [float(values[known.argmax()]) if known.any() else None for values in (error.metres, error.degrees)]
    about = {"frames": len(stamps), "posed": int(known.sum()), "first_m": first[0], "first_deg": first[1]}
    return about | score(track, true, driven(true), ())


def options(parser: ArgumentParser) -> None:
    """Add the sets, the conditions and the maps."""
    add_data(parser)
    parser.add_argument("--sets", nargs="+", default=list(SETS), metavar="NAME", help=f"folders ({', '.join(SETS)})")
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), metavar="NAME")
    parser.add_argument(
        "--densities", nargs="+", type=float, default=[], metavar="PER_M2", help="also on airborne-like maps: 4 8 20"
    )
    parser.add_argument("--paper", action="store_true", help="also by the first paper's method")
    parser.add_argument(
        "--overlaps", nargs="+", type=float, default=[], metavar="PER_CENT",
        help="instead: unspoilt runs on maps with holes, that hold so much of what the robot sees",
    )  # fmt: skip


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per set, map and condition, then the targets."""
    sets = [set_of(name, asked.data) for name in (asked.sets[-1:] if asked.quick else asked.sets)]
    if asked.overlaps:
        yield from _overlapping(sets, asked.overlaps)
        return
    conditions = list(dict.fromkeys(("base", *(asked.conditions[:2] if asked.quick else asked.conditions))))
    below, results = folder() / "conditions", []
    for real in sets:
        for density in (None, *(asked.densities[:1] if asked.quick else asked.densities)):
            if density is None:
                cloud, on, site_name = real.survey, real.name, "ground survey"
            else:
                cloud, facts = real.airborne(density)
                on, site_name = f"{real.name}-{density:g}", f"{density:g} per m2, {facts['walls']:.1f} % walls"
            site = built(cloud, below / "maps" / f"{on}.coview")
            base: dict[str, Any] = {}
            for condition in conditions:
                scores = located(real, condition, site, below)
                base = base or scores
                about = {"set": real.name, "density": density, "map": site_name, "condition": condition}
                if asked.paper:
                    about["paper"] = by_paper(real, condition, site, below)
                results.append({**about, **scores, "share": share(scores, base)})
                per = "" if density is None else f", {density:g} per m2"
                name = f"conditions/{real.name}{per}, {condition}: posed"
                yield informs(name, 100.0 * scores["posed"] / scores["frames"], "%", results[-1])
    yield from verdicts(results)


def _overlapping(sets: Sequence[RealSet], overlaps: Sequence[float]) -> Iterator[Row]:
    """Yield a row per set and overlap, then the number of false frames."""
    below, false = folder() / "conditions", 0
    for real in sets:
        for percent in overlaps:
            cloud, overlap = real.cut(percent)
            if overlap < percent - _LESS:  # not even the whole map holds so much
                continue
            scores = located(real, "base", built(cloud, below / "maps" / f"{real.name}-cut-{percent:g}.coview"), below)
            false += scores["false_frames"]
            about = {"set": real.name, "overlap": overlap, "asked": percent}
            name = f"conditions/{real.name}, overlap {overlap:.0f} %: posed"
            yield informs(name, 100.0 * scores["posed"] / scores["frames"], "%", {**about, **scores})
    yield judged("conditions/false frames", str(false), "0", false == 0, false)


def share(scores: dict[str, Any], base: dict[str, Any]) -> float | None:
    """Return the share of frames with a pose, per cent of the unspoilt run's."""
    if not base["posed"]:
        return None
    return float(100.0 * (scores["posed"] / scores["frames"]) / (base["posed"] / base["frames"]))


def verdicts(results: Sequence[dict[str, Any]]) -> Iterator[Row]:
    """Judge all runs for false frames, and those on ground surveys for the rest."""
    now = [(f"{r['set']}, {r['condition']}", r) for r in results if r["density"] is None]
    asked = [(name, scores["share"]) for name, scores in now if name.split(", ")[1].startswith(_ASKED)]
    if asked:
        name, least = min(asked, key=lambda entry: -1.0 if entry[1] is None else entry[1])
        holds = least is not None and least >= LEAST_SHARE
        text = f"{number(least, 1)} ({name})"
        yield judged("conditions/least share, tilt and odometry, %", text, f">= {LEAST_SHARE:g}", holds)
    for key, most, unit in (("first_m", MOST_METRES, "m"), ("first_deg", MOST_DEGREES, "deg")):
        first = [(scores[key], name) for name, scores in now if scores[key] is not None]
        worst, where = max(first, default=(float("nan"), "none"))
        text = f"{number(worst, 2)} ({where})"
        yield judged(f"conditions/worst first fix, {unit}", text, f"<= {most:g}", bool(worst <= most), worst)
    yield exposed("conditions", "false poses", sum(result["false_times"] for result in results), results)
    false = sum(result["false_frames"] for result in results)
    yield judged("conditions/false frames", str(false), "0", false == 0, false)


COLUMNS = (
    ("set", "set", None), ("map", "map", None), ("condition", "condition", None), ("frames", "frames", 0),
    ("posed", "posed", 0), ("share %", "share", 0), ("first fix m", "first_fix_m", 1), ("its error m", "first_m", 2),
    ("deg", "first_deg", 2), ("rmse m", "rmse_m", 3), ("deg", "rmse_deg", 2), ("max m", "max_m", 2),
    ("deg", "max_deg", 2), ("false", "false_frames", 0),
)  # fmt: skip


OVERLAP = ("overlap %", "overlap", 0)
BINS = (
    ("overlap %", "asked", 0), ("runs", "runs", 0), ("found", "found", 0), ("first fix m, median", "first_m", 1),
    ("frames posed %", "posed", 0), ("false frames", "false", 0),
)  # fmt: skip


def _bin(percent: float, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of the runs with an overlap."""
    runs = [run for run in runs if run["asked"] == percent]
    first = [run["first_fix_m"] for run in runs if run["posed"]]
    return {
        "asked": percent, "runs": len(runs), "found": len(first), "first_m": np.median(first or [np.nan]),
        "posed": 100.0 * np.mean([run["posed"] / run["frames"] for run in runs] or [np.nan]),
        "false": sum(run["false_frames"] for run in runs),
    }  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return tables of all runs, with ``--paper`` beside the paper's, with ``--overlaps`` below a summary."""
    runs = [row.details for row in rows if "set" in row.details]
    if asked.overlaps:
        bins = listed(BINS, [_bin(percent, runs) for percent in asked.overlaps])
        return {"by overlap": bins, "": listed((COLUMNS[0], OVERLAP, *COLUMNS[3:5], *COLUMNS[6:]), runs)}
    if not asked.paper:
        return {"": listed(COLUMNS, runs)}
    ways = tuple((way, way, None) for way in paper.WAYS)
    text = listed((*COLUMNS, *ways), [run | paper.in_words(run["paper"]) for run in runs])
    ours = [
        run | {"success": bool(run["posed"]) and not run["false_frames"], "e_t": run["rmse_m"], "e_r": run["rmse_deg"]}
        for run in runs
    ]
    rules = "ours: every frame within 1 m and 5 degrees, rms; the paper's: its one pose within 3 m and 5 degrees"
    return {"": text, f"beside the paper ({rules})": paper.compared(ours)}
