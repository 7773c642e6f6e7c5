"""Pictures of maps, trajectories, errors and descriptors, as PNG files.

All take plain arrays, in metres and radians, and work without a display.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Reals
from coview_stream.report.evaluation import MAX_ROTATION, MAX_TRANSLATION
from coview_stream.report.style import (
    ACCENT,
    STATE_COLOURS,
    TRUTH,
    draw_base_map,
    draw_notice,
    figure,
    legend_above,
    legend_below,
    map_figure_size,
)

Path = str | os.PathLike[str]


def plot_map(base: Reals, stations: Reals, path: Path, title: str = "Base map") -> None:
    """Draw the base map (N, 3) in grey, shaded by height, and its stations (M, 3).

    Raises:
        InputError: the picture cannot be written.
    """
    with figure(path, figsize=map_figure_size(base)) as (drawing, axes):
        shift = draw_base_map(axes, base)
        if len(stations):
            at = np.asarray(stations, dtype=np.float64) - shift
            size = float(np.clip(12_000.0 / len(at), 1.2, 12.0))
            label = f"{len(at):,} stations".replace(",", " ")
            axes.scatter(at[:, 0], at[:, 1], s=size, c=STATE_COLOURS["TRACKING"], linewidths=0, label=label)
        else:
            draw_notice(axes, "no stations")
        axes.set_title(title)
        legend_below(drawing, axes)


def plot_trajectory(
    base: Reals, positions: Reals, states: Sequence[str], path: Path, truth: Reals | None = None
) -> None:
    """Draw a trajectory over the grey base map, coloured by state.

    Args:
        base: (N, 3) base map points, metres.
        positions: (K, 3) map positions of the robot, one per frame; NaN where it was not localised: such a
            frame is not drawn, but counted in the legend.
        states: K states, SEARCHING, AMBIGUOUS, TRACKING or LOST.
        path: picture to write.
        truth: (T, 3) true positions, if known.

    Raises:
        InputError: as many states as positions are needed; or the picture cannot be written.
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
        if not drawn.any():
            draw_notice(axes, "not localised: no frame has a pose")
        axes.set_title("Trajectory")
        legend_below(drawing, axes)


def _draw_states(axes: Any, positions: Reals, drawn: Bools, states: npt.NDArray[np.object_]) -> None:
    names = [*STATE_COLOURS, *sorted(set(states) - set(STATE_COLOURS))]
    for name in names:
        here = states == name
        if not here.any():
            continue
        at = positions[here & drawn]
        without = int((here & ~drawn).sum())
        label = f"{name}: {int(here.sum())} frames" + (f", {without} without a pose" if without else "")
        colour = STATE_COLOURS.get(str(name), ACCENT)
        axes.scatter(at[:, 0], at[:, 1], s=12, color=colour, linewidths=0, label=label, zorder=3)
    if drawn.any():
        x, y = positions[int(np.argmax(drawn)), :2]
        axes.scatter(x, y, s=90, marker="o", facecolors="none", edgecolors=TRUTH, label="first pose", zorder=4)


def plot_errors(distance: Reals, e_t: Reals, e_r: Reals, path: Path) -> None:
    """Draw translation errors (N,) in metres and rotation errors (N,) in radians over (N,) metres driven.

    Raises:
        InputError: the picture cannot be written.
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
            mean = float(values[~wrong].mean()) if (~wrong).any() else float("nan")
            named = "right poses" if not (~wrong).any() else f"right poses, mean {mean:.3f}"
            axes.scatter(distance[~wrong], values[~wrong], s=7, color=colour, linewidths=0, label=named)
            _draw_false(axes, distance[wrong], values[wrong], limit)
            legend_above(axes)
        panels[0].set_title("Errors over the distance driven")
        panels[1].set_xlabel("distance driven [m]")


def _draw_false(axes: Any, distance: Reals, values: Reals, limit: float) -> None:
    """Mark false poses and the limit they crossed; metres beside millimetres need a log axis."""
    if not len(values):
        axes.set_ylim(bottom=0.0)
        return
    colour = STATE_COLOURS["LOST"]
    axes.scatter(distance, values, s=26, marker="x", color=colour, label=f"{len(values)} false poses")
    axes.axhline(limit, color=colour, linewidth=0.9, linestyle=":", label=f"limit {limit:g}")
    axes.set_yscale("log")
    axes.set_ylim(bottom=max(1e-3, axes.get_ylim()[0]))


def plot_descriptor_pair(
    query: Reals, winner: Reals, shift: int, path: Path, titles: tuple[str, str] = ("keyframe", "winning station")
) -> None:
    """Draw two polar descriptors (R, S) side by side on one colour scale.

    Rings run outwards, sectors counter-clockwise from the right. The winner is turned by ``shift`` sectors so
    that equal places look equal: column ``j`` of the query meets column ``j - shift`` of the winner, which is
    ``np.roll(winner, shift, axis=1)``. NaN is empty.

    Raises:
        InputError: the descriptors differ in shape, or the picture cannot be written.
    """
    if query.shape != winner.shape or query.ndim != 2:
        shapes = f"{query.shape} and {winner.shape}"
        raise InputError(f"descriptors: shapes {shapes} differ; give two (rings, sectors)")
    pair = [np.asarray(query, dtype=np.float64), np.roll(np.asarray(winner, dtype=np.float64), shift, axis=1)]
    known = np.concatenate([values[np.isfinite(values)] for values in pair])
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    rings, sectors = query.shape
    edges = np.linspace(0, 2 * np.pi, sectors + 1), np.arange(rings + 1)
    options = {"figsize": (10, 5.2), "ncols": 2, "axes": {"subplot_kw": {"projection": "polar"}}}
    turned = f"{titles[1]}, turned by {shift * 360.0 / sectors:g}°"
    with figure(path, **options) as (drawing, panels):
        for axes, values, title in zip(panels, pair, (titles[0], turned), strict=True):
            axes.set_facecolor("#EEEEEE")
            axes.grid(False)
            image = axes.pcolormesh(
                *edges,
                np.where(np.isfinite(values), values, np.nan),
                cmap="viridis",
                vmin=low,
                vmax=high or 1.0,
                rasterized=True,
            )
            axes.set_yticks([])
            axes.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"], color="#555555")
            axes.spines["polar"].set_visible(False)
            axes.set_title(title, loc="center")
        drawing.colorbar(image, ax=list(panels), shrink=0.75, label="bin value")
