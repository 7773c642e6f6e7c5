"""Picture of a map from above, with relief, roofs and trees, for people who know the place; also as a GeoTIFF."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.reference_system import epsg_of
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.geometry.rasters import cells, filled, max_filter
from coview_stream.report.plots import base_shift, draw_notice, figure, map_figure_size

_PIXELS = 1200  # along the picture's longer side
_MAX_POINTS, _SAMPLED = 4_000_000, 100_000  # points that are shaded, and that set the size of the figure
_TALL = 2.0  # metres above the ground: roofs and crowns, not cars and hedges
_PLANE = 0.75  # least planarity of the points on a roof; dense crowns have less
_SMOOTH = 0.6  # slope of a square against the mean of the tall squares around; roofs have less, crowns more
_COLOURS = {"ground": (236, 230, 214), "roofs and walls": (214, 122, 92), "trees": (112, 164, 108)}
_SUN = np.array([-1.0, 1.0, 1.4]) / np.linalg.norm([-1.0, 1.0, 1.4])  # from the north-west, as on printed maps
_DOT, _DENSE = 0.6, 4.0  # points: size of a station, and least spacing at which stations are drawn
_ROUND = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  # metres of a scale bar


@dataclass(frozen=True, eq=False)
class Relief:
    """Colours of a map's squares.

    Attributes:
        rgba: (H, W, 4) colours, southern row first; empty squares are transparent.
        corner: (2,) south-west corner in the frame of the map's sources, metres.
        cell: edge of a square, metres.
    """

    rgba: npt.NDArray[np.uint8]
    corner: Floats
    cell: float


def relief(base_map: BaseMap) -> Relief:
    """Shade a map's highest points by the sun, and colour smooth planar roofs differently from crowns."""
    every = max(1, -(-len(base_map.points) // _MAX_POINTS))
    points = np.array(base_map.points[::every])
    planarity = np.linalg.norm(base_map.arrays["normals"][::every].astype(np.float32), axis=1) / np.float32(127.0)
    side = np.maximum(np.ptp(points[:, :2], axis=0).astype(np.float64), 1.0)
    # no finer than the picture's pixels or the spacing of the points
    cell = max(float(side.max()) / _PIXELS, 1.2 * float(np.sqrt(side.prod() / len(points))), base_map.config.voxel)
    corner, shape, index = cells(points, cell)
    highest = np.full(shape[0] * shape[1], -np.inf, dtype=np.float32)
    np.maximum.at(highest, index, points[:, 2])
    top = highest.reshape(shape)
    top = np.where(np.isfinite(top), top, max_filter(top, 3))  # fill single holes
    known: Bools = np.isfinite(top)
    ground = _ground(base_map, corner, shape, cell)
    top = np.where(known, top, ground)
    tall = known & (top - ground > _TALL)
    stands = points[:, 2] > ground.ravel()[index] + _TALL
    plane = _around(np.bincount(index[stands], planarity[stands], minlength=top.size).reshape(shape))
    count = _around(np.bincount(index[stands], minlength=top.size).reshape(shape).astype(np.float64))
    beside = _around(tall)
    bump = np.abs(top - _around(np.where(tall, top, 0.0)) / np.maximum(beside, 1.0))  # from the mean of tall squares
    smooth = _around(tall & (bump < _SMOOTH * cell)) >= 0.5 * beside
    core = tall & smooth & (plane >= _PLANE * np.maximum(count, 1.0))
    roof = tall & (_around(_around(core)) >= 0.4 * _around(beside))  # includes edges and chimneys
    colour = np.zeros((*shape, 3))
    for name, where in {"ground": known, "trees": tall & ~roof, "roofs and walls": roof}.items():
        colour[where] = _COLOURS[name]
    rgba = np.zeros((*shape, 4), dtype=np.uint8)
    rgba[..., :3] = np.clip(colour * (0.45 + 0.6 * _shade(_around(top) / 9.0, cell))[..., None], 0, 255)
    rgba[..., 3] = 255
    rgba[~known] = 0
    return Relief(rgba, corner + base_map.origin[:2], cell)


def _ground(base_map: BaseMap, corner: Floats, shape: tuple[int, int], cell: float) -> Floats32:
    """Return the ground heights (H, W) from the lowest station of each square, interpolated between stations."""
    block = max(cell, base_map.config.block)
    wide = int(shape[0] * cell / block) + 1, int(shape[1] * cell / block) + 1
    at = np.floor((base_map.stations[:, :2] - corner) / block).astype(np.int64)
    row, column = np.clip(at[:, 1], 0, wide[0] - 1), np.clip(at[:, 0], 0, wide[1] - 1)
    lowest = np.full(wide, np.inf, dtype=np.float32)
    np.minimum.at(lowest, (row, column), base_map.stations[:, 2])
    lowest[np.isinf(lowest)] = np.nan if len(at) else 0.0
    rows, columns = (
        np.minimum((np.arange(n) * cell / block).astype(int), w - 1) for n, w in zip(shape, wide, strict=True)
    )
    return np.asarray(filled(lowest)[np.ix_(rows, columns)])


def _around(values: npt.NDArray[Any]) -> Floats:
    """Return the sums of (H, W) over 3 x 3 windows."""
    padded = np.pad(values.astype(np.float64), 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:])


def _shade(heights: Floats, cell: float) -> Floats:
    """Return the brightness (H, W) of sunlit heights, 0 to 1."""
    north, east = np.gradient(heights, cell) if min(heights.shape) > 1 else (0.0 * heights,) * 2
    light = (_SUN[2] - _SUN[0] * east - _SUN[1] * north) / np.sqrt(1.0 + east**2 + north**2)
    return np.asarray(np.clip(light, 0.0, 1.0))


def plot_map(base_map: BaseMap, path: str | os.PathLike[str], title: str = "Base map") -> None:
    """Draw a map from above with scale, north and, if sparse enough, its stations; ``.tif`` writes a GeoTIFF.

    InputError if the picture cannot be written.
    """
    seen = relief(base_map)
    if Path(path).suffix.lower() in (".tif", ".tiff"):
        write_geotiff(seen, path, base_map.crs)
        return
    some = base_map.sampled_points(_SAMPLED) + base_map.origin
    with figure(path, figsize=map_figure_size(some)) as (drawing, axes):
        shift = base_shift(some)[:2]
        (left, bottom), (height, width) = seen.corner - shift, seen.rgba.shape[:2]
        right, top = left + width * seen.cell, bottom + height * seen.cell
        axes.imshow(seen.rgba, origin="lower", extent=(left, right, bottom, top), interpolation="nearest")
        axes.set_aspect("equal")
        for name, axis, metres in (("east", axes.xaxis, shift[0]), ("north", axes.yaxis, shift[1])):
            axis.set_label_text(f"{name} - {metres:,.0f} [m]".replace(",", " ") if metres else f"{name} [m]")
        drawing.canvas.draw()  # sets the size of the axes
        _draw_stations(axes, base_map.stations[:, :2] + base_map.origin[:2] - shift)
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)
        _draw_scale(axes, right - left)
        for name, colour in _COLOURS.items():
            axes.scatter([], [], s=40, marker="s", color=np.array(colour) / 255.0, label=name)
        axes.set_title(title)
        drawing.legend(loc="outside lower center", ncols=4, fontsize=10)


