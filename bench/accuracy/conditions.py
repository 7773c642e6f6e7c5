"""Real runs under the conditions of real robots, and on airborne-like maps of the same places.

Each set of ``--data`` (``base.laz``, ``run/``, ``truth.tum``; not part of the repository) is spoilt as
the condition says and localized by ``coview-stream locate``, one process per run, on the map that
``coview-stream build`` makes of ``base.laz``. ``--densities`` adds maps of what an aircraft might have seen of the same
place, without facades, made as ``coview-stream airborne`` does. ``--before COMMIT`` has an earlier commit do the same,
with its own map, and puts its figures before ours in every cell. Results stay in ``--work``.

A frame is false if its pose is more than 1 m or 5 degrees off; *share* is the share of frames with a pose, per cent of
the unspoilt run's.

A condition is a name with its figures, ``pitch:2``; several joined by ``+`` follow one another; ``drift#2`` is another
draw.

=============== ====================================================================================
base            the run as it is
pitch:DEG       clouds pitched, nose down, by DEG degrees, unknown to odometry (roll:DEG likewise)
odo:PCT:YAW     odometry made of the truth: PCT % too long, a yaw walk of YAW degrees per sqrt(m)
drift           odo:5:0.5 with either sign of the scale
beams16         16 of 64 rings of elevation
near30          only points within 30 m
sparse3         every third frame
start:K:N       frames K to K + N - 1
back            the frames in reverse order
rev180          the body turned around its z axis by 180 degrees, in clouds, odometry and truth
still:K         frame K ten times, 0.2 s apart, with 2 mm of noise in the odometry
one:K           frame K alone, as a cloud file
=============== ====================================================================================
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
import zlib
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.accuracy.scores import Track, errors, score
from bench.harness.files import ROOT, Code, fingerprint, folder, pinned, remembered, today
from bench.harness.rows import NOTHING, Row, informs, judged, number, table
from coview_stream.clouds import read_cloud, read_tum, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Indices
from coview_stream.geometry.transforms import Points, Poses, inverse, pose_from
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import MAX_STAMP_GAP, driven
from coview_stream.sim.airborne import Survey, airborne_survey, surface_of

_DRIFT = (5.0, 0.5)  # per cent, degrees per sqrt(m)
_RINGS, _KEPT = 64, 16  # of elevation
_NEAR = 30.0  # metres
_COPIES, _PERIOD, _JITTER = 10, 0.2, 0.002  # of a frame; seconds; metres


@dataclass(frozen=True)
class Variant:
    """A run under a condition, in terms of the frames that it was made of.

    Attributes:
        frames: (N,) which frame of the original each is.
        stamps: (N,) seconds, increasing.
        odometry: (N, 4, 4) odometry <- body, metres.
        truth: (N, 4, 4) map <- body, the body being the one that odometry is about.
        changes: done to each cloud (K, 3) in the body frame, in this order.
        alone: whether the frame is given as a cloud file, without stamp and odometry.
    """

    frames: Indices
    stamps: Floats
    odometry: Poses
    truth: Poses
    changes: tuple[Callable[[Points], Points], ...] = ()
    alone: bool = False

    def cloud(self, points: Points) -> Points:
        """Return what becomes of a frame's cloud (K, 3), metres."""
        for change in self.changes:
            points = change(points)
        return np.ascontiguousarray(points, dtype=np.float32)

    def changed(self, change: Callable[[Points], Points]) -> Variant:
        """Return it with one more change of the clouds."""
        return replace(self, changes=(*self.changes, change))

    def chosen(self, of: Indices) -> Variant:
        """Return it with some of its frames, in that order."""
        odometry, truth = self.odometry[of], self.truth[of]
        return replace(self, frames=self.frames[of], stamps=self.stamps[of], odometry=odometry, truth=truth)


