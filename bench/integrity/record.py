"""Recordings to fit an evidence model on: what searches are asked in runs of the calibration kinds, with the truth.

``python -m bench.integrity.record OUT [RUNS]`` writes OUT/worlds/KIND-SEED.coview and OUT/rec/NAME.pkl, the ones that
are missing of so many runs of the calibration plan: a dictionary with the run's ``name``, ``map`` (path), ``case`` (its
fields) and ``keyframes``, a list of dictionaries: the ``request`` of a localizer that never accepts a place
(:class:`~coview_stream.localization.search.request.SearchRequest`), ``frame``, metres ``driven``, and ``truth``:
``T_map_odom``, map coordinates relative to the map's origin, odometry about the request's anchor; None where no pose
is right.
"""

from __future__ import annotations

import pickle
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.integrity.drives import Drive
from bench.integrity.plan import Site, plan
from bench.integrity.run import drive_of
from bench.integrity.work import map_of
from coview_stream import BaseMap, Localizer
from coview_stream.geometry.transforms import inverse, to_local

KEYFRAMES = 15
"""Of a recording: thirty metres."""


def main(out: Path, runs: int = 60) -> None:
    """Record the calibration runs that are not there."""
    (out / "rec").mkdir(parents=True, exist_ok=True)
    for site in plan("calibration", runs):
        _record(out, site)


def _record(out: Path, site: Site) -> None:
    base: BaseMap | None = None
    for run in site:
        file = out / "rec" / f"{run.family.replace(' ', '-').replace(',', '')}-{run.kind}-{run.seed}-{run.number}.pkl"
        if file.is_file():
            continue
        begin, drive = time.perf_counter(), drive_of(run)
        if drive is None:
            continue
        base = base or map_of(run, out / "worlds")
        said = {
            "name": file.stem,
            "map": str(out / "worlds" / f"{run.kind}-{run.seed}.coview"),
            "case": asdict(run),
            "keyframes": recorded(base, drive),
        }
        file.write_bytes(pickle.dumps(said))
        print(f"{file} {len(said['keyframes'])} keyframes, {time.perf_counter() - begin:.1f} s", flush=True)


def recorded(base: BaseMap, drive: Drive) -> list[dict[str, Any]]:
    """Return the requests of a drive's first keyframes."""
    localizer, out = Localizer(base), list[dict[str, Any]]()
    for k, stamp in enumerate(drive.stamps):
        request = localizer.add_frame(drive.frame(k), drive.odometry[k], float(stamp))
        if request is None:
            continue
        truth = None
        if drive.truth is not None:
            truth = to_local(drive.truth[k], base.origin) @ inverse(request.T_odom_body)
        out.append({"request": request, "truth": truth, "frame": k, "driven": float(drive.driven[k])})
        if len(out) == KEYFRAMES:
            break
    return out


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:3]))
