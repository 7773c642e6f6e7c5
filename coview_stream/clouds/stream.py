"""Streaming of cloud files: chunk after chunk into a builder, so that a file need not fit into memory."""

from __future__ import annotations

from pathlib import Path

from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.e57 import require_pye57
from coview_stream.clouds.files import check_format, read_cloud
from coview_stream.clouds.las import check_las, decode, is_compressed, require_laspy
from coview_stream.clouds.laz_process import stream_from_child


def stream_cloud(path: Path, builder: CloudBuilder) -> str | None:
    """Hand a file's points to a builder, raw, float64 metres, and return its reference system, if it states one.

    LAS, LAZ and E57 come in chunks of a million points; other formats are read whole first.

    Raises:
        CloudError: as of :func:`~coview_stream.clouds.files.read_cloud`, but for a file without points.
    """
    kind = check_format(path)
    if kind == "LAS":
        check_las(path)
        require_laspy()
        if is_compressed(path):
            return stream_from_child(path, builder)
        return decode(path, lambda crs: _with_crs(builder, crs)).crs
    if kind == "E57":
        require_pye57()
        return stream_from_child(path, builder)
    cloud = read_cloud(path)
    builder.add(cloud.map_points(), cloud.classification, cloud.dropped)
    return cloud.crs


def _with_crs(builder: CloudBuilder, crs: str | None) -> CloudBuilder:
    builder.crs = crs
    return builder
