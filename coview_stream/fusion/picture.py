"""Picture of a fused cloud from above: the base map in grey, what runs added, what is new and what is gone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coview_stream.fusion.fuse import Fused
from coview_stream.fusion.records import GONE, NEW, SAME
from coview_stream.report.style import MAX_BASE_POINTS, draw_base_map, figure, legend_below, map_figure_size

_ADDED, _NEW, _GONE = "#56B4E9", "#009E73", "#D55E00"
_MOST = 200_000  # points drawn of a kind; set by hand


def draw_fused(fused: Fused, path: Path, title: str) -> None:
    """Draw it.

    Raises:
        InputError: the picture cannot be written. DependencyError: matplotlib is missing.
    """
    base_map = fused.base_map
    base = base_map.sampled_points(MAX_BASE_POINTS) + base_map.origin
    gone = np.asarray(base_map.points[np.flatnonzero(fused.base_change == GONE)])
    kinds = (
        (f"added by runs: {int((fused.change == SAME).sum()):,} points", fused.points[fused.change == SAME], _ADDED),
        (f"new: {int((fused.change == NEW).sum()):,}", fused.points[fused.change == NEW], _NEW),
        (f"gone: {len(gone):,}", gone, _GONE),
    )
    with figure(path, figsize=map_figure_size(base)) as (drawing, axes):
        shift = draw_base_map(axes, base)
        for label, points, colour in kinds:
            if len(points):
                some = points[:: -(-len(points) // _MOST)] + base_map.origin - shift
                axes.scatter(some[:, 0], some[:, 1], s=0.5, color=colour, linewidths=0, label=label, rasterized=True)
        axes.set_title(title)
        legend_below(drawing, axes)
