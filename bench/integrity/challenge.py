"""A challenge for other programs: first fixes among near copies, scored by TUM files alone.

Worlds are those of ``integrity``: seeds, and edits of public surveys where ``COVIEW_DATA`` has any. ``--make`` writes
``--count`` runs into ``--work DIR``: ``challenge/NAME/map.laz`` (metres) and a run beside it (``run/frames/*.pcd`` in
the body's frame, deskewed, ``run/odometry.tum``). ``truth.tum`` there has the only right pose of each frame, map <-
body, and is empty where none is right.

An answer is ``ANSWERS/NAME.tum``: its first line is the program's first fix, the others are not read. An empty file is
no fix; without a file the program has failed. Without ``--answers`` ours are taken, as ``coview-stream build`` and
``locate`` make them. A fix is right within 3 m and 5 degrees.
"""

from __future__ import annotations

import shutil
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import built, fingerprint, folder, remembered, trajectory
from bench.harness.rows import Row, informs, judged, table
from bench.integrity.integrity import Tally, code_of_runs, percent, planned, with_data
from bench.integrity.plan import FAMILIES, Run
from bench.integrity.run import LENGTH, SPEED, Result, cloud_of, drive_of
from bench.integrity.run import judged as outcome
from coview_stream.clouds import read_tum, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.report.evaluation import MAX_STAMP_GAP

COUNT, QUICK = 100, 2  # runs


def name_of(run: Run) -> str:
    """Return the name of a run's files."""
    return f"{run.kind}-{run.seed}-{run.number}"


def make(run: Run, below: Path, length: float = LENGTH, speed: float = SPEED) -> bool:
    """Write the map, the run and the truth unless this code has; return whether the run exists.

    The robot drives ``length`` metres at ``speed`` metres per second.
    """
    out = below / name_of(run)

    def work() -> dict[str, bool]:
        shutil.rmtree(out, ignore_errors=True)
        if (drive := drive_of(run, length, speed)) is None:
            return {"exists": False}
        (out / "run" / "frames").mkdir(parents=True)
        write_cloud(out / "map.laz", cloud_of(run))
        for k in range(len(drive)):
            write_cloud(out / "run" / "frames" / f"{k:06d}.pcd", drive.frame(k))
        write_tum(out / "run" / "odometry.tum", drive.stamps, drive.odometry)
        nowhere = np.zeros(0), np.zeros((0, 4, 4))
        write_tum(out / "truth.tum", *(nowhere if drive.truth is None else (drive.stamps, drive.truth)))
        return {"exists": True}

    return bool(remembered(out / "made.json", {**_spec(run), "length": length, "speed": speed}, work)["exists"])


def _spec(run: Run) -> dict[str, object]:
    return with_data(code_of_runs()) | {"product": fingerprint(), "run": asdict(run)}


def score(answer: Path, truth: Path) -> dict[str, Any]:
    """Return ``outcome`` (right, false, none or failed) and the metres to an answer's first pose."""
    if not answer.is_file():
        return {"outcome": "failed", "reason": "no file", "metres": np.nan}
    nothing = np.zeros(0), np.zeros((0, 4, 4))
    stamps, poses = read_tum(answer) if answer.stat().st_size else nothing
    if not len(stamps):
        return {"outcome": "none", "state": "SEARCHING", "metres": np.nan}
    known, right = read_tum(truth) if truth.stat().st_size else nothing
    at = int(np.abs(known - stamps[0]).argmin()) if len(known) else -1
    near = at >= 0 and abs(known[at] - stamps[0]) < MAX_STAMP_GAP
    metres = float(np.linalg.norm(np.diff(right[: at + 1, :3, 3], axis=0), axis=1).sum()) if near else np.nan
    return {**outcome(poses[0], right[at] if near else None), "metres": metres}


def locate(run: Run, below: Path, answers: Path) -> None:
    """Answer with the commands of the product unless this code has; without an answer if they fail."""
    out, world = answers / name_of(run), below / name_of(run)

    def work() -> None:
        site = built(world / "map.laz", world / "site.coview")
        found = trajectory(site, world / "run", out)
        answers.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(found, out.with_suffix(".tum"))

    try:
        remembered(out.with_suffix(".json"), _spec(run), work)
    except InputError as error:
        out.with_suffix(".tum").unlink(missing_ok=True)
        print(error, file=sys.stderr)


def options(parser: ArgumentParser) -> None:
    """Add the runs, and whose answers are scored."""
    parser.add_argument("--count", type=int, metavar="N", help=f"runs ({COUNT}; {QUICK} with --quick)")
    parser.add_argument("--make", action="store_true", help="write worlds and truth; score nothing")
    parser.add_argument("--answers", type=Path, metavar="ANSWERS", help="folder of NAME.tum (ours)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Make the worlds, then score the answers."""
    below = folder() / "challenge"
    chosen = (run for site in planned(asked.count or (QUICK if asked.quick else COUNT)) for run in site)
    runs = [run for run in chosen if run.group != "runs" and make(run, below)]
    yield informs("challenge/runs", len(runs), "")
    if asked.make:
        return
    results, answers = list[Result](), asked.answers or below / "ours"
    for run in runs:
        if not asked.answers:
            locate(run, below, answers)
        scored = score(answers / f"{name_of(run)}.tum", below / name_of(run) / "truth.tum")
        about = {"class": FAMILIES[run.family], "family": run.family, "kind": run.kind, "seed": run.seed}
        results.append(about | scored)
    every = Tally.of(results)
    text = f"{every.false} of {every.runs}: below {percent(every.bound)}"
    yield judged("challenge/false first fixes", text, "0", not every.false, every.false)
    failed = [name_of(run) for run, result in zip(runs, results, strict=True) if result["outcome"] == "failed"]
    yield judged("challenge/runs without a file", f"{len(failed)}: {failed[0]}" if failed else "0", "0", not failed)
    yield informs("challenge/by family", len(results), "", {"results": results})


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Count by class and family."""
    results = next((row.details["results"] for row in rows if "results" in row.details), [])
    lines = []
    for key, names in (("class", dict.fromkeys(FAMILIES.values())), ("family", FAMILIES)):
        for name in names:
            some = [result for result in results if result[key] == name]
            if some:
                t, failed = Tally.of(some), sum(result["outcome"] == "failed" for result in some)
                counts = map(str, (len(some), t.right, t.false, t.ambiguous + t.searching, failed))
                lines.append([name, *counts, percent(t.bound, 1)])
    head = ("runs", "number", "right", "false", "none", "failed", "false, below (95 %)")
    return {"": table(head, lines)} if lines else {}
