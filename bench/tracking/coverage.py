"""Coverage of a reported covariance: how often the truth lies within its sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from bench.accuracy.scores import Errors, Track
from bench.harness.rows import number, table
from coview_stream.geometry.arrays import Bools, Floats

FIRST_MINUTE = 60.0  # seconds after a fix in which its covariance is judged apart
PARTS = ("first minute", "later")

NOMINAL = tuple(float(p) for p in chi2.cdf([1.0, 4.0, 9.0], 1))  # shares that 1, 2 and 3 sigma promise

AXES: dict[str, tuple[int, ...]] = {
    "x": (0,), "y": (1,), "z": (2,), "roll": (3,), "pitch": (4,), "yaw": (5,),
    "x,y": (0, 1), "x,y,z": (0, 1, 2), "pose": (0, 1, 2, 3, 4, 5),
}  # fmt: skip
"""One axis alone, or several by their squared Mahalanobis distance."""

WITHIN = 0.05  # share by which an observed coverage may differ from the nominal one

Squares = dict[str, dict[str, Floats]]
"""Squared Mahalanobis distances of poses, by part of the time since a fix and by name of the axes."""


def since_fix(track: Track) -> Floats:
    """(N,) seconds since the fix that each pose goes back to, NaN where there is none.

    A fix is the first pose after a search (SEARCHING or LOST); a doubt in between does not end it.
    """
    out = np.full(len(track.stamps), np.nan)
    fixed: float | None = None
    for k, (state, known) in enumerate(zip(track.states, track.tracking, strict=True)):
        if state in ("SEARCHING", "LOST"):
            fixed = None
        elif known:
            fixed = float(track.stamps[k]) if fixed is None else fixed
            out[k] = track.stamps[k] - fixed
    return out


def squares(twist: Floats, covariances: Floats, axes: Sequence[int]) -> Floats:
    """(N,) squared Mahalanobis distances over some axes; infinite where a covariance is none."""
    pick = np.asarray(axes)
    error, cov = twist[:, pick], covariances[:, pick[:, None], pick]
    sane: Bools = np.asarray(np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(error).all(axis=1))
    cov = np.where(sane[:, None, None], cov, np.eye(len(pick)))
    # metres stand beside radians: compare each by its own size
    scale = np.sqrt(np.abs(np.einsum("nii->ni", cov)))
    scale = np.where(scale > 0, scale, 1.0)
    level = cov / (scale[:, :, None] * scale[:, None, :])
    sane &= np.linalg.eigvalsh(level)[:, 0] > 1e-12
    unit, out = (error / scale)[sane], np.full(len(twist), np.inf)
    out[sane] = np.einsum("ni,ni->n", unit, np.linalg.solve(level[sane], unit[:, :, None])[:, :, 0])
    return out


def spread(track: Track, error: Errors) -> Squares:
    """Squared distances of all poses in the ``first minute`` after a fix and ``later``."""
    age = since_fix(track)
    return {
        part: {name: squares(error.twist[mask], track.covariances[mask], axes) for name, axes in AXES.items()}
        for part, mask in zip(PARTS, (age < FIRST_MINUTE, age >= FIRST_MINUTE), strict=True)
    }


def pooled(drives: Sequence[Squares]) -> Squares:
    """Put those of several drives together, and add ``all``, which is both parts."""
    out = {part: {name: np.concatenate([[], *(d[part][name] for d in drives)]) for name in AXES} for part in PARTS}
    return out | {"all": {name: np.concatenate([out[part][name] for part in PARTS]) for name in AXES}}


def coverage(squared: Floats, count: int) -> dict[str, Any]:
    """Shares within 1, 2 and 3 sigma (of ``count`` axes: within the chi-square quantiles of the same shares).

    ``median_nees`` is the median squared distance relative to its nominal value, 1 if the covariance is right; outliers
    do not move it.
    """
    if not len(squared):
        return {"frames": 0, "inside": None, "median_nees": None}
    inside = [float((squared <= limit).mean()) for limit in chi2.ppf(NOMINAL, count)]
    median = float(np.median(squared) / chi2.ppf(0.5, count))
    return {"frames": len(squared), "inside": inside, "median_nees": median if np.isfinite(median) else None}


def shares(squared: Squares) -> dict[str, dict[str, Any]]:
    """Coverage by part and axes."""
    return {
        part: {name: coverage(values, len(AXES[name])) for name, values in by_axes.items()}
        for part, by_axes in squared.items()
    }


def honest(part: dict[str, Any]) -> bool:
    """Whether shares are within :data:`WITHIN` of the promised ones."""
    inside = part["inside"]
    return inside is not None and bool(np.all(np.abs(np.subtract(inside, NOMINAL)) <= WITHIN))


def coverage_table(parts: dict[str, dict[str, Any]]) -> str:
    """Lay out shares in per cent, marked where out of their band; medians of squared distances are 1 if right."""
    columns = (*PARTS, "all")
    head, counts = ["coverage, %", "promised"], ["poses", ""]
    for part in columns:
        head += [part, "median"]
        counts += [str(parts[part]["yaw"]["frames"]), ""]
    rows = []
    for name in AXES:
        row = [name, _percent(NOMINAL)]
        for entry in (parts[part][name] for part in columns):
            mark = "" if entry["inside"] is None or honest(entry) else " !"
            row += [_percent(entry["inside"]) + mark, number(entry["median_nees"], 2)]
        rows.append(row)
    return table(head, [*rows, counts])


def _percent(inside: Sequence[float] | None) -> str:
    return "-" if inside is None else " / ".join(f"{100 * share:.1f}" for share in inside)
