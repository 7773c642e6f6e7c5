"""Output of fused clouds: files (las, laz, ply, pcd, npy, with a JSON file of the sources), a summary, a picture."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.las import las_writer, require_laspy
from coview_stream.clouds.trajectory import write_tum
from coview_stream.errors import CloudError, counted, require_library, warn
from coview_stream.fusion.fuse import GONE, NEW, RECORD, SAME, Fused
from coview_stream.fusion.localized_run import LocalizedRun
from coview_stream.report.plots import MAX_BASE_POINTS, draw_base_map, figure, legend_below, map_figure_size

SUFFIXES = (".laz", ".las", ".ply", ".pcd", ".npy")
_SCALE = 0.001  # metres
_PLY_TYPES = {"f8": "double", "u2": "ushort", "u1": "uchar"}
_PCD_TYPES = {"f8": "8 F", "u2": "2 U", "u1": "1 U"}


def check_name(path: Path, inputs: Iterable[Path]) -> None:
    """Raise CloudError for another suffix, a directory or an input's name, DependencyError for LAS without laspy."""
    if path.suffix.lower() not in SUFFIXES:
        raise CloudError(f"{path}: name a cloud, one of {', '.join(SUFFIXES)}")
    if path.is_dir() or not path.resolve().parent.is_dir():
        raise CloudError(f"{path}: is a directory, or in none; name a file in an existing directory")
    for other in inputs:
        if path.resolve() == other.resolve() or (other.is_dir() and other.resolve() in path.resolve().parents):
            raise CloudError(f"{path}: is, or lies in, {other}, which is read; name another file")
    if path.suffix.lower() in (".las", ".laz"):
        require_laspy()


def write_fused(fused: Fused, path: Path, names: Sequence[str]) -> None:
    """Write the cloud, and next to it ``PATH.json`` with the name of each source.

    LAS and LAZ hold millimetres, the source as ``point_source_id``, the stamp as ``gps_time`` and ``change`` as an
    extra dimension; PLY and PCD have properties ``source``, ``change`` and ``stamp``; NPY has columns x, y, z, stamp,
    source, change, all float64.

    Raises:
        CloudError: the file cannot be written.
    """
    write = _las if path.suffix.lower() in (".las", ".laz") else _plain
    try:
        with atomic_file(path) as stream:
            write(stream, fused, path)
        with atomic_file(path.with_name(f"{path.name}.json")) as stream:
            stream.write((json.dumps(_sidecar(fused, names), indent=1) + "\n").encode())
    except OSError as error:
        reason = error.strerror or error
        raise CloudError(f"{path}: cannot be written ({reason}); check the directory and the disk") from error


def write_trajectories(path: Path, runs: Sequence[LocalizedRun]) -> list[str]:
    """Write each run's poses map <- body next to the cloud as ``PATH.run1.tum`` ...; return the names.

    Raises:
        InputError: a file cannot be written.
    """
    names = [f"{path.name}.run{k}.tum" for k in range(1, len(runs) + 1)]
    for name, run in zip(names, runs, strict=True):
        write_tum(path.with_name(name), run.stamps, run.poses)
    return names


def _sidecar(fused: Fused, names: Sequence[str]) -> dict[str, Any]:
    base = fused.base_map
    first = {"source": 0, "name": str(base.path or "base map"), "points": len(base.points), "files": base.sources}
    runs = [
        {"source": k, "name": name, **vars(added)}
        for k, (name, added) in enumerate(zip(names, fused.added, strict=True), start=1)
    ]
    return {
        "sources": [first, *runs], "change": {"0": "same", "1": "new", "2": "gone"}, "map_sha256": base.sha256,
        "crs": base.crs, "filled_m2": round(fused.filled, 1), "moving_voxels_left_out": fused.moving,
    }  # fmt: skip