def _draw_stations(axes: Any, at: Floats) -> None:
    if not len(at):
        draw_notice(axes, "no stations")
        return
    label = f"{len(at):,} stations".replace(",", " ")
    pixels = axes.transData.transform(at)
    area = float(np.ptp(pixels, axis=0).prod()) * (72.0 / axes.figure.dpi) ** 2  # in points
    if np.sqrt(area / len(at)) < _DENSE:
        axes.scatter([], [], s=0, label=f"{label}, too dense to draw")
    else:
        axes.scatter(at[:, 0], at[:, 1], s=_DOT**2 * 4, c="#0072B2", alpha=0.5, linewidths=0, label=label)


def _draw_scale(axes: Any, wide: float) -> None:
    """Draw a scale bar of a round length, and an arrow to the north."""
    metres = max((length for length in _ROUND if length <= wide / 4.0), default=_ROUND[0])
    share = metres / wide
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "boxstyle": "round,pad=0.3"}
    style = {"transform": axes.transAxes, "ha": "center", "fontsize": 9, "zorder": 5}
    axes.plot([0.03, 0.03 + share], [0.03, 0.03], color="black", linewidth=3, transform=axes.transAxes, zorder=5)
    axes.text(0.03 + share / 2.0, 0.045, f"{metres} m", va="bottom", bbox=box, **style)
    arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.5}
    ends = {"xy": (0.97, 0.98), "xytext": (0, -32), "xycoords": "axes fraction", "textcoords": "offset points"}
    axes.annotate("N", ha="center", va="top", fontsize=11, fontweight="bold", arrowprops=arrow, bbox=box, **ends)


def write_geotiff(seen: Relief, path: str | os.PathLike[str], crs: str | None) -> None:
    """Write a relief as a deflated GeoTIFF of 8-bit RGBA, for GIS programs.

    Unless the reference system has an EPSG number, the file states its position but not its system.
    InputError if the file cannot be written.
    """
    from PIL import Image, TiffImagePlugin, TiffTags

    keys = [(1024, 0, 1, 1), (1025, 0, 1, 1)]  # a projected system; a raster of areas
    code = epsg_of(crs)
    if code is not None:
        keys.append((3072, 0, 1, code))
    north = float(seen.corner[1]) + seen.rgba.shape[0] * seen.cell
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[33550] = (seen.cell, seen.cell, 0.0)
    tags[33922] = (0.0, 0.0, 0.0, float(seen.corner[0]), north, 0.0)
    tags[34735] = (1, 1, 0, len(keys), *(number for key in keys for number in key))
    tags.tagtype |= {33550: TiffTags.DOUBLE, 33922: TiffTags.DOUBLE, 34735: TiffTags.SHORT}
    picture = Image.fromarray(np.ascontiguousarray(seen.rgba[::-1]))  # northern row first
    try:
        with atomic_file(Path(path)) as file:
            picture.save(file, "TIFF", compression="tiff_adobe_deflate", tiffinfo=tags)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from error
