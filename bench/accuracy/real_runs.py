"""Real sets: runs made under a condition, localized by the command line of some code, compared with the truth.

A set is a directory with ``base.laz``, ``run/`` and ``truth.tum`` (map <- body, a pose for each frame of the run).
"""

from __future__ import annotations

import json
import shutil
import subprocess
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.spoil import Variant, spoilt
from bench.harness.files import fingerprint, remembered
from bench.harness.pinned import Code
from bench.harness.trajectory_scores import Told, errors, score
from coview_stream.clouds import read_tum, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Poses
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import MAX_STAMP_GAP, driven

_SPOILING = ("bench/accuracy/spoil.py", "bench/accuracy/real_runs.py")
_NO_POSE = 1  # exit code of ``locate`` for a run that it could not place


@dataclass(frozen=True)
class RealSet:
    """One set on disk."""

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
        """Return itself; InputError names what is missing."""
        for path in (self.survey, self.folder / "run", self.folder / "truth.tum"):
            if not path.exists():
                raise InputError(f"{path}: not there; a set has base.laz, run/ and truth.tum (--data, --sets)")
        return self

    def variant(self, condition: str, out: Path) -> Path:
        """Write run and truth.tum of a condition below ``out``, unless they are there; return what to localize."""
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
    """Localize a run with the code's own command, unless ``out`` holds what came of it; return its scores."""
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
    told = Told(stamps, states, [""] * count, poses, none, np.zeros(count), np.full((count, 2), np.nan))
    error, known = errors(told, true), told.tracking
    first = int(known.argmax()) if known.any() else None
    kept = ("first_fix_m", "rmse_m", "rmse_deg", "max_m", "max_deg", "false_frames")
    found = score(told, true, driven(true), ())
    return {
        "frames": count,
        "posed": int(known.sum()),
        "first_m": None if first is None else float(error.metres[first]),
        "first_deg": None if first is None else float(error.degrees[first]),
        **{key: found[key] for key in kept},
    }
