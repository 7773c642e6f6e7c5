"""Pictures of maps, trajectories, errors and descriptors, as PNG files.

All functions take plain arrays in metres and radians, and work without a display.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.basemap import BaseMap, station_descriptors
from coview_stream.basemap.file_format import release_arrays
from coview_stream.errors import InputError, counted, naming_missing_libraries
from coview_stream.geometry.arrays import Bools, Floats, Reals
from coview_stream.localization.offline import DESCRIPTORS_PNG, TRAJECTORY_PNG, RunResult
from coview_stream.report.evaluation import MAX_ROTATION, MAX_TRANSLATION

STATE_COLOURS = {"SEARCHING": "#999999", "AMBIGUOUS": "#E69F00", "TRACKING": "#0072B2", "LOST": "#D55E00"}
"""Colours of Okabe and Ito: distinct in every common form of colour blindness."""

TRUTH = "#000000"
ACCENT = "#009E73"

MAX_BASE_POINTS = 1_000_000
"""A base map is thinned to this many points: more do not show in a picture 800 cells across."""

_UNLIKELY = 0.01  # least probability of places that are drawn
_GROUND_WINDOW = 25.0  # metres; terrain changes little over this distance, and few buildings are wider

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
    """Yield a figure and its axes, and save the figure as ``path`` when the block ends.

    The Agg canvas is used directly: neither the caller's backend nor pyplot's state is touched. InputError if the
    picture cannot be written.
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

    Returns the offset (3,) subtracted from the coordinates. Large coordinates (UTM) are shifted by a round number that
    the axis labels name, because ticks with seven digits are unreadable.
    """
    shift = base_shift(points)
    if len(points):
        sample = np.asarray(points[:: max(1, -(-len(points) // MAX_BASE_POINTS))], dtype=np.float64) - shift
        grey, extent = _shaded(sample)
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
    # no finer than the picture's pixels or the spacing of the points
    cell = max(float(side.max()) / 800.0, float(np.sqrt(side.prod() / len(points))))
    shape = (side / cell).astype(int) + 1
    i, j = ((points[:, :2] - low) / cell).astype(int).T
    order = np.argsort(points[:, 2], kind="stable")  # the highest point of a cell is written last
    heights = np.full(shape, -np.inf)
    heights[i[order], j[order]] = points[order, 2]
    heights = np.where(np.isinf(heights), grey_closing(heights, size=(3, 3)), heights)
    measured = np.isfinite(heights)
    window = max(3, int(_GROUND_WINDOW / cell))
    above = np.where(measured, heights, 0.0) - minimum_filter(np.where(measured, heights, np.inf), size=window)
    tall = max(float(np.percentile(above[measured], 98)), 0.5)
    grey = 0.93 - 0.55 * np.clip(above / tall, 0.0, 1.0) ** 0.7
    top = low + shape * cell
    return np.where(measured, grey, np.nan), (float(low[0]), float(top[0]), float(low[1]), float(top[1]))


def map_figure_size(points: Reals) -> tuple[float, float]:
    """Return width and height of a map's figure, inches; a road corridor needs less height than a square."""
    if not len(points):
        return 8.0, 8.6
    east, north = np.maximum(np.ptp(np.asarray(points[:, :2], dtype=np.float64), axis=0), 1.0)
    ratio = float(np.clip(north / east, 0.35, 1.6))
    wide = 8.0 if ratio > 0.7 else 11.0
    return wide, min(wide * ratio, 10.5) + 0.9


def base_shift(points: Reals) -> Floats:
    """Return the round offset (3,) to subtract before drawing; zero if the coordinates are short enough to read."""
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
    """Write a text into the middle of an empty picture."""
    box = {"facecolor": "white", "edgecolor": STATE_COLOURS["LOST"], "boxstyle": "round,pad=0.6"}
    style = {"ha": "center", "va": "center", "fontsize": 13, "fontweight": "bold", "bbox": box}
    axes.text(0.5, 0.5, text, transform=axes.transAxes, **style)


