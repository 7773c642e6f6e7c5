"""The picture of ``bench.tracking``: how often the truth lies within what the covariance promises."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from bench.harness.trajectory_scores import Floats
from bench.tracking.coverage import AXES, NOMINAL, WITHIN

_SHOWN = {"x,y": "#0072B2", "x,y,z": "#009E73", "yaw": "#D55E00"}
_LEAST = 20  # frames that make a curve


def draw(spread: Mapping[str, Mapping[str, Floats]], path: Path, title: str) -> None:
    """Draw observed over nominal coverage for position and yaw, in the first minute after a fix and later.

    Args:
        spread: squared distances by part and axes, see :func:`bench.tracking_coverage.pooled`.
        path: picture to write.
        title: what was measured.

    Raises:
        InputError: the picture cannot be written.
    """
    from coview_stream.report.style import TRUTH, figure, say

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
                say(axes, "too few poses")
            axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="promised share", aspect="equal")
            axes.set_title(
                f"{part} after a fix, {count} poses" if part != "later" else f"{part}, {count} poses"
            )
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
