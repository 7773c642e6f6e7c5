"""Search on a real airborne map of a square kilometre and a half, one core: time, memory, and what the field takes.

The map is of a public survey (Autzen stadium, 10.65 million points), built by the product's command; the drives are
ray-cast against a surface made of the same points (``bench/harness/airborne.py``), so that they say how long a search
takes and that it ends where it should, not how well a real scan fits an old survey. The search steps are those of
``python -m bench search``: no place is accepted, votes go on adding up. ``locate`` is the product's command on a whole
drive. The survey is looked for in the folder that COVIEW_DATA names.
"""

from __future__ import annotations

import os
import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.harness.airborne import ROUTES, recorded, survey
from bench.harness.files import folder
from bench.harness.pinned import Code, today
from bench.harness.rows import Row, bounded, informs, reached
from bench.speed.search import LEAST_RIVALS, Searcher, last_core
from coview_stream.basemap import file_format
from coview_stream.clouds import read_tum
from coview_stream.errors import InputError
from coview_stream.report.evaluation import evaluate

P95_MS, MEGABYTES, FIELD_MB = 500.0, 1000.0, 60.0
"""The targets: of a search step, of ``locate``, of the field per square kilometre."""

LEAST_LOCALISED = 85.0  # per cent of the frames of a drive of a hundred metres

DRIVES = 5


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield sizes, then search steps and a whole run of each drive; without the survey a row that says so."""
    below = folder() / "airborne"
    try:
        site = today().built([survey()], below / "site.coview")
    except InputError as error:
        print(f"airborne: {error}", file=sys.stderr)
        yield informs(f"airborne: {error}", np.nan, "")
        return
    yield from _sizes(site)
    for name in list(ROUTES)[: 1 if asked.quick else None]:
        drive = recorded(name, below)
        label = f"airborne/{name}"
        with Searcher(today(), site, drive / "run") as searcher:
            for _ in range(1 if asked.quick else DRIVES):
                searcher.drive()
        yield informs(f"{label}: step p50", searcher.percentile(50), "ms")
        yield bounded(f"{label}: step p95", searcher.percentile(95), "ms", P95_MS)
        yield informs(f"{label}: step p95, processor time", searcher.percentile(95, "cpu_ms"), "ms")
        yield reached(f"{label}: rivals scored per step, median", searcher.rivals(), "", LEAST_RIVALS)
        yield informs(f"{label}: memory of the searching process, peak", searcher.megabytes, "MB")
        yield from _located(label, today(), site, drive, below / f"{name}-out")


def _sizes(site: Path) -> Iterator[Row]:
    """Megabytes of the file's parts per square kilometre that the survey covers."""
    arrays, parameters, _ = file_format.load(site)
    area = float(np.count_nonzero(arrays["surveyed"])) * parameters["config"]["block"] ** 2 / 1e6

    def taken(begin: str) -> float:
        return float(sum(values.nbytes for name, values in arrays.items() if name.startswith(begin)) / 1e6 / area)

    yield informs("airborne/stations", len(arrays["stations"]), "")
    yield informs("airborne/area", area, "km2")
    yield bounded("airborne/field in the file, per km2", taken("field.") or np.nan, "MB", FIELD_MB)
    yield informs("airborne/descriptors in the file, per km2", taken("descriptor."), "MB")
    yield informs("airborne/whole file, per km2", site.stat().st_size / 1e6 / area, "MB")


def _located(label: str, code: Code, site: Path, drive: Path, out: Path) -> Iterator[Row]:
    """Rows of ``coview-stream locate`` on one core."""
    words = ("-m", "coview_stream", "locate", str(site), str(drive / "run"), "-o", str(out))
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {last_core()})  # a child inherits it
    try:
        process = subprocess.Popen(
            code.command(*words), env=code.environment(), cwd=site.parent,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    finally:
        os.sched_setaffinity(0, before)
    _, _, usage = os.wait4(process.pid, 0)
    process.returncode = 0  # it has been waited for
    yield bounded(f"{label}: memory of locate, peak", usage.ru_maxrss / 1024, "MB", MEGABYTES)
    found = evaluate(read_tum(out / "trajectory.tum"), read_tum(drive / "truth.tum"))
    yield bounded(f"{label}: false frames", found.false_frames, "", 0)
    yield reached(f"{label}: frames with a right pose", 100 * found.share_localised, "%", LEAST_LOCALISED)
    yield informs(f"{label}: driven before the first fix", found.first_fix_m or np.nan, "m")
