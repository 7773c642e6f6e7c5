"""Whether a reported covariance is honest: how often the truth lies within what it promises."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from bench.accuracy.scores import Errors, Track
from bench.harness.rows import number, table
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.report.style import TRUTH, draw_notice, figure

FIRST_MINUTE = 60.0  # seconds after a fix in which its covariance is judged apart
PARTS = ("first minute", "later")

NOMINAL = tuple(float(p) for p in chi2.cdf([1.0, 4.0, 9.0], 1))  # shares that 1, 2 and 3 sigma promise

AXES: dict[str, tuple[int, ...]] = {
    "x": (0,), "y": (1,), "z": (2,), "roll": (3,), "pitch": (4,), "yaw": (5,),
    "x,y": (0, 1), "x,y,z": (0, 1, 2), "pose": (0, 1, 2, 3, 4, 5),
}  # fmt: skip
"""What coverage is judged of: one axis alone, or several by their squared Mahalanobis distance."""

WITHIN = 0.05  # share by which an observed coverage may differ from the nominal one

_SHOWN = {"x,y": "#0072B2", "x,y,z": "#009E73", "yaw": "#D55E00"}
_MIN_FRAMES = 20  # that make a curve

Squares = dict[str, dict[str, Floats]]
"""Squared Mahalanobis distances of poses, by part of the time since a fix and by name of the axes."""


def since_fix(told: Track) -> Floats:
    """(N,) seconds since the fix that each pose goes back to, NaN where there is none.

    A fix is the first pose after a search (SEARCHING or LOST); a doubt in between does not end it.
    """
    out = np.full(len(told.stamps), np.nan)
    fixed: float | None = None
    for k, (state, known) in enumerate(zip(told.states, told.tracking, strict=True)):
        if state in ("SEARCHING", "LOST"):
            fixed = None
        elif known:
            fixed = float(told.stamps[k]) if fixed is None else fixed
            out[k] = told.stamps[k] - fixed
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


def spread(told: Track, error: Errors) -> Squares:
    """Squared distances of all poses in the ``first minute`` after a fix and ``later``."""
    age = since_fix(told)
    return {
        part: {name: squares(error.twist[mask], told.covariances[mask], axes) for name, axes in AXES.items()}
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


def coverage_table(found: dict[str, dict[str, Any]]) -> str:
    """Lay out shares in per cent, marked where out of their band; medians of squared distances are 1 if right."""
    parts = (*PARTS, "all")
    head, counts = ["coverage, %", "promised"], ["poses", ""]
    for part in parts:
        head += [part, "median"]
        counts += [str(found[part]["yaw"]["frames"]), ""]
    rows = []
    for name in AXES:
        row = [name, _percent(NOMINAL)]
        for each in (found[part][name] for part in parts):
            mark = "" if each["inside"] is None or honest(each) else " !"
            row += [_percent(each["inside"]) + mark, number(each["median_nees"], 2)]
        rows.append(row)
    return table(head, [*rows, counts])


def _percent(inside: Sequence[float] | None) -> str:
    return "-" if inside is None else " / ".join(f"{100 * share:.1f}" for share in inside)


def draw(spread: Squares, path: Path, title: str) -> None:
    """Draw observed over nominal coverage for position and yaw, by part of the time (see :func:`pooled`)."""
    nominal = np.linspace(0.0, 1.0, 201)
    with figure(path, figsize=(9.6, 5.0), ncols=2, axes={"sharey": True}) as (drawing, both):
        for axes, part, after in zip(both, PARTS, (" after a fix", ""), strict=True):
            band = np.clip([nominal - WITHIN, nominal + WITHIN], 0.0, 1.0)
            axes.fill_between(nominal, *band, color="#dddddd", linewidth=0, label="within 5 points")
            axes.plot(nominal, nominal, color=TRUTH, linestyle="--", linewidth=1.0, label="as promised")
            count = len(spread[part]["yaw"])
            for name, colour in _SHOWN.items() if count >= _MIN_FRAMES else ():
                ranked, dof = np.sort(spread[part][name]), len(AXES[name])
                for at, style in ((nominal, {"linewidth": 1.8, "label": name}), (NOMINAL, {"marker": "o", "ls": ""})):
                    observed = np.searchsorted(ranked, chi2.ppf(at, dof), side="right") / count
                    axes.plot(at, observed, color=colour, markersize=5, **style)
            if count < _MIN_FRAMES:
                draw_notice(axes, "too few poses")
            axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="promised share", aspect="equal")
            axes.set_title(f"{part}{after}, {count} poses")
            axes.set_xticks([0, 0.25, 0.5, *NOMINAL[:2]], ["0", ".25", ".5", "1$\\sigma$", "2$\\sigma$"])
            axes.grid(True, color="#eeeeee", linewidth=0.6)
        both[0].set_ylabel("observed share")
        both[0].legend(fontsize=9, loc="lower right")
        drawing.supxlabel(title, fontsize=8, color="#666666", family="DejaVu Sans Mono")