def _las(stream: BinaryIO, fused: Fused, path: Path) -> None:
    laspy = require_laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, _SCALE)
    header.offsets = np.floor(fused.base_map.origin)
    header.add_extra_dim(laspy.ExtraBytesParams(name="change", type=np.uint8, description="0 same, 1 new, 2 gone"))
    wkt = _wkt(fused.base_map.crs)
    if wkt is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    with las_writer(stream, header, path) as writer:
        for rows in fused.chunks():
            record = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
            record.x, record.y, record.z = rows["x"], rows["y"], rows["z"]
            record.point_source_id, record.gps_time, record.change = rows["source"], rows["stamp"], rows["change"]
            record.return_number, record.number_of_returns = np.ones((2, len(rows)), dtype=np.uint8)
            record.classification = np.ones(len(rows), dtype=np.uint8)  # unclassified
            writer.write_points(record)


def _wkt(crs: str | None) -> str | None:
    """Return a reference system as WKT; None, with a warning, for a code that cannot be looked up."""
    if crs is None or not crs.startswith("EPSG:"):
        return crs
    try:
        systems = require_library("pyproj", "pyproj>=3.6", "reference systems")
        return str(systems.CRS.from_user_input(crs).to_wkt("WKT1_GDAL"))
    except Exception as error:  # pyproj may raise anything, or be missing
        warn(f"the cloud does not state its reference system, {crs} ({error})")
    return None


def _plain(stream: BinaryIO, fused: Fused, path: Path) -> None:
    kind = path.suffix.lower()
    count, names = len(fused), RECORD.names or ()
    kinds = [RECORD[name].str.lstrip("<|") for name in names]
    if kind == ".npy":
        header = {"descr": "<f8", "fortran_order": False, "shape": (count, len(names))}
        np.lib.format.write_array_header_1_0(stream, header)
    elif kind == ".ply":
        lines = "".join(f"property {_PLY_TYPES[k]} {name}\n" for k, name in zip(kinds, names, strict=True))
        stream.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{lines}end_header\n".encode())
    else:
        sizes, types = zip(*(_PCD_TYPES[k].split() for k in kinds), strict=True)
        stream.write(
            f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {' '.join(sizes)}\nTYPE {' '.join(types)}\n"
            f"COUNT {' '.join('1' * len(names))}\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
            f"POINTS {count}\nDATA binary\n".encode()
        )
    for rows in fused.chunks():
        columns = np.stack([rows[name].astype("<f8") for name in names], axis=1) if kind == ".npy" else rows
        stream.write(columns.tobytes())


def summary(fused: Fused, names: Sequence[str], changes: bool) -> str:
    """Summarize the sources, the filled blind spots and, on request, the changes, one line each."""
    lines = [f"{'0 base map':<18} {len(fused.base_map.points):,} points"]
    for k, (name, added) in enumerate(zip(names, fused.added, strict=True), start=1):
        left = [
            f"{counted(count, 'frame')} {why}"
            for count, why in ((added.without_pose, "without a pose left out"), (added.damaged, "damaged"))
            if count
        ]
        text = ", ".join([f"{added.points:,} points of {counted(added.frames, 'frame')}", *left])
        lines.append(f"{f'{k} {name}':<18} {text}")
    lines.append(f"{'blind spots':<18} about {fused.filled:,.0f} m2 of surface filled")
    lines.append(f"{'moving':<18} {fused.moving:,} voxels that rays went through")
    if changes:
        lines.append(f"{'new':<18} {int((fused.change == NEW).sum()):,} points")
        lines.append(f"{'gone':<18} {int((fused.base_change == GONE).sum()):,} points of the base map")
    return "\n".join(lines)


_ADDED, _NEW, _GONE = "#56B4E9", "#009E73", "#D55E00"
_MOST = 200_000  # points drawn per kind


def draw_fused(fused: Fused, path: Path, title: str) -> None:
    """Draw the base map, the points of the runs, and the changes.

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
                thinned = points[:: -(-len(points) // _MOST)] + base_map.origin - shift
                xy = thinned[:, 0], thinned[:, 1]
                axes.scatter(*xy, s=0.5, color=colour, linewidths=0, label=label, rasterized=True)
        axes.set_title(title)
        legend_below(drawing, axes)
