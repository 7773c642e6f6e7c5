"""Report of a map's ambiguity: a sentence, numbers for each station, and a picture."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.file_format import release_arrays
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.localization.search.ambiguity import FARTHEST, Ambiguity
from coview_stream.report.plots import (
    MAX_BASE_POINTS,
    draw_base_map,
    draw_notice,
    figure,
    legend_below,
    map_figure_size,
)

_LIMITS = {0.0: "#0072B2", 5.0: "#56B4E9", 10.0: "#009E73", 20.0: "#F0E442", 40.0: "#E69F00", math.inf: "#D55E00"}
"""Colours (Okabe and Ito) of the stations from which a robot has to drive at most so many metres until found."""

_AREA = 50.0  # metres: stations within this distance form one part of the site


def summary(result: Ambiguity, base_map: BaseMap) -> str:
    """Summarize in one line the shares of stations where a robot is found at once, later, or never."""
    if not len(result):
        return "no stations"
    metres = float(np.max(result.drive, initial=0.0, where=np.isfinite(result.drive)))
    at_once, later, never = _percents([result.share(0.0), result.share(metres), 1.0])
    parts = [f"{at_once} of {len(result):,} places are told apart at once"]
    if metres > 0.0:
        parts.append(f"{later} after driving up to {metres:.0f} m")
    if np.isinf(result.drive).any():
        parts.append(f"{never} stay ambiguous for {FARTHEST:.0f} m or to the end of the way")
    text = ", ".join(parts)
    if result.wrong.any():
        text += f"; at {int(result.wrong.sum())} another place would be taken"
    slow = result.drive > 0.0
    if slow.any():
        x, y = _worst(result, slow) + base_map.origin[:2]
        text += f"; worst around {x:.0f}, {y:.0f}"
    return f"{text} (risk {result.risk:g}, {_percents([result.changed])[0]} of the site presumed changed)"


def facts(result: Ambiguity, base_map: BaseMap) -> dict[str, Any]:
    """Return the numbers for JSON; metres in the source's frame, nats; null for a robot that is not found."""
    position = result.position + base_map.origin
    stations = [
        {
            "station": int(result.station[k]),
            "position": [round(float(v), 2) for v in position[k]],
            "drive": float(result.drive[k]) if np.isfinite(result.drive[k]) else None,
            "tried": bool(result.driven[k]),
            "evidence": round(float(result.evidence[k]), 2),
            "lead": round(float(result.lead[k]), 2),
            "error": float(result.error[k]),
            "wrong": bool(result.wrong[k]),
        }
        for k in range(len(result))
    ]
    within = {f"{limit:g}": result.share(limit) for limit in _LIMITS if math.isfinite(limit)}
    return {
        "summary": summary(result, base_map), "risk": result.risk, "changed": result.changed, "within": within,
        "never": float(np.isinf(result.drive).mean()) if len(result) else 0.0, "stations": stations,
    }  # fmt: skip


def plot_ambiguity(result: Ambiguity, base_map: BaseMap, path: str | os.PathLike[str], title: str) -> None:
    """Draw the map in grey, and its stations coloured by the distance that a robot has to drive from them.

    InputError if the picture cannot be written.
    """
    release_arrays(base_map.arrays)  # memory of the search
    base = base_map.sampled_points(MAX_BASE_POINTS) + base_map.origin
    release_arrays(base_map.arrays)
    with figure(path, figsize=map_figure_size(base)) as (drawing, axes):
        shift = draw_base_map(axes, base)
        at = result.position + base_map.origin - shift
        size = float(np.clip(16_000.0 / max(len(at), 1), 6.0, 30.0))
        before, shares = -math.inf, _percents([result.share(limit) for limit in _LIMITS])
        for (limit, colour), share in zip(_LIMITS.items(), shares, strict=True):
            here = (result.drive > before) & (result.drive <= limit)
            label, before = f"{_name(before, limit)}: {share}", limit
            if here.any():
                axes.scatter(at[here, 0], at[here, 1], s=size, color=colour, linewidths=0, label=label, zorder=3)
        if not len(result):
            draw_notice(axes, "no stations")
        axes.set_title(f"{title}: metres to drive until found")
        legend_below(drawing, axes, "a robot that sets out here is found (share of all places looked at)")


def _name(before: float, limit: float) -> str:
    if limit == 0.0:
        return "at once"
    return f"after {before:.0f} to {limit:.0f} m" if math.isfinite(limit) else f"not within {before:.0f} m"


def _worst(result: Ambiguity, slow: Bools) -> Floats:
    """Return the centre (2,) of the part of the site with the longest drives."""
    xy, metres = result.position[slow, :2], np.minimum(result.drive[slow], 2.0 * FARTHEST)
    cell = np.unique(np.floor(xy / _AREA), axis=0, return_inverse=True)[1].ravel()
    worst = cell == np.bincount(cell, weights=metres).argmax()
    return np.asarray(np.median(xy[worst], axis=0))


def _percents(until: Sequence[float]) -> list[str]:
    """Format the parts between cumulative shares as percentages that add up; only an empty part gets "0 %"."""
    parts = zip(np.diff(until, prepend=0.0), np.diff(np.rint(100.0 * np.array(until)), prepend=0.0), strict=True)
    limits = {0.0: "under 1 %", 100.0: "over 99 %"}
    return [limits.get(part, f"{part:.0f} %") if 0.0 < share < 1.0 else f"{part:.0f} %" for share, part in parts]
