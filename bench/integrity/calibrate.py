"""Whether stated errors hold where every place is wrong: recorded drives on the maps of all other calibration sites.

``python -m bench.integrity.calibrate DIR [KEYFRAMES]`` reads what ``python -m bench.integrity.record DIR`` wrote,
searches each map for each drive through another site and prints, for errors e, the share of the searches in which some
keyframe stated an error below e: the prior odds being even, it should stay below e. So the one factor of
:mod:`coview_stream.localization.evidence.background` is chosen; nothing else was fitted.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np

from bench.integrity.bounds import upper
from coview_stream import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.search.global_search import GlobalSearch

KEYFRAMES = 5
ERRORS = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4)


def smallest_errors(site: Path, drives: list[dict[str, Any]], keyframes: int) -> list[tuple[str, float]]:
    """Return, for drives through other sites than the map's, the smallest error that a keyframe stated."""
    base, config = BaseMap.load(site), LocalizerConfig()
    search = GlobalSearch(base, config, LocalMaps(base, config.registration.source_range))
    search.prepare()
    out = []
    for drive in drives:
        if site.stem == f"{drive['case']['kind']}-{drive['case']['seed']}":
            continue
        search.reset()
        stated = 1.0
        for each in drive["keyframes"][:keyframes]:
            said = search.update(each["request"]).evidence
            stated = min(stated, 1.0 - (said.confidence or 0.0))
        out.append((drive["name"], stated))
    return out


def main(place: Path, keyframes: int) -> None:
    """Print the table."""
    drives = [pickle.loads(file.read_bytes()) for file in sorted((place / "rec").glob("*.pkl"))]
    found: list[float] = []
    for site in sorted((place / "worlds").glob("*.coview")):
        for name, stated in smallest_errors(site, drives, keyframes):
            found.append(stated)
            if stated < ERRORS[0]:
                print(f"{site.stem}: {name}: {stated:.1e}", flush=True)
    errors = np.array(found)
    print(f"{len(errors)} searches of {keyframes} keyframes where every place is wrong\n")
    print("| stated error below | searches | share | 95 % bound |\n|---:|---:|---:|---:|")
    for error in ERRORS:
        count = int((errors < error).sum())
        print(f"| {error:g} | {count} | {count / len(errors):.4f} | {upper(count, len(errors)):.4f} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else KEYFRAMES)