def legend_below(drawing: Any, axes: Any, title: str | None = None) -> None:
    """Put the legend below the picture, where it hides nothing, with marks of one readable size."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        place = {"loc": "outside lower center", "ncols": 2, "title": title}
        _even_marks(drawing.legend(handles, labels, fontsize=10, title_fontsize=10, **place))


def _even_marks(legend: Any) -> None:
    for handle in legend.legend_handles:
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([28.0])


def plot_trajectory(
    base: Reals, positions: Reals, states: Sequence[str], path: str | os.PathLike[str], truth: Reals | None = None,
    places: Reals | None = None, reason: str = "",
) -> None:  # fmt: skip
    """Draw a trajectory over the grey base map, coloured by state.

    Args:
        base: (N, 3) base map points, metres.
        positions: (K, 3) map positions of the robot, one per frame; NaN if it was not localized: such a frame is not
            drawn, but counted in the legend.
        states: K states, SEARCHING, AMBIGUOUS, TRACKING or LOST.
        path: picture to write.
        truth: (T, 3) true positions, if known.
        places: (P, 6) probable places of :class:`~coview_stream.localization.search.acceptance.Considered`.
        reason: why there is no pose; printed under the title.

    Raises:
        InputError: the numbers of states and positions differ, or the picture cannot be written.
    """
    if len(positions) != len(states):
        raise InputError(f"{path}: {len(states)} states for {len(positions)} positions; give as many of both")
    positions = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    drawn: Bools = np.asarray(np.isfinite(positions).all(axis=1))
    with figure(path, figsize=map_figure_size(base)) as (drawing, axes):
        shift = draw_base_map(axes, base)
        if truth is not None and len(truth):
            line = np.asarray(truth, dtype=np.float64) - shift
            axes.plot(line[:, 0], line[:, 1], color=TRUTH, linewidth=1.0, linestyle=(0, (4, 2)), label="truth")
        _draw_states(axes, positions - shift, drawn, np.asarray(states, dtype=object))
        _draw_line(axes, positions[:, :2] - shift[:2], drawn)
        if places is not None:
            _draw_places(axes, np.asarray(places, dtype=np.float64), shift)
        elif not drawn.any():
            draw_notice(axes, "not localized: no frame has a pose")
        below = textwrap.wrap(reason, 95)
        axes.text(0.0, 1.01, "\n".join(below), transform=axes.transAxes, fontsize=9)
        axes.set_title("Trajectory" if drawn.any() else "Not localized", pad=6 + 13 * len(below))
        legend_below(drawing, axes)


def _draw_states(axes: Any, positions: Reals, drawn: Bools, states: npt.NDArray[np.object_]) -> None:
    names = [*STATE_COLOURS, *sorted(set(states) - set(STATE_COLOURS))]
    for name in names:
        here = states == name
        if not here.any():
            continue
        without = int((here & ~drawn).sum())
        label = f"{name}: {counted(int(here.sum()), 'frame')}" + (f", {without} without a pose" if without else "")
        style = {"s": 12, "color": STATE_COLOURS.get(str(name), ACCENT), "linewidths": 0, "zorder": 3}
        axes.scatter(*positions[here & drawn, :2].T, label=label, **style)
    if drawn.any():
        first = positions[np.argmax(drawn), :2]
        axes.scatter(*first, s=90, facecolors="none", edgecolors=TRUTH, label="first pose", zorder=4)


def _draw_line(axes: Any, positions: Reals, drawn: Bools) -> None:
    """Join positions (K, 2); gaps (NaN) get a dotted line, and a cross where the poses end."""
    lost, ends = STATE_COLOURS["LOST"], positions[:-1][drawn[:-1] & ~drawn[1:]]
    axes.plot(*positions[drawn].T, color=lost, linestyle=":", zorder=1)
    axes.plot(*positions.T, color=STATE_COLOURS["TRACKING"], zorder=2)
    if len(ends):
        label = f"poses end ({len(ends)} x), dotted to the next"
        axes.scatter(*ends.T, s=70, marker="x", color=lost, label=label, zorder=4)


def _draw_places(axes: Any, places: Floats, shift: Floats) -> None:
    """Draw probable places (P, 6) on the map as discs, larger if more probable, with a line along the heading."""
    low, high = axes.dataLim.get_points()
    at = places[:, :2] - shift[:2]
    shown = (at >= low).all(axis=1) & (at <= high).all(axis=1) & (places[:, 4] >= _UNLIKELY)
    if not shown.any():
        draw_notice(axes, f"no place above {_UNLIKELY * 100:g} %")
        return
    (x, y), yaw, probability = at[shown].T, places[shown, 3], places[shown, 4]
    label = "places that may fit, no pose; probability"
    style = {"color": STATE_COLOURS["AMBIGUOUS"], "zorder": 4}
    for *xy, p in zip(x, y, probability, strict=True):
        axes.annotate(f"{p:.0%}", xy, (6, 4), textcoords="offset points", fontsize=8, zorder=5)
    axes.scatter(x, y, s=20.0 + 200.0 * probability, edgecolors=TRUTH, linewidths=0.6, label=label, **style)
    axes.quiver(x, y, np.cos(yaw), np.sin(yaw), scale=30, width=0.004, headwidth=3, **style)


def plot_errors(distance: Reals, e_t: Reals, e_r: Reals, path: str | os.PathLike[str]) -> None:
    """Draw translation errors (N,) in metres and rotation errors (N,) in radians over (N,) metres driven.

    InputError if the picture cannot be written.
    """
    wrong = (e_t >= MAX_TRANSLATION) | (e_r >= MAX_ROTATION)
    rows = (
        (e_t, "translation error [m]", MAX_TRANSLATION, STATE_COLOURS["TRACKING"]),
        (np.degrees(e_r), "rotation error [deg]", float(np.degrees(MAX_ROTATION)), ACCENT),
    )
    options = {"figsize": (9, 5.5), "nrows": 2, "axes": {"sharex": True}}
    with figure(path, **options) as (_, panels):
        for axes, (values, label, limit, colour) in zip(panels, rows, strict=True):
            axes.grid(color="#DDDDDD", linewidth=0.6)
            axes.set_ylabel(label)
            if not len(values):
                draw_notice(axes, "no pose to compare")
                axes.set_yticks([])
                continue
            named = f"right poses, mean {values[~wrong].mean():.3f}" if (~wrong).any() else "right poses"
            axes.scatter(distance[~wrong], values[~wrong], s=7, color=colour, linewidths=0, label=named)
            _draw_false(axes, distance[wrong], values[wrong], limit)
            handles, labels = axes.get_legend_handles_labels()
            place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}  # next to the title
            _even_marks(axes.legend(handles, labels, ncols=len(labels), fontsize=9, **place))
        panels[0].set_title("Errors over the distance driven")
        panels[1].set_xlabel("distance driven [m]")


def _draw_false(axes: Any, distance: Reals, values: Reals, limit: float) -> None:
    """Mark false poses and the limit they exceed, on a log axis, as metres stand next to millimetres."""
    if not len(values):
        axes.set_ylim(bottom=0.0)
        return
    colour = STATE_COLOURS["LOST"]
    axes.scatter(distance, values, s=26, marker="x", color=colour, label=f"{len(values)} false poses")
    axes.axhline(limit, color=colour, linewidth=0.9, linestyle=":", label=f"limit {limit:g}")
    axes.set_yscale("log")
    axes.set_ylim(bottom=max(1e-3, axes.get_ylim()[0]))


def plot_descriptor_pair(
    query: Reals,
    winner: Reals,
    shift: int,
    path: str | os.PathLike[str],
    titles: tuple[str, str] = ("keyframe", "winning station"),
) -> None:
    """Draw two polar descriptors (R, S) side by side on one colour scale.

    Rings run outwards, sectors counter-clockwise from the right. The winner is turned by ``shift`` sectors so that
    equal places look equal: ``np.roll(winner, shift, axis=1)`` puts its column ``j - shift`` on column ``j`` of the
    query. NaN is empty. InputError if the descriptors differ in shape, or the picture cannot be written.
    """
    if query.shape != winner.shape or query.ndim != 2:
        raise InputError(f"descriptors: shapes {query.shape} and {winner.shape} differ; give two (rings, sectors)")
    pair = [np.asarray(query, dtype=np.float64), np.roll(np.asarray(winner, dtype=np.float64), shift, axis=1)]
    finite = np.concatenate([values[np.isfinite(values)] for values in pair])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    rings, sectors = query.shape
    edges = np.linspace(0, 2 * np.pi, sectors + 1), np.arange(rings + 1)
    options = {"figsize": (10, 5.2), "ncols": 2, "axes": {"subplot_kw": {"projection": "polar"}}}
    turned = f"{titles[1]}, turned by {shift * 360.0 / sectors:g}°"
    with figure(path, **options) as (drawing, panels):
        for axes, values, title in zip(panels, pair, (titles[0], turned), strict=True):
            axes.set_facecolor("#EEEEEE")
            axes.grid(False)
            shown = np.where(np.isfinite(values), values, np.nan)
            image = axes.pcolormesh(*edges, shown, cmap="viridis", vmin=low, vmax=high or 1.0, rasterized=True)
            axes.set_yticks([])
            axes.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"], color="#555555")
            axes.spines["polar"].set_visible(False)
            axes.set_title(title, loc="center")
        drawing.colorbar(image, ax=list(panels), shrink=0.75, label="bin value")


def draw_run(result: RunResult, base_map: BaseMap, folder: Path, truth: Reals | None = None) -> None:
    """Draw ``trajectory.png`` and, after a fix, ``descriptors.png`` into an existing folder.

    ``truth`` has true positions (T, 3) in the map frame, metres. InputError if a picture cannot be written.
    """
    no_position = np.full(3, np.nan)
    smoothed = {pose.stamp: pose for pose in result.smoothed or ()}
    poses = [fix if result.smoothed is None else smoothed.get(fix.stamp) for fix in result.fixes]
    positions = np.array([no_position if p is None or p.T_map_body is None else p.T_map_body[:3, 3] for p in poses])
    release_arrays(base_map.arrays)  # free the search's memory before pictures take as much
    points = base_map.sampled_points(MAX_BASE_POINTS) + base_map.origin
    release_arrays(base_map.arrays)
    states = [
        str(smoothed[fix.stamp].kind) if fix.T_map_body is None and fix.stamp in smoothed else fix.state.reported
        for fix in result.fixes
    ]
    places = None if result.considered is None else result.considered.places
    plot_trajectory(points, positions, states, folder / TRAJECTORY_PNG, truth, places, result.reason)
    winner = result.winner
    if winner is not None and winner.station is not None and winner.shift is not None and result.query:
        channel = next(iter(result.query))
        station = station_descriptors(base_map, winner.station)[channel].astype(np.float32)
        titles = (f"keyframe ({channel})", f"winning station {winner.station}")
        plot_descriptor_pair(result.query[channel], station, winner.shift, folder / DESCRIPTORS_PNG, titles)
