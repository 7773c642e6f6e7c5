"""Style of the pictures: figure size, type, colours that colour-blind readers tell apart, the grey base map."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.errors import InputError, naming_missing_libraries
from coview_stream.geometry.arrays import Floats, Reals

STATE_COLOURS = {"SEARCHING": "#999999", "AMBIGUOUS": "#E69F00", "TRACKING": "#0072B2", "LOST": "#D55E00"}
"""Colours of Okabe and Ito: distinct in every common form of colour blindness."""

TRUTH = "#000000"
ACCENT = "#009E73"

MAX_BASE_POINTS = 1_000_000
"""A base map is thinned to this many points, set by hand: more do not show in a picture of 800 cells across."""

_GROUND_WINDOW = 25.0  # metres, set by hand; terrain changes little over it, and few buildings are wider

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
}


@contextmanager
def figure(path: str | os.PathLike[str], **options: Any) -> Iterator[tuple[Any, Any]]:
    """Give a figure and its axes, and save them as ``path`` when the block ends.

    The Agg canvas is used directly: neither the caller's backend nor pyplot's state is touched.

    Raises:
        InputError: the picture cannot be written.
    """
    with naming_missing_libraries("pictures"):
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    rows, columns = options.pop("nrows", 1), options.pop("ncols", 1)
    axes_options = options.pop("axes", {})
    with mpl.rc_context(_STYLE):
        drawing = Figure(**options)
        FigureCanvasAgg(drawing)
        yield drawing, drawing.subplots(rows, columns, **axes_options)
        try:
            drawing.savefig(Path(path))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path}: cannot be written ({error}); use .png, an existing directory and a disk with room"
            ) from error


def draw_base_map(axes: Any, points: Reals) -> Floats:
    """Draw (N, 3) base map points from above, darker the higher they stand over their surroundings.

    Returns the offset (3,) subtracted from the coordinates: far from zero (UTM) they are shifted by a round number,
    named in the axis labels; ticks with seven digits cannot be read.
    """
    shift = base_shift(points)
    if len(points):
        sample = np.asarray(points[:: max(1, -(-len(points) // MAX_BASE_POINTS))], dtype=np.float64) - shift
        grey, extent = _shaded(sample)
        # one colour where nothing was measured, so that holes look like holes
        axes.imshow(grey.T, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(_axis_label("east", shift[0]))
    axes.set_ylabel(_axis_label("north", shift[1]))
    return shift


def _shaded(points: Floats) -> tuple[Any, tuple[float, float, float, float]]:
    """Return grey values [x, y] in 0..1, masked where empty, and the extent (left, right, bottom, top), metres."""
    from scipy.ndimage import grey_closing, minimum_filter

    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    side = np.maximum(high - low, 1.0)
    # not finer than the picture's pixels, nor than the points lie
    cell = max(float(side.max()) / 800.0, float(np.sqrt(side.prod() / len(points))))
    shape = (side / cell).astype(int) + 1
    i, j = ((points[:, :2] - low) / cell).astype(int).T
    order = np.argsort(points[:, 2], kind="stable")  # the highest point of a cell is written last
    heights = np.full(shape, -np.inf)
    heights[i[order], j[order]] = points[order, 2]
    heights = np.where(np.isinf(heights), grey_closing(heights, size=(3, 3)), heights)
    known = np.isfinite(heights)
    window = max(3, int(_GROUND_WINDOW / cell))
    above = np.where(known, heights, 0.0) - minimum_filter(np.where(known, heights, np.inf), size=window)
    tall = max(float(np.percentile(above[known], 98)), 0.5)
    grey = 0.93 - 0.55 * np.clip(above / tall, 0.0, 1.0) ** 0.7
    top = low + shape * cell
    return np.where(known, grey, np.nan), (float(low[0]), float(top[0]), float(low[1]), float(top[1]))


def map_figure_size(points: Reals) -> tuple[float, float]:
    """Return width and height of a map's figure, inches: a road corridor needs less height than a square."""
    if not len(points):
        return 8.0, 8.6
    east, north = np.maximum(np.ptp(np.asarray(points[:, :2], dtype=np.float64), axis=0), 1.0)
    ratio = float(np.clip(north / east, 0.35, 1.6))
    wide = 8.0 if ratio > 0.7 else 11.0
    return wide, min(wide * ratio, 10.5) + 0.9


def base_shift(points: Reals) -> Floats:
    """Return the (3,) round offset to subtract before drawing; zeros where coordinates are short enough to read."""
    if not len(points):
        return np.zeros(3)
    middle = np.median(np.asarray(points, dtype=np.float64), axis=0)
    shift = np.round(middle / 100.0) * 100.0
    shift[2] = 0.0
    return np.where(np.abs(middle) > 10_000.0, shift, 0.0)


def _axis_label(name: str, shift: float) -> str:
    if not shift:
        return f"{name} [m]"
    sign = "-" if shift > 0 else "+"
    return f"{name} {sign} {abs(shift):,.0f} [m]".replace(",", " ")


def draw_notice(axes: Any, text: str) -> None:
    """Write a text across the middle of a picture that would else be empty."""
    axes.text(
        0.5,
        0.5,
        text,
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=13,
        fontweight="bold",
        bbox={"facecolor": "white", "edgecolor": STATE_COLOURS["LOST"], "boxstyle": "round,pad=0.6"},
    )


def legend_below(drawing: Any, axes: Any, title: str | None = None) -> None:
    """Put the legend under the picture, where it hides nothing, with marks of one readable size."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        place = {"loc": "outside lower center", "ncols": 2, "title": title}
        legend = drawing.legend(handles, labels, fontsize=10, title_fontsize=10, **place)
        _even_marks(legend)


def legend_above(axes: Any) -> None:
    """Put the legend on the right above the axes, beside the title."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
        _even_marks(axes.legend(handles, labels, ncols=len(labels), fontsize=9, **place))


def _even_marks(legend: Any) -> None:
    for handle in legend.legend_handles:
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([28.0])
