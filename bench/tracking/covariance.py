"""Whether the covariance is true: mean of e' C^-1 e, 6 for six axes, on real runs and on simulated drives.

``shared`` of the configuration is set by kitti04 and towns. The estimator itself was chosen among about a hundred
variants with all three real runs, towns and villages in view: those are ``seen`` and no independent test. The truth of
a run has errors of its own, which count as ours. All frames of a real run count, metres apart; one pose per ten metres
of a simulated drive, of those that ``bench protection`` follows.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from bench.accuracy.conditions import SETS, RealSet
from bench.accuracy.scores import Track, errors
from bench.harness.files import add_data, built, fingerprint, folder, remembered
from bench.harness.rows import Row, judged, table
from bench.tracking.protection import FAMILIES, measure
from bench.tracking.tracking import AXES, NOMINAL, squares
from coview_stream import BaseMap, Localizer, open_run
from coview_stream.clouds import read_tum
from coview_stream.geometry.arrays import Floats

BAND = (3.0, 12.0)  # of the mean of e' C^-1 e over a run
USES = {
    **dict.fromkeys(("kitti04", "town"), "seen, sets shared"),
    **dict.fromkeys(("riverside_a", "handheld_livox", "village"), "seen"),
}
"""Runs and kinds of sites that were looked at while the estimator was made; all others are held out."""
_TRUTH = {
    "riverside_a": "ICP, cycles close to 3 cm",
    "kitti04": "GNSS and IMU, centimetres",
    "handheld_livox": "repository, 1 to 9 cm off ICP",
}
_PARTS = {"position": (0, 1, 2), "rotation": (3, 4, 5)}


def options(parser: ArgumentParser) -> None:
    """Add the runs and the drives."""
    add_data(parser)
    parser.add_argument("--sets", nargs="*", default=list(SETS), metavar="NAME", help=f"folders ({', '.join(SETS)})")
    parser.add_argument("--worlds", type=int, default=8, metavar="N", help="simulated drives of each family (8)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per run: the mean, and whether it is in the band."""
    for name in asked.sets:
        yield judge(name, USES.get(name, "held out"), _TRUTH.get(name, "as given"), real(RealSet(asked.data / name)))
    for family in FAMILIES.values():
        for world, variant in family.worlds(0 if asked.quick else asked.worlds):
            drive, label = measure(folder(), world, variant), f"{world.kind}-{world.sensor}-{world.seed}"
            twist, covariances = (np.array(drive[key], dtype=np.float64) for key in ("twist", "covariances"))
            found = figures(twist.reshape(-1, 6), covariances.reshape(-1, 6, 6))
            name = f"{label}, 30 % changed" if variant == "changed" else label
            yield judge(name, USES.get(world.kind, "held out"), "exact", found)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per run."""
    promised = [["promised", "", "", "", "6.0", _percent(NOMINAL), "3.0", "3.0"]]
    lines = [
        [
            found["name"], found["use"], found["truth"], str(found["poses"]),
            f"{found['mean']:.1f}", _percent(found["inside"]), *(f"{found[part]:.1f}" for part in _PARTS),
        ]
        for found in (row.details for row in rows)
    ]  # fmt: skip
    head = ("run", "use", "truth", "poses", "mean e' C^-1 e", "within 1, 2, 3 sigma, %", *_PARTS)
    return {"": table(head, promised + lines)}


def judge(name: str, use: str, truth: str, found: dict[str, Any]) -> Row:
    """Return the row of a run."""
    row = judged(
        f"covariance/{name}: mean e' C^-1 e", f"{found['mean']:.1f}", f"{BAND[0]:.0f} to {BAND[1]:.0f}",
        BAND[0] <= found["mean"] <= BAND[1], found["mean"],
    )  # fmt: skip
    row.details.update(found, name=name, use=use, truth=truth)
    return row


def figures(twist: Floats, covariances: Floats) -> dict[str, Any]:
    """Mean squared distances and shares of errors (N, 6) and covariances (N, 6, 6) over x, y, z, roll, pitch, yaw."""
    whole = squares(twist, covariances, AXES["pose"])
    inside = [float((whole <= limit).mean()) for limit in chi2.ppf(NOMINAL, 6)]
    parts = {name: float(squares(twist, covariances, axes).mean()) for name, axes in _PARTS.items()}
    return {"poses": len(twist), "mean": float(whole.mean()), "inside": inside, **parts}


def real(run: RealSet) -> dict[str, Any]:
    """Return the figures of a real run on its own map; kept until the code changes."""
    below = folder() / "covariance"

    def work() -> dict[str, Any]:
        site = built(run.survey, below / f"{run.name}.coview")
        frames, (stamps, truth) = open_run(run.folder / "run"), read_tum(run.folder / "truth.tum")
        localizer = Localizer(BaseMap.load(site))
        track = Track.of([localizer.step(f.points, f.T_odom_body, f.stamp) for f in frames], stamps)
        known = track.tracking
        return figures(errors(track, truth).twist[known], track.covariances[known])

    parts = "tracking/covariance", "tracking/tracking", "accuracy/scores"
    spec = {"code": fingerprint(), "bench": fingerprint(*(f"bench/{part}.py" for part in parts))}
    return remembered(below / f"{run.name}-figures.json", spec | {"bytes": run.survey.stat().st_size}, work)


def _percent(shares: Sequence[float]) -> str:
    return " / ".join(f"{100 * share:.0f}" for share in shares)
