"""Whether stated errors hold where every place is wrong: recorded drives on the maps of all other calibration sites.

``python -m bench.integrity.calibrate DIR`` first records the missing ones of ``--runs`` runs of the calibration plan
below DIR (maps in ``worlds/``, the search requests of each drive's first keyframes in ``rec/``). Then it searches each
map for each drive through another site and prints, for errors e, the share of searches in which some keyframe stated
an error below e: the prior odds being even, it should stay below e. The one factor of
:mod:`coview_stream.localization.evidence.background` was chosen so; nothing else was fitted.
"""

from __future__ import annotations

import pickle
from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.rows import table, upper
from bench.integrity.plan import Site, plan
from bench.integrity.run import drive_of, map_of
from coview_stream import BaseMap, Localizer
from coview_stream.config import LocalizerConfig
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search.global_search import GlobalSearch

RECORDED = 5  # keyframes of a search
ERRORS = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4)


def record(out: Path, site: Site) -> None:
    """Record the runs on one map that are not there: their map, and the search requests of each."""
    base: BaseMap | None = None
    for run in site:
        file = out / "rec" / f"{run.kind}-{run.seed}-{run.number}.pkl"
        if file.is_file():
            continue
        if (drive := drive_of(run)) is None:  # there is no such street
            continue
        base = base or map_of(run)
        base.save(out / "worlds" / f"{run.kind}-{run.seed}.coview")
        localizer = Localizer(base)
        frames = ((drive.frame(k), drive.odometry[k], float(stamp)) for k, stamp in enumerate(drive.stamps))
        requests = [request for frame in frames if (request := localizer.add_frame(*frame)) is not None]
        file.write_bytes(pickle.dumps({"site": f"{run.kind}-{run.seed}", "requests": requests[:RECORDED]}))


def smallest_errors(site: Path, drives: list[dict[str, Any]]) -> Iterator[float]:
    """Yield the smallest stated error of each drive through another site than the map's."""
    base, config = BaseMap.load(site), LocalizerConfig()
    search = GlobalSearch(base, config, LocalMaps(base, config.registration.source_range))
    search.prepare()
    for drive in drives:
        if drive["site"] != site.stem:
            search.reset()
            evidence = [search.update(request).evidence for request in drive["requests"]]
            yield min(1.0 - (keyframe.confidence or 0.0) for keyframe in evidence)


def main() -> None:
    """Record and print the table."""
    parser = ArgumentParser(prog="python -m bench.integrity.calibrate", description=__doc__)
    parser.add_argument("place", type=Path, metavar="DIR")
    parser.add_argument("--runs", type=int, default=60, help="of the calibration plan (60)")
    asked = parser.parse_args()
    for name in ("rec", "worlds"):
        (asked.place / name).mkdir(parents=True, exist_ok=True)
    for site in plan("calibration", asked.runs):
        record(asked.place, site)
    drives = [pickle.loads(file.read_bytes()) for file in sorted((asked.place / "rec").glob("*.pkl"))]
    sites = sorted((asked.place / "worlds").glob("*.coview"))
    stated = [error for file in sites for error in smallest_errors(file, drives)]
    print(f"{len(stated)} searches of {RECORDED} keyframes where every place is wrong\n")
    lines = []
    for error in ERRORS:
        count = int((np.array(stated) < error).sum())
        lines.append([f"{error:g}", str(count), f"{count / len(stated):.4f}", f"{upper(count, len(stated)):.4f}"])
    print(table(("stated error below", "searches", "share", "95 % bound"), lines))


if __name__ == "__main__":
    main()