def spoilt(condition: str, run: Variant, seed: int) -> Variant:
    """Return the run under a condition; the same seed makes the same.

    Raises:
        InputError: no such condition, wrong figures, or a frame that the run does not have.
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
        try:
            run = make(run, figures, rng)
        except IndexError as error:
            raise InputError(f"condition {part!r}: the run has {len(run.frames)} frames") from error
    if not len(run.frames):
        raise InputError(f"condition {condition!r}: leaves no frame")
    return run


def _base(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run


def _leant(axis: str, run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    R = Rotation.from_euler(axis, figures[0], degrees=True).as_matrix()
    return run.changed(lambda points: points @ R.T.astype(np.float32))


def _odometry(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    scale, walk = 1.0 + figures[0] / 100.0, figures[1]
    poses = [run.odometry[0]]
    for before, after in zip(run.truth[:-1], run.truth[1:], strict=True):
        step = inverse(before) @ after
        metres = float(np.linalg.norm(step[:3, 3]))
        turn = Rotation.from_euler("z", rng.normal(0.0, walk * np.sqrt(metres)), degrees=True).as_matrix()
        poses.append(poses[-1] @ pose_from(step[:3, :3] @ turn, step[:3, 3] * scale))
    return replace(run, odometry=np.array(poses))


def _drift(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return _odometry(run, (float(rng.choice([-1.0, 1.0])) * _DRIFT[0], _DRIFT[1]), rng)


def rings(points: Points, kept: int = _KEPT) -> Points:
    """Keep some of 64 rings of elevation, evenly spread over where the points (K, 3) are."""
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    low, high = np.percentile(elevation, [0.5, 99.5])  # single points above and below are no ring
    ring = np.clip((elevation - low) / max(high - low, 1e-9) * _RINGS, 0, _RINGS - 1).astype(int)
    return points[np.isin(ring, np.round(np.linspace(0, _RINGS - 1, kept)).astype(int))]


def _beams(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.changed(rings)


def _near(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.changed(lambda points: points[np.linalg.norm(points, axis=1) < _NEAR])


def _sparse(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.chosen(np.arange(0, len(run.frames), 3))


def _part(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.chosen(np.arange(len(run.frames))[int(figures[0]) : int(figures[0] + figures[1])])


def _back(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    stamps = run.stamps[0] + run.stamps[-1] - run.stamps
    return replace(run, stamps=stamps).chosen(np.arange(len(run.frames))[::-1])


def _turned(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned = run.changed(lambda points: points * np.array([-1.0, -1.0, 1.0], dtype=np.float32))
    return replace(turned, odometry=run.odometry @ turn, truth=run.truth @ turn)


def _still(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    run.frames[int(figures[0])]  # raises IndexError
    copies = run.chosen(np.full(_COPIES, int(figures[0])))
    odometry = copies.odometry.copy()
    odometry[:, :3, 3] += rng.normal(0.0, _JITTER, (_COPIES, 3))
    return replace(copies, stamps=np.arange(_COPIES) * np.float64(_PERIOD), odometry=odometry)


def _one(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    run.frames[int(figures[0])]
    return replace(run.chosen(np.array([int(figures[0])])), stamps=np.zeros(1), alone=True)


_CONDITIONS: dict[str, tuple[int, Callable[[Variant, Sequence[float], np.random.Generator], Variant]]] = {
    "base": (0, _base),
    "pitch": (1, partial(_leant, "y")),
    "roll": (1, partial(_leant, "x")),
    "odo": (2, _odometry),
    "drift": (0, _drift),
    "beams16": (0, _beams),
    "near30": (0, _near),
    "sparse3": (0, _sparse),
    "start": (2, _part),
    "back": (0, _back),
    "rev180": (0, _turned),
    "still": (1, _still),
    "one": (1, _one),
}


SETS = ("riverside_a", "kitti04", "handheld_livox")
CONDITIONS = (
    *("base", "pitch:1", "pitch:2", "pitch:3", "roll:3", "odo:5:0.5", "odo:-5:0.5", "drift", "drift#2"),
    *("pitch:2+odo:5:0.5", "pitch:-3+roll:2+drift"),
    *("beams16", "near30", "sparse3", "back", "rev180"),
)
LEAST_SHARE = 85.0  # per cent of the unspoilt run's poses
MOST_METRES, MOST_DEGREES = 0.3, 1.0  # of every first fix
_ASKED = ("pitch", "roll", "odo", "drift")  # conditions that LEAST_SHARE is asked of
_ARROW = " > "
_SPOILING = ("bench/accuracy/conditions.py",)
_AIRBORNE = ("coview_stream/sim/airborne.py", "coview_stream/clouds")
_NO_POSE = 1  # exit code of ``locate`` for a run that it could not place

Runs = dict[str, dict[str, Any]]  # scores by code, "before" and "now"


@dataclass(frozen=True)
class RealSet:
    """One set on disk: ``base.laz``, ``run/``, ``truth.tum`` (map <- body, a pose for each frame)."""

    folder: Path

    @property
    def name(self) -> str:
        """Name of its directory."""
        return self.folder.name

    @property
    def survey(self) -> Path:
        """Point cloud that maps are built of."""
        return self.folder / "base.laz"

    def checked(self) -> RealSet:
        """Return itself; InputError names a missing file."""
        for path in (self.survey, self.folder / "run", self.folder / "truth.tum"):
            if not path.exists():
                raise InputError(f"{path}: not there; a set has base.laz, run/ and truth.tum (--data, --sets)")
        return self

    def airborne(self, density: float) -> tuple[Path, dict[str, Any]]:
        """Return the airborne-like cloud of so many pulses per m2, made unless it is there, and counts of points."""
        file = folder() / "conditions" / "airborne" / f"{self.name}-{density:g}.laz"

        def make() -> dict[str, Any]:
            cloud = read_cloud(self.survey)
            flown = airborne_survey(cloud.points, Survey(density=density))
            file.parent.mkdir(parents=True, exist_ok=True)
            write_cloud(file, flown, origin=cloud.origin)
            walls = [100.0 * float(surface_of(points).wall.mean()) for points in (cloud.points.astype(float), flown)]
            return {"points": len(cloud), "kept": len(flown), "walls_before": walls[0], "walls": walls[1]}

        spec = {"set": self.name, "bytes": self.survey.stat().st_size, "density": density}
        return file, remembered(file.with_suffix(".json"), spec | {"code": fingerprint(*_AIRBORNE)}, make)

    def variant(self, condition: str, out: Path) -> Path:
        """Write run and truth.tum of a condition below ``out``, unless they are there; return the run."""
        seed = zlib.crc32(f"{self.name} {condition}".encode())
        spec = {"set": self.name, "seed": seed, "condition": condition, "code": fingerprint(*_SPOILING)}
        made = remembered(out / "spoilt.json", spec, lambda: self._write(condition, seed, out))
        return out / str(made["run"])

    def _write(self, condition: str, seed: int, out: Path) -> dict[str, str]:
        run = open_run(self.folder / "run")
        stamps, truth = read_tum(self.folder / "truth.tum")
        if len(stamps) != len(run):
            raise InputError(f"{self.folder}: {len(run)} frames and {len(stamps)} true poses; give one for each")
        variant = spoilt(condition, Variant(np.arange(len(run)), stamps, run.poses, truth), seed)
        shutil.rmtree(out, ignore_errors=True)
        frames = out / "run" / "frames"
        frames.mkdir(parents=True)
        write_tum(out / "truth.tum", variant.stamps, variant.truth)
        files = [out / "run.pcd"] if variant.alone else [frames / f"{k:06d}.pcd" for k in range(len(variant.frames))]
        for file, k in zip(files, variant.frames, strict=True):
            write_cloud(file, variant.cloud(run.read(int(k)).points))
        if not variant.alone:
            write_tum(out / "run" / "odometry.tum", variant.stamps, variant.odometry)
        return {"run": "run.pcd" if variant.alone else "run"}


def located(code: Code, version: str, site: Path, run: Path, out: Path) -> dict[str, Any]:
    """Localize a run with the code's own command, unless ``out`` holds the result; return its scores."""
    truth = read_tum(run.parent / "truth.tum")
    spec = {"run": json.loads((run.parent / "spoilt.json").read_text())["spec"], "code": version}

    def make() -> dict[str, Any]:
        words = ("-m", "coview_stream", "locate", str(site), str(run), "-o", str(out), "--no-pictures")
        begin = time.perf_counter()
        done = subprocess.run(
            code.command(*words), env=code.environment(), cwd=site.parent, capture_output=True, text=True
        )
        if done.returncode not in (0, _NO_POSE):
            raise InputError(f"{run.parent.name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
        scores = scored(read_tum(out / "trajectory.tum"), truth)
        return {**scores, "locate_s": round(time.perf_counter() - begin, 1)}

    return remembered(out / "scores.json", spec, make)


def scored(estimate: tuple[Floats, Poses], truth: tuple[Floats, Poses]) -> dict[str, Any]:
    """Score a trajectory: frames, posed, first fix and its errors, root mean squares, greatest, false frames."""
    stamps, true = truth
    poses = np.full((len(stamps), 4, 4), np.nan)
    for stamp, T in zip(*estimate, strict=True):
        nearest = int(np.abs(stamps - stamp).argmin())
        if abs(stamps[nearest] - stamp) < MAX_STAMP_GAP:
            poses[nearest] = T
    none, count = np.full((len(stamps), 6, 6), np.nan), len(stamps)
    states = np.where(np.isnan(poses[:, 0, 0]), "SEARCHING", "TRACKING").tolist()
    track = Track(stamps, states, [""] * count, poses, none, np.zeros(count), np.full((count, 2), np.nan))
    error, known = errors(track, true), track.tracking
    first = int(known.argmax()) if known.any() else None
    kept = ("first_fix_m", "rmse_m", "rmse_deg", "max_m", "max_deg", "false_frames")
    figures = score(track, true, driven(true), ())
    return {
        "frames": count,
        "posed": int(known.sum()),
        "first_m": None if first is None else float(error.metres[first]),
        "first_deg": None if first is None else float(error.degrees[first]),
        **{key: figures[key] for key in kept},
    }


def options(parser: ArgumentParser) -> None:
    """Add the sets, the conditions, the maps and the code that is compared with."""
    here = Path(os.environ.get("COVIEW_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=here, metavar="DIR", help="holds the sets (COVIEW_DATA)")
    parser.add_argument("--sets", nargs="+", default=list(SETS), metavar="NAME", help=f"folders ({', '.join(SETS)})")
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), metavar="NAME")
    parser.add_argument(
        "--densities", nargs="+", type=float, default=[], metavar="PER_M2", help="also on airborne-like maps: 4 8 20"
    )
    parser.add_argument("--before", metavar="COMMIT", help="an earlier commit, measured on the same runs")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs at a time (1)")


def codes(asked: Namespace) -> dict[str, tuple[Code, str]]:
    """Return the measured code with the version that its results depend on, the earlier one first."""
    now = {"now": (today(), fingerprint())}
    return {"before": (pinned(asked.before), asked.before), **now} if asked.before else now


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per set, map and condition, then the targets."""
    sets = [RealSet(asked.data / name).checked() for name in (asked.sets[-1:] if asked.quick else asked.sets)]
    conditions = list(dict.fromkeys(("base", *(asked.conditions[:2] if asked.quick else asked.conditions))))
    below = folder() / "conditions"
    jobs = []
    for real in sets:
        for density in (None, *(asked.densities[:1] if asked.quick else asked.densities)):
            cloud, facts = (real.survey, {}) if density is None else real.airborne(density)
            name = real.name if density is None else f"{real.name}-{density:g}"
            sites = {
                label: code.built([cloud], below / f"maps-{code.version[:10]}" / f"{name}.coview")
                for label, (code, _) in codes(asked).items()
            }
            jobs += [(real, density, facts, name, sites, condition) for condition in conditions]

    def run(real: RealSet, density: float | None, facts: Any, name: str, sites: Any, condition: str) -> dict[str, Any]:
        place = condition.replace(":", "_")
        variant, scores = real.variant(condition, below / "runs" / real.name / place), {}
        for label, (code, version) in codes(asked).items():
            out = below / f"runs-{version[:10]}" / name / place
            scores[label] = located(code, version, sites[label], variant, out)
        return {"set": real.name, "density": density, "condition": condition, **facts, "runs": scores}

    unspoilt: dict[tuple[str, float | None], Runs] = {}
    results = []
    with ThreadPoolExecutor(max(asked.jobs, 1)) as pool:
        for real, condition in ((real, condition) for real in sets for condition in conditions):
            real.variant(condition, below / "runs" / real.name / condition.replace(":", "_"))  # before threads use it
        try:
            for result in pool.map(lambda job: run(*job), jobs):
                base = unspoilt.setdefault((result["set"], result["density"]), result["runs"])
                for label, scores in result["runs"].items():
                    scores["share"] = share(scores, base[label])
                results.append(result)
                now = result["runs"]["now"]
                on = "" if result["density"] is None else f", {result['density']:g} per m2"
                name = f"conditions/{result['set']}{on}, {result['condition']}: posed"
                yield informs(name, 100.0 * now["posed"] / now["frames"], "%", result)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    yield from verdicts(results)


def share(scores: dict[str, Any], base: dict[str, Any]) -> float | None:
    """Return the share of frames with a pose, per cent of the unspoilt run's."""
    if not base["posed"]:
        return None
    return float(100.0 * (scores["posed"] / scores["frames"]) / (base["posed"] / base["frames"]))


def verdicts(results: Sequence[dict[str, Any]]) -> Iterator[Row]:
    """Judge the code of today: all runs for false frames, those on ground surveys for the rest."""
    now = [(f"{r['set']}, {r['condition']}", r["runs"]["now"]) for r in results if r["density"] is None]
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
    false = sum(result["runs"]["now"]["false_frames"] for result in results)
    yield judged("conditions/false frames", str(false), "0", false == 0, false)


_HEAD = (
    *("set", "map", "condition", "frames", "posed", "share %", "first fix m", "its error m", "deg", "rmse m", "deg"),
    *("max m", "deg", "false"),
)
_COLUMNS = (
    *(("posed", 0), ("share", 0), ("first_fix_m", 1), ("first_m", 2), ("first_deg", 2), ("rmse_m", 3)),
    *(("rmse_deg", 2), ("max_m", 2), ("max_deg", 2), ("false_frames", 0)),
)


def cells(details: dict[str, Any]) -> list[str]:
    """One line of the table: in each cell the earlier code's figure, if there is one, and ours."""
    runs, density = list(details["runs"].values()), details["density"]
    site = "ground survey" if density is None else f"{density:g} per m2, {details['walls']:.1f} % walls"
    shown = [details["set"], site, details["condition"], str(runs[-1]["frames"])]
    for key, digits in _COLUMNS:
        figures = [number(scores[key], digits) for scores in runs]
        shown.append(NOTHING if set(figures) == {NOTHING} else _ARROW.join(figures))
    return shown


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs."""
    before = f"\n\nBefore the arrow: commit {asked.before[:7]}." if asked.before else ""
    return {"": f"{table(_HEAD, [cells(row.details) for row in rows if row.details])}{before}"}
