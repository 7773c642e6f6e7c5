"""Whether a reported covariance is honest: how often the truth lies within what it promises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from bench.harness.tables import number, table
from bench.harness.trajectory_scores import Errors, Told
from coview_stream.geometry.arrays import Bools, Floats

FIRST_MINUTE = 60.0  # seconds after a fix in which its covariance is judged apart

NOMINAL = tuple(float(p) for p in chi2.cdf([1.0, 4.0, 9.0], 1))  # shares that 1, 2 and 3 sigma promise

AXES: dict[str, tuple[int, ...]] = {
    "x": (0,), "y": (1,), "z": (2,), "roll": (3,), "pitch": (4,), "yaw": (5,),
    "x,y": (0, 1), "x,y,z": (0, 1, 2), "pose": (0, 1, 2, 3, 4, 5),
}  # fmt: skip
"""What coverage is judged of: one axis alone, or several by their squared Mahalanobis distance."""

WITHIN = 0.05  # share by which an observed coverage may differ from the nominal one

_SHOWN = {"x,y": "#0072B2", "x,y,z": "#009E73", "yaw": "#D55E00"}
_LEAST = 20  # frames that make a curve


def since_fix(told: Told) -> Floats:
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
    error = twist[:, pick]
    cov = covariances[:, pick[:, None], pick]
    out = np.full(len(twist), np.inf)
    sane: Bools = np.asarray(np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(error).all(axis=1))
    cov = np.where(sane[:, None, None], cov, np.eye(len(pick)))
    # metres stand beside radians: compare each by its own size
    scale = np.sqrt(np.abs(np.einsum("nii->ni", cov)))
    scale = np.where(scale > 0, scale, 1.0)
    level = cov / (scale[:, :, None] * scale[:, None, :])
    sane = np.asarray(sane & (np.linalg.eigvalsh(level)[:, 0] > 1e-12))
    unit = (error / scale)[sane]
    out[sane] = np.einsum("ni,ni->n", unit, np.linalg.solve(level[sane], unit[:, :, None])[:, :, 0])
    return out


def spread(told: Told, error: Errors) -> dict[str, dict[str, Floats]]:
    """Squared distances of all poses by name of the axes, in the ``first minute`` after a fix and ``later``."""
    age = since_fix(told)
    parts: dict[str, Bools] = {"first minute": np.asarray(age < FIRST_MINUTE), "later": np.asarray(age >= FIRST_MINUTE)}
    return {
        part: {n: squares(error.twist[mask], told.covariances[mask], axes) for n, axes in AXES.items()}
        for part, mask in parts.items()
    }


def pooled(parts: Sequence[Mapping[str, Mapping[str, Floats]]]) -> dict[str, dict[str, Floats]]:
    """Put those of several drives together, and add ``all``, which is both parts."""
    names = ("first minute", "later")
    out = {p: {n: np.concatenate([[], *(d[p][n] for d in parts)]) for n in AXES} for p in names}
    out["all"] = {n: np.concatenate([out[p][n] for p in names]) for n in AXES}
    return out


def coverage(squared: Floats, count: int) -> dict[str, Any]:
    """Shares within 1, 2 and 3 sigma (of ``count`` axes: within the chi-square quantiles of the same shares).

    ``nees`` is the mean squared distance per axis, 1 if the covariance is right; ``median_nees`` the median relative to
    its own nominal value, which outliers do not move.
    """
    if not len(squared):
        return {"frames": 0, "inside": None, "nees": None, "median_nees": None}
    limits = chi2.ppf(NOMINAL, count)
    return {
        "frames": len(squared),
        "inside": [float((squared <= limit).mean()) for limit in limits],
        "nees": _finite(squared.mean() / count),
        "median_nees": _finite(np.median(squared) / chi2.ppf(0.5, count)),
    }


def shares(squared: Any) -> dict[str, dict[str, Any]]:
    """Coverage by part and axes."""
    return {
        part: {name: coverage(values, len(AXES[name])) for name, values in by_axes.items()}
        for part, by_axes in squared.items()
    }


def coverage_table(found: dict[str, dict[str, Any]]) -> str:
    """Lay out shares in per cent, marked where out of their band; medians of squared distances are 1 if right."""
    head = ("coverage, %", "promised", "first minute", "median", "later", "median", "all", "median")
    promised = " / ".join(f"{100 * p:.1f}" for p in NOMINAL)
    rows = []
    for name in AXES:
        parts = [found[part][name] for part in ("first minute", "later", "all")]
        rows.append((name, promised, *(text for part in parts for text in (_shares(part), _nees(part)))))
    counts = [str(found[part]["yaw"]["frames"]) for part in ("first minute", "later", "all")]
    rows.append(("poses", "", counts[0], "", counts[1], "", counts[2], ""))
    return table(head, rows)


def _shares(part: dict[str, Any]) -> str:
    if part["inside"] is None:
        return "-"
    mark = "" if honest(part) else " !"
    return " / ".join(f"{100 * share:.1f}" for share in part["inside"]) + mark


def _nees(part: dict[str, Any]) -> str:
    return number(part["median_nees"], 2)


def honest(part: dict[str, Any]) -> bool:
    """Whether shares are within :data:`WITHIN` of the promised ones."""
    inside = part["inside"]
    return inside is not None and bool(np.all(np.abs(np.subtract(inside, NOMINAL)) <= WITHIN))


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def draw(spread: Mapping[str, Mapping[str, Floats]], path: Path, title: str) -> None:
    """Draw observed over nominal coverage for position and yaw, in the first minute after a fix and later.

    Args:
        spread: squared distances by part and axes, see :func:`pooled`.
        path: picture to write.
        title: what was measured.

    Raises:
        InputError: the picture cannot be written.
    """
    from coview_stream.report.style import TRUTH, draw_notice, figure

    nominal = np.linspace(0.0, 1.0, 201)
    with figure(path, figsize=(9.6, 5.0), ncols=2, axes={"sharey": True}) as (drawing, both):
        for axes, part in zip(both, ("first minute", "later"), strict=True):
            band = np.clip([nominal - WITHIN, nominal + WITHIN], 0.0, 1.0)
            axes.fill_between(nominal, *band, color="#dddddd", linewidth=0, label="within 5 points")
            axes.plot(nominal, nominal, color=TRUTH, linestyle="--", linewidth=1.0, label="as promised")
            count = len(spread[part]["yaw"])
            for name, colour in _SHOWN.items():
                if count >= _LEAST:
                    _curve(axes, spread[part][name], name, colour, nominal)
            if count < _LEAST:
                draw_notice(axes, "too few poses")
            axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="promised share", aspect="equal")
            axes.set_title(f"{part} after a fix, {count} poses" if part != "later" else f"{part}, {count} poses")
            axes.set_xticks([0, 0.25, 0.5, *NOMINAL[:2]], ["0", ".25", ".5", "1$\\sigma$", "2$\\sigma$"])
            axes.grid(True, color="#eeeeee", linewidth=0.6)
        both[0].set_ylabel("observed share")
        both[0].legend(fontsize=9, loc="lower right")
        drawing.supxlabel(title, fontsize=8, color="#666666", family="DejaVu Sans Mono")


def _curve(axes: Any, squared: Floats, name: str, colour: str, nominal: Floats) -> None:
    dof = len(AXES[name])
    observed = np.searchsorted(np.sort(squared), chi2.ppf(nominal, dof), side="right") / len(squared)
    axes.plot(nominal, observed, color=colour, linewidth=1.8, label=name)
    marks = [(squared <= chi2.ppf(p, dof)).mean() for p in NOMINAL]
    axes.plot(NOMINAL, marks, "o", color=colour, markersize=5)
